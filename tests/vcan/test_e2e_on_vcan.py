"""Messages with each E2E profile, from an ESC through the gateway to a bus, and from its capture.

The receivers of the package autosar-e2e accept each frame, also over a loss of telemetry.
"""

from pathlib import Path

import pytest
from e2e_oracle import COUNTER_BITS, DATA_IDS, counter_of, is_right
from packer_oracle import Msg, Sig, dbc_text
from vcan_tools import GatewayProcess, configuration, feeding, recording, wait_for

from kontronik_can_gw.cli import main
from kontronik_can_gw.signals.e2e import PROFILES

pytestmark = pytest.mark.promise("e2e")

FIRST_ID = 0x300
NAMES = {FIRST_ID + number: name for number, name in enumerate(PROFILES)}
"""The profile of each message, by its id."""


def protected_dbc() -> str:
    """Return a DBC with a message of the battery voltage for each profile."""
    messages = []
    for can_id, name in NAMES.items():
        bits = PROFILES[name].crc_bits
        signals = [
            Sig(f"P{name}_CRC", 0, bits),
            Sig(f"P{name}_BZ", bits, COUNTER_BITS.get(name, 4)),
            Sig("BatteryVoltage", 32, 16, unit="V", factor="0.01"),
        ]
        if name.endswith("C"):
            signals.append(Sig(f"P{name}_DataIDNibble", bits + 4, 4))
        messages.append(Msg(f"P{name}", can_id, 8, signals))
    return dbc_text(messages)


def dbc_table(file: Path, captures: Path) -> str:
    lines = [f'[record]\ndirectory = "{captures}"', f'[dbc]\nfile = "{file}"', "[dbc.e2e]"]
    lines += [f'P{name} = "{name}"' for name in PROFILES]
    lines.append("[dbc.e2e_data_ids]")
    for name, ids in DATA_IDS.items():
        lines.append(f"P{name} = {[*ids] if isinstance(ids, tuple) else ids}")
    return "\n".join(lines) + "\n"


def frames_of_log(file: Path) -> list[tuple[int, bytes]]:
    """Return ids and data of a candump log."""
    frames = []
    for line in file.read_text().splitlines():
        can_id, data = line.split()[2].split("#")
        frames.append((int(can_id, 16), bytes.fromhex(data)))
    return frames


def test_each_profile_is_right_on_the_bus_and_from_the_capture(vcan: str, tmp_path: Path) -> None:
    dbc = tmp_path / "protected.dbc"
    dbc.write_text(protected_dbc())
    captures = tmp_path / "captures"
    with feeding(tmp_path) as ports, recording(vcan) as watch:
        table = dbc_table(dbc, captures)
        config = tmp_path / "gateway.toml"
        config.write_text(configuration(vcan, ports, table, "telemetry_timeout_ms = 250"))
        gateway = GatewayProcess(config)
        try:
            gateway.wait_for_line("CAN socketcan")
            for losses in (1, 2):

                def are_sent(more_than: int = len(watch.recorded) + 500) -> bool:
                    return len(watch.recorded) > more_than

                def is_lost(losses: int = losses) -> bool:
                    return gateway.log.count("telemetry lost") >= losses

                ports[0].on = True
                wait_for(are_sent, "500 frames")
                ports[0].on = False
                wait_for(is_lost, "the loss of telemetry")
            assert gateway.end() == 0, gateway.log
            watch.wait_for_mark()
        finally:
            gateway.kill()
        recorded = [(frame.can_id, frame.data) for frame in watch.recorded]
    for can_id, name in NAMES.items():
        frames = [data for each, data in recorded if each == can_id]
        assert len(frames) > 50, name
        assert all(is_right(name, data) for data in frames), name
        counters = [counter_of(name, data) for data in frames]
        count = PROFILES[name].counters
        assert counters == [number % count for number in range(len(frames))], name
    (capture,) = captures.iterdir()
    log = tmp_path / "again.log"
    assert main(["convert", str(capture), str(log), "-q"]) == 0
    again = frames_of_log(log)
    assert again[: len(recorded)] == recorded
