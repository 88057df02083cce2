"""``kontronik-can-gw metrics``: what is answered for a good, a missing, a stale and a damaged status file, and to whom."""

import json
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import pytest
from command_line import refused, written
from harness import LoggedProcess
from prometheus_client.parser import text_string_to_metric_families
from statistics_bench import Bench

from kontronik_can_gw.desk import metrics
from kontronik_can_gw.desk.metrics import server_of
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.runtime.snapshot import STALE_NS

PATIENCE = 60.0


@pytest.fixture(scope="module")
def document() -> dict[str, Any]:
    bench = Bench(8)
    bench.run(2)
    return bench.document()


@pytest.fixture
def file(tmp_path: Path, document: dict[str, Any]) -> Path:
    return written(tmp_path / "status.json", json.dumps(document))


class Clock:
    now = 0


@pytest.fixture
def clock(document: dict[str, Any]) -> Clock:
    """At first the document is half a second old."""
    made = Clock()
    made.now = document["monotonic_ns"] + SECOND // 2
    return made


@pytest.fixture
def port(file: Path, clock: Clock) -> Iterator[int]:
    """Of a server, chosen by the system."""
    with server_of(file, "127.0.0.1", 0, lambda: clock.now) as made:
        thread = threading.Thread(target=made.serve_forever, args=(0.05,))
        thread.start()
        yield made.server_port
        made.shutdown()
        thread.join()


