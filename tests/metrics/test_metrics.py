"""The metrics as Prometheus reads them, and the server's answers.

Its status file may be good, missing, stale or damaged.
"""

import json
import re
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from http.client import HTTPConnection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from command_line import refused, written
from prometheus_client import Metric, generate_latest
from prometheus_client.parser import text_string_to_metric_families
from statistics_bench import Bench, with_nodes
from vcan_tools import GatewayProcess

from kontronik_can_gw.desk import metrics as metrics_module
from kontronik_can_gw.desk.libraries import EXTRAS, install_command
from kontronik_can_gw.desk.monitor.status import look_at
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.kontronik.states import OperatingError, SelfTestError
from kontronik_can_gw.runtime.files.event_recorder import EventRecorderFacts
from kontronik_can_gw.runtime.files.recorder import RecorderFacts
from kontronik_can_gw.runtime.status.facts import CanFacts, PortFacts, StoreFacts
from kontronik_can_gw.runtime.status.snapshot import STALE_NS
from kontronik_can_gw.times import SECOND

pytestmark = pytest.mark.promise("metrics")

PROMTOOL = shutil.which("promtool")


def metrics(document: dict[str, Any]) -> str:
    found = SimpleNamespace(collect=lambda: metrics_module.families(document, 0.5))
    return generate_latest(found).decode()


def families(document: dict[str, Any]) -> dict[str, Metric]:
    """Return the metrics by name, including ``_total``."""
    text = metrics(document)
    found = list(text_string_to_metric_families(text))
    named = {}
    for family in found:
        suffix = "_total" if family.type == "counter" else ""
        named[family.name + suffix] = family
    assert len(named) == len(found)
    return named


def value(document: dict[str, Any], name: str, **labels: str) -> float | None:
    family = families(document).get(name)
    if family is None:
        return None
    found = [s.value for s in family.samples if s.labels == labels]
    assert len(found) <= 1
    return found[0] if found else None


@pytest.fixture(scope="module")
def document() -> dict[str, Any]:
    bench = Bench(2)
    bench.run(6)
    ports = []
    for number in (1, 2):
        errors = {"parity": number, "framing": 0}
        ports.append(PortFacts(f"esc{number}", f"/dev/{number}", True, line_errors=errors))
    can = CanFacts("socketcan", "can0", 500_000, True, error_counters=(8, 0))
    store = StoreFacts(1, "disk full")
    return with_nodes(bench.document(ports=ports, can=can, store=store))


def test_names_have_the_prefix_and_pass_the_tool_of_prometheus(
    document: dict[str, Any],
) -> None:
    for name, family in families(document).items():
        assert re.fullmatch(r"kontronik_[a-z][a-z0-9_]*", name)
        assert (family.type == "counter") == name.endswith("_total")
        assert family.documentation
    if PROMTOOL is not None:
        command = [PROMTOOL, "check", "metrics"]
        subprocess.run(command, input=metrics(document), text=True, check=True)


def test_values_are_in_base_units(document: dict[str, Any]) -> None:
    values = document["escs"][0]["values"]
    assert values["electrical_speed"] > 0
    expected = {
        "battery_voltage_volts": values["battery_voltage"],
        "battery_current_amperes": values["battery_current"],
        "battery_power_watts": values["battery_power"],
        "consumed_charge_coulombs": values["consumed_charge"] * 3.6,
        "energy_used_joules_total": values["energy_used"] * 3600,
        "motor_run_time_seconds_total": values["motor_run_time"],
        "power_stage_temperature_celsius": values["power_stage_temperature"],
        "throttle_ratio": values["throttle"] / 100,
        "pwm_input_seconds": values["pwm_input"] * 1e-6,
        "electrical_speed_revolutions_per_second": values["electrical_speed"] / 60,
        "cells": values["cell_count"],
        "operating_state_raw": values["operating_state_raw"],
        "esc_data_age_seconds": document["escs"][0]["data_age_ms"] / 1000,
        "esc_frame_rate_hertz": document["escs"][0]["frame_rate_hz"],
        "esc_live_frames_total": document["escs"][0]["counters"]["live"],
        "esc_received_bytes_total": document["escs"][0]["counters"]["bytes"],
    }
    for name, number in expected.items():
        assert value(document, f"kontronik_{name}", esc="esc1") == pytest.approx(number), name
    named = set(families(document))
    for key in document["units"]:
        name = "cells" if key == "cell_count" else key
        metric = re.compile(rf"kontronik_{name}(_(?!error).*)?")
        assert any(metric.fullmatch(each) for each in named), name
    assert value(document, "kontronik_can_bitrate") == 500_000
    assert value(document, "kontronik_can_transmit_errors") == 8
    assert value(document, "kontronik_uptime_seconds") == 6
    assert value(document, "kontronik_esc_port_line_errors_total", esc="esc2", kind="parity") == 2
    assert value(document, "kontronik_store_failed") == 1


