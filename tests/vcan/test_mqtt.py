"""The whole chain on a real CAN interface: simulated ESCs, their gateway, vcan, the publisher beside it, a real broker, a subscriber."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from vcan_tools import GatewayProcess, bench, configuration, wait_for

sys.path.append(str(Path(__file__).resolve().parents[1] / "mqtt"))

from mqtt_bench import Mosquitto, Process, Subscriber, kept

from kontronik_can_gw.esc.kontronik.fields import LiveData, rows
from kontronik_can_gw.esc.kontronik.simulator import EscOptions, Phase
from kontronik_can_gw.esc.kontronik.states import OperatingState

pytestmark = pytest.mark.extended

FLIES = EscOptions(
    profile=(
        Phase("up", 2, 80, OperatingState.Forward, 2),
        Phase("down", 2, 20, OperatingState.Forward, 2),
    )
)
FIELDS = (
    "electrical_speed",
    "battery_voltage",
    "battery_current",
    "throttle",
    "power_stage_temperature",
)
DEVICES = {"kontronik_chain", "kontronik_chain_esc1", "kontronik_chain_esc2"}


def as_published(data: LiveData) -> dict[str, float]:
    return {name: rows(LiveData)[name].physical(getattr(data, name)) for name in FIELDS}


def whole_states(heard: Subscriber, esc: str) -> list[dict[str, Any]]:
    """The published states of an ESC in which no value is missing: each comes in a CAN frame of its own, and ages."""
    states = [message.json for message in heard.of(f"kontronik/chain/{esc}/state")]
    return [state for state in states if all(state[name] is not None for name in FIELDS)]


def devices_of(broker: Mosquitto) -> set[str]:
    """The devices that Home Assistant would find."""
    return {topic.split("/")[2] for topic in kept(broker.port, "homeassistant/#")}


def test_what_escs_send_arrives_at_a_subscriber(
    vcan: str, tmp_path: Path, start_gateway: Callable[..., GatewayProcess]
) -> None:
    # a machine that was only booted for tests has no loopback yet
    subprocess.run(["ip", "link", "set", "lo", "up"], check=False, capture_output=True)
    broker = Mosquitto(tmp_path)
    try:
        with bench(FLIES, FLIES) as run, Subscriber(broker.port, "kontronik/chain/#") as heard:
            toml = configuration(
                vcan, [port.path for port in run.ports], esc="telemetry_timeout_ms = 5000"
            )
            gateway = start_gateway(toml)
            gateway.wait_for_line("esc2: /dev/pts")
            file = tmp_path / "mqtt.toml"
            file.write_text(
                f'[mqtt]\nbroker = "{broker.address}"\ngateway = "chain"\nrate = 5\n{toml}'
            )
            with Process("-c", file, "--discovery") as program:
                program.wait_for_line("connected as kontronik-can-gw-chain")
                run.start()
                for index, esc in enumerate(("esc1", "esc2")):
                    heard.wait(f"kontronik/chain/{esc}/available", b"online")
                    wait_for(lambda e=esc: len(whole_states(heard, e)) >= 8, f"states of {esc}")  # type: ignore[misc]
                    states = whole_states(heard, esc)
                    sent = [as_published(data) for data in run.live(index)]
                    for found in states:
                        # each value is one that this ESC has sent: they come in several CAN frames
                        for name in FIELDS:
                            assert any(abs(values[name] - found[name]) < 1e-6 for values in sent), (
                                esc,
                                name,
                                found,
                            )
                        assert found["available"] is True
                wait_for(lambda: devices_of(broker) == DEVICES, lambda: devices_of(broker))
                run.stop()
                for topic, payload in (("esc1/available", b"offline"), ("available", b"online")):
                    wait_for(
                        lambda t=topic, p=payload: (
                            heard.of(f"kontronik/chain/{t}")[-1].payload == p
                        ),  # type: ignore[misc]
                        f"{topic} {payload!r}",
                    )
                wait_for(
                    lambda: heard.of("kontronik/chain/esc1/state")[-1].json["link_state"] == "Lost",
                    "a lost link",
                )
                gateway.end()
                heard.wait("kontronik/chain/available", b"offline")
                assert program.end() == 0
            assert "Traceback" not in program.log
    finally:
        broker.stop()