def ask(
    port: int, path: str = "/metrics", method: str = "GET", **headers: str
) -> tuple[int, str, str]:
    """Status, content type and text of an answer."""
    connection = HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
    try:
        connection.request(method, path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.headers["Content-Type"], answer.read().decode()
    finally:
        connection.close()


def test_metrics_are_fetched_as_prometheus_does(port: int) -> None:
    for accept in ("*/*", "application/openmetrics-text;version=1.0.0", "a/b;version=x;;=,"):
        status, _, text = ask(port, Accept=accept)
        assert status == 200
        assert text.count("\nkontronik_battery_voltage_volts{") == 8
    status, kind, text = ask(port, "/metrics?x=1")
    assert (status, kind) == (200, "text/plain; version=0.0.4; charset=utf-8")
    found = {family.name: family for family in text_string_to_metric_families(text)}
    assert found["kontronik_snapshot_age_seconds"].samples[0].value == 0.5


def test_what_the_gateway_replaces_is_read_anew(
    port: int, file: Path, document: dict[str, Any]
) -> None:
    file.unlink()
    status, _, text = ask(port)
    assert (status, text.startswith(f"{file}: not running: there is no such file.")) == (503, True)
    file.write_text(json.dumps(document | {"version": "9.9.9"}))
    assert 'kontronik_build_info{version="9.9.9"} 1.0' in ask(port)[2]


@pytest.mark.parametrize(
    ("age_ns", "said"),
    [(STALE_NS, ""), (STALE_NS + 9 * SECOND, "since 12.0 s"), (-STALE_NS - 1, "not running")],
)
def test_a_frozen_gateway_and_one_of_before_a_reboot_have_no_values(
    port: int, clock: Clock, document: dict[str, Any], age_ns: int, said: str
) -> None:
    clock.now = document["monotonic_ns"] + age_ns
    status, _, text = ask(port)
    assert (status, said in text) == (503 if said else 200, True)


def test_a_damaged_file_is_one_line_and_never_a_traceback(
    port: int, file: Path, document: dict[str, Any], capfd: pytest.CaptureFixture[str]
) -> None:
    text = json.dumps(document)
    damaged: list[object] = [None, 3, [], "x", {}, {"program": "x"}, document | {"format": 99}]
    for key in ("can", "escs", "gateway", "monotonic_ns", "nodes", "process", "units", "version"):
        damaged.append({k: v for k, v in document.items() if k != key})
    for key in ("can", "escs", "gateway", "monotonic_ns", "process", "units"):
        damaged += [document | {key: wrong} for wrong in ("x", ["x"])]
    cut = [text[: len(text) * part // 9].encode() for part in range(9)]
    for data in [*cut, b"\xff\xfe", b"[" * 100_000, *(json.dumps(d).encode() for d in damaged)]:
        file.write_bytes(data)
        status, _, line = ask(port)
        assert (status, str(file) in line, line.count("\n")) == (503, True, 1), data[:99]
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize(
    ("status", "hosts"),
    [
        (200, ["localhost", "LOCALHOST:1", "127.0.0.1:9123", "127.9.9.9", "[::1]:5"]),
        (403, ["example.com", "localhost.example.com", "127.0.0.1.example.com", "10.0.0.1", ""]),
    ],
)
def test_a_page_that_has_its_own_name_lead_here_is_refused(
    port: int, status: int, hosts: list[str]
) -> None:
    assert [ask(port, Host=host)[0] for host in hosts] == [status] * len(hosts)


def test_clients_that_never_come_to_an_end_delay_no_other_and_are_ended(
    port: int, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
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
    monkeypatch.setattr(metrics._Handler, "timeout", 0.1)
    with socket.create_connection(address, PATIENCE) as mute:
        assert mute.recv(1) == b""
    assert "Traceback" not in capfd.readouterr().err


# --- the command


def test_an_address_that_cannot_be_had_is_one_line_with_the_remedy(port: int, file: Path) -> None:
    at = f"127.0.0.1:{port}"
    said = refused(1, "metrics", "--file", file, "--listen", at)
    assert (
        said
        == f"--listen {at}: cannot be listened to: Address already in use. Choose another address or port."
    )
    with pytest.raises(RunError, match=r"--listen 192.0.2.1:9123: cannot be listened to: Cannot"):
        server_of(file, "192.0.2.1", 9123)


@pytest.mark.parametrize("text", ["0.0.0.0:9123", "10.0.0.1:1", "9123", "localhost:x", "[::]:1"])
def test_other_machines_are_not_served(text: str) -> None:
    assert "is no port on this machine" in refused(2, "metrics", "--listen", text)


def test_without_the_library_its_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in list(sys.modules):
        if name.startswith(("prometheus_client", "kontronik_can_gw.desk.metrics")):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    said = refused(1, "metrics", "--listen", "127.0.0.1:0")
    assert said == "needs prometheus-client: pip install 'kontronik-can-gw[metrics]'"


@pytest.mark.parametrize(
    ("name", "words", "own", "shown"),
    [
        ("gateway.toml", ["-c", "gateway.toml"], "", "/run/kontronik-can-gw/status.json"),
        ("left.toml", ["left.toml"], "", "/run/kontronik-can-gw-left/status.json"),
        ("gateway.toml", [], '[statistics]\nfile = "own.json"\n', "own.json"),
    ],
)
def test_it_serves_the_file_of_a_configuration_until_sigterm(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    words: list[str],
    own: str,
    shown: str,
) -> None:
    written(tmp_path / name, f'{own}[[esc]]\nport = "/dev/ttyS0"\npole_pairs = 7\n')
    command = [sys.executable, "-m", "kontronik_can_gw", "metrics", *words]
    paths = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    monkeypatch.chdir(tmp_path)
    program = LoggedProcess([*command, "--listen", "127.0.0.1:0"], paths)
    try:
        end = time.monotonic() + PATIENCE
        while "serves" not in program.log:
            assert time.monotonic() < end
            time.sleep(0.01)
        assert program.log.endswith(shown)
        port = int(program.log.partition("127.0.0.1:")[2].partition("/")[0])
        assert ask(port)[0] == 503
        program.process.send_signal(signal.SIGTERM)
        assert program.process.wait(PATIENCE) == 0
    finally:
        program.kill()
    assert len(program.lines) == 1 + (not words)