def test_recorded_events_are_counted(document: dict[str, Any]) -> None:
    name = "kontronik_recording_events_total"
    assert value(document, name) is None
    assert value(document | {"recording": vars(RecorderFacts())}, name) is None
    facts = EventRecorderFacts(events=3)
    assert value(document | {"recording": vars(facts)}, name) == 3


def test_unavailable_value_is_left_out() -> None:
    bench = Bench(2)
    bench.run(2)
    bench.silent.add(0)
    bench.run(1)
    document = bench.document()
    values = document["escs"][0]["values"]
    available = {name for name, value_now in values.items() if value_now is not None}
    assert available == {"energy_used", "motor_run_time"}
    text = metrics(document)
    assert value(document, "kontronik_battery_voltage_volts", esc="esc1") is None
    assert value(document, "kontronik_battery_voltage_volts", esc="esc2") is not None
    assert value(document, "kontronik_esc_fresh", esc="esc1") == 0
    assert 'kontronik_operating_error{esc="esc1"' not in text
    assert 'kontronik_esc_info{esc="esc1"' not in text
    assert not re.search("nan|none|null", text, re.IGNORECASE)
    assert value(document, "kontronik_esc_losses_total", esc="esc1") == 1
    assert "kontronik_canopen_node_state" not in text  # without nodes
    assert "kontronik_store" not in text


def test_error_bits_have_a_severity_and_unknown_ones_are_shown_if_set() -> None:
    bench = Bench(1)
    bench.run(3)
    errors = LiveData(operating_errors=1 << OperatingError.OVERVOLTAGE | 1 << 30)
    bench.gateway.receive_bytes(0, encode(errors, WireLayout.V4), bench.now, bench.now)
    found = families(bench.document())
    samples = found["kontronik_operating_error"].samples
    severities = {}
    active = set()
    for sample in samples:
        error = sample.labels["error"]
        severities[error] = sample.labels["severity"]
        if sample.value == 1:
            active.add(error)
    expected = {bit.text: bit.severity.value for bit in OperatingError}
    assert severities == expected | {"bit30": "error"}
    assert len(samples) == len(severities)
    assert active == {"overvoltage", "bit30"}
    assert len(found["kontronik_selftest_error"].samples) == len(SelfTestError)


# --- the server


PATIENCE = 60.0


@pytest.fixture
def file(tmp_path: Path, document: dict[str, Any]) -> Path:
    return written(tmp_path / "status.json", json.dumps(document))


class Clock:
    now = 0


@pytest.fixture
def clock(document: dict[str, Any]) -> Clock:
    """Return a clock at which the document is half a second old."""
    made = Clock()
    made.now = document["monotonic_ns"] + SECOND // 2
    return made


@pytest.fixture
def port(file: Path, clock: Clock) -> Iterator[int]:
    """Start a server and return its port, which the system chooses."""
    look = partial(look_at, file)
    with metrics_module.server_of(look, "127.0.0.1", 0, lambda: clock.now) as made:
        thread = threading.Thread(target=made.serve_forever, args=(0.05,))
        thread.start()
        yield made.server_port
        made.shutdown()
        thread.join()


def ask(port: int, path: str = "/metrics", **headers: str) -> tuple[int, str, str]:
    """Return status, content type and text of an answer."""
    with closing(HTTPConnection("127.0.0.1", port, timeout=PATIENCE)) as connection:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.headers["Content-Type"], answer.read().decode()


def test_newest_metrics_are_served_to_prometheus(
    port: int,
    file: Path,
    clock: Clock,
    document: dict[str, Any],
) -> None:
    for accept in ("*/*", "application/openmetrics-text;version=1.0.0", "a/b;version=x;;=,"):
        status, _, text = ask(port, Accept=accept)
        assert status == 200
        assert text.count("\nkontronik_battery_voltage_volts{") == 2
    kind, text = ask(port, "/metrics?x=1")[1:]
    assert kind == "text/plain; version=0.0.4; charset=utf-8"
    found = {family.name: family for family in text_string_to_metric_families(text)}
    assert found["kontronik_snapshot_age_seconds"].samples[0].value == 0.5
    file.unlink()
    assert ask(port)[0] == 503
    file.write_text(json.dumps(document | {"version": "9.9.9"}))
    assert 'kontronik_build_info{version="9.9.9"} 1.0' in ask(port)[2]
    for age_ns, said in (
        (STALE_NS + 9 * SECOND, "for 12.0 s"),
        (-STALE_NS - 1, "not running"),
    ):
        clock.now = document["monotonic_ns"] + age_ns
        status, _, text = ask(port)
        assert status == 503
        assert said in text


@pytest.mark.parametrize(
    ("status", "hosts"),
    [
        (200, ["localhost", "LOCALHOST:1", "127.0.0.1:9123", "[::1]:5"]),
        (403, ["example.com", "localhost.example.com", "127.0.0.1.example.com", "10.0.0.1", ""]),
    ],
)
def test_request_with_a_foreign_host_name_is_refused(
    port: int,
    status: int,
    hosts: list[str],
) -> None:
    assert [ask(port, Host=host)[0] for host in hosts] == [status] * len(hosts)


def test_damaged_file_is_one_line_without_a_traceback(
    port: int,
    file: Path,
    document: dict[str, Any],
    capfd: pytest.CaptureFixture[str],
) -> None:
    text = json.dumps(document)
    damaged: list[object] = [
        None,
        3,
        [],
        "x",
        {},
        {"program": "x"},
        document | {"format": 99},
    ]
    for key in ("can", "escs", "gateway", "monotonic_ns", "process", "units"):
        without = dict(document)
        del without[key]
        damaged += [without, document | {key: ["x"]}]
    contents = [b"\xff\xfe", b"[" * 100_000]
    contents += [text[: len(text) * part // 9].encode() for part in range(9)]
    contents += [json.dumps(each).encode() for each in damaged]
    for data in contents:
        file.write_bytes(data)
        status, _, line = ask(port)
        assert status == 503, data[:99]
        assert str(file) in line, data[:99]
        assert line.count("\n") == 1, data[:99]
    assert "Traceback" not in capfd.readouterr().err


def test_clients_that_never_finish_delay_no_other_and_are_closed(
    port: int,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    address = ("127.0.0.1", port)
    with (
        socket.create_connection(address, PATIENCE) as mute,
        socket.create_connection(address, PATIENCE) as rude,
    ):
        rude.sendall(b"\x16\x03\x01\x02\x00\r\n\r\n")
        assert ask(port)[0] == 200
        mute.send(b"GET /metr")
        assert ask(port)[0] == 200
    monkeypatch.setattr(metrics_module._Handler, "timeout", 0.1)
    with socket.create_connection(address, PATIENCE) as mute:
        assert mute.recv(1) == b""
    assert "Traceback" not in capfd.readouterr().err


# --- the command


@pytest.mark.parametrize(
    ("words", "package", "said", "extra"),
    [
        (
            ("metrics", "--listen", "127.0.0.1:0"),
            "prometheus_client",
            "metrics needs prometheus-client>=0.20. ",
            "metrics",
        ),
        (("mqtt", "--broker", "x"), "paho", "MQTT needs paho-mqtt>=2. ", "mqtt"),
    ],
)
def test_missing_library_is_reported_with_the_command_that_installs_it(
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
    package: str,
    said: str,
    extra: str,
) -> None:
    for module in list(sys.modules):
        if module.startswith((package, f"kontronik_can_gw.desk.{extra}")):
            monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, package, None)
    assert refused(1, *words) == said + f"Install it: {install_command(EXTRAS[extra])}"


def test_command_serves_the_configured_file_until_sigterm(
    tmp_path: Path,
    port: int,
    file: Path,
) -> None:
    text = '[[esc]]\nport = "/dev/ttyS0"\n[statistics]\nfile = '
    toml = written(tmp_path / "g.toml", f'{text}"own.json"\n')
    for text in ("0.0.0.0:9123", "10.0.0.1:1", "9123", "localhost:x", "[::]:1"):
        assert "is not an address and port of this machine" in refused(
            2, "metrics", toml, "--listen", text
        )
    said = refused(1, "metrics", "--file", file, "--listen", f"127.0.0.1:{port}")
    assert "cannot be used: Address already in use. Choose another" in said
    program = GatewayProcess(None, toml, "--listen", "127.0.0.1:0", command="metrics")
    try:
        program.wait_for_line(f"serves {tmp_path}/own.json")
        address = program.log.partition("127.0.0.1:")[2]
        status, _, _ = ask(int(address.partition("/")[0]))
        assert status == 503
        assert program.end() == 0
    finally:
        program.kill()
