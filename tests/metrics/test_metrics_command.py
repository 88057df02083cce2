"""``kontronik-can-gw metrics``: what is answered for a good, a missing, a stale and a damaged status file, and to whom."""

import json
import os
import signal
import socket
import sys
import time
from collections.abc import Iterator
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import Any

import pytest
from command_line import refused, written
from harness import LoggedProcess
from prometheus_client.parser import text_string_to_metric_families
from statistics_bench import Bench

from kontronik_can_gw.desk import metrics_server
from kontronik_can_gw.desk.metrics_server import CONTENT_TYPE, MetricsServer, NoMetrics, metrics_of
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


@pytest.fixture
def server(file: Path, document: dict[str, Any]) -> Iterator[MetricsServer]:
    """On a port that the system chose; for it the document is always half a second old."""
    made = MetricsServer(file, "127.0.0.1", 0, lambda: document["monotonic_ns"] + SECOND // 2)
    yield made
    made.close()


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


def test_metrics_are_fetched_as_prometheus_does(server: MetricsServer) -> None:
    for accept in ("*/*", "application/openmetrics-text;version=1.0.0", "a/b;version=x;;=,"):
        status, kind, text = ask(server.port, Accept=accept)
        assert (status, kind) == (200, CONTENT_TYPE)
        assert text.count("\nkontronik_battery_voltage_volts{") == 8
    status, _, text = ask(server.port, "/metrics?x=1")
    found = {family.name: family for family in text_string_to_metric_families(text)}
    assert found["kontronik_snapshot_age_seconds"].samples[0].value == 0.5


def test_what_the_gateway_replaces_is_read_anew(
    server: MetricsServer, file: Path, document: dict[str, Any]
) -> None:
    file.unlink()
    status, _, text = ask(server.port)
    assert (status, text.startswith(f"{file}: not running: there is no such file.")) == (503, True)
    file.write_text(json.dumps(document | {"version": "9.9.9"}))
    assert 'kontronik_build_info{version="9.9.9"} 1.0' in ask(server.port)[2]


@pytest.mark.parametrize(
    ("age_ns", "said"),
    [(STALE_NS, ""), (STALE_NS + 9 * SECOND, "since 12 s"), (-STALE_NS - 1, "not running")],
)
def test_a_frozen_gateway_and_one_of_before_a_reboot_have_no_values(
    file: Path, document: dict[str, Any], age_ns: int, said: str
) -> None:
    now = document["monotonic_ns"] + age_ns
    if said:
        with pytest.raises(NoMetrics, match=said):
            metrics_of(file, now)
    else:
        assert metrics_of(file, now)


def test_a_damaged_file_is_one_line_and_never_a_traceback(
    tmp_path: Path, document: dict[str, Any]
) -> None:
    now, text = document["monotonic_ns"], json.dumps(document)
    damaged: list[object] = [None, 3, [], "x", {}, {"program": "x"}, document | {"format": 99}]
    for key, value in document.items():
        damaged += [{k: v for k, v in document.items() if k != key}]
        if key in ("can", "escs", "gateway", "monotonic_ns", "nodes", "process", "units"):
            damaged += [document | {key: wrong} for wrong in ("x", 3.5, ["x"]) if wrong != value]
    unused = ("configuration", "time", "log")
    cut = [text[: len(text) * part // 50].encode() for part in range(50)]
    file = tmp_path / "status.json"
    said = []
    for data in [*cut, b"\xff\xfe", b"[" * 100_000, *(json.dumps(d).encode() for d in damaged)]:
        file.write_bytes(data)
        try:
            metrics_of(file, now)
        except NoMetrics as reason:
            said.append(str(reason))
    assert all(str(file) in line and "\n" not in line for line in said)
    # all but documents without keys of no metric, and numbers in another form
    assert len(said) >= len(cut) + 2 + len(damaged) - len(unused) - 2
    file.unlink()
    file.mkdir()
    with pytest.raises(NoMetrics, match="is no plain file"):
        metrics_of(file, now)


@pytest.mark.parametrize(
    ("status", "hosts"),
    [
        (200, ["localhost", "LOCALHOST:1", "127.0.0.1:9123", "127.9.9.9", "[::1]:5"]),
        (403, ["example.com", "localhost.example.com", "127.0.0.1.example.com", "10.0.0.1", ""]),
    ],
)
def test_a_page_that_has_its_own_name_lead_here_is_refused(
    server: MetricsServer, status: int, hosts: list[str]
) -> None:
    assert [ask(server.port, Host=host)[0] for host in hosts] == [status] * len(hosts)


def test_only_get_of_metrics_is_answered(server: MetricsServer) -> None:
    assert ask(server.port, "/")[0] == 200
    for path, method in (("/metrics/", "GET"), ("/x", "GET"), ("/metrics", "POST")):
        assert ask(server.port, path, method)[0] == 404


def is_answered(port: int) -> bool:
    """False where the server turns the client away."""
    try:
        return ask(port)[0] == 200
    except (OSError, HTTPException):
        return False


def test_clients_that_never_come_to_an_end_delay_no_other_and_are_ended(
    server: MetricsServer, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with (
        socket.create_connection(("127.0.0.1", server.port), PATIENCE) as mute,
        socket.create_connection(("127.0.0.1", server.port), PATIENCE) as rude,
    ):
        rude.sendall(b"\x16\x03\x01\x02\x00\r\n\r\n")
        assert ask(server.port)[0] == 200
        mute.send(b"GET /metr")
        assert ask(server.port)[0] == 200
    monkeypatch.setattr(metrics_server._Handler, "timeout", 0.1)
    with socket.create_connection(("127.0.0.1", server.port), PATIENCE) as mute:
        assert mute.recv(1) == b""
    assert "Traceback" not in capfd.readouterr().err


def test_clients_that_never_come_to_an_end_delay_no_other(
    server: MetricsServer, capfd: pytest.CaptureFixture[str]
) -> None:
    with (
        socket.create_connection(("127.0.0.1", server.port)) as mute,
        socket.create_connection(("127.0.0.1", server.port)) as rude,
    ):
        rude.sendall(b"\x16\x03\x01\x02\x00\r\n\r\n")
        assert ask(server.port)[0] == 200
        mute.send(b"GET /metr")
        assert ask(server.port)[0] == 200
    assert "Traceback" not in capfd.readouterr().err


def test_a_client_that_goes_on_for_ever_is_ended_and_too_many_are_turned_away(
    server: MetricsServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    idle = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(8)]
    try:
        for each in idle:
            each.settimeout(60)
            each.send(b"G")
        one_more = socket.create_connection(("127.0.0.1", server.port))
        one_more.settimeout(60)
        assert one_more.recv(1) == b""
    finally:
        for each in idle:
            each.close()
    monkeypatch.setattr(metrics_server, "REQUEST_S", 0.1)
    end = time.monotonic() + 60
    while not is_answered(server.port) and time.monotonic() < end:
        time.sleep(0.01)  # the eight are noticed one by one
    with socket.create_connection(("127.0.0.1", server.port)) as dripping:
        dripping.settimeout(0.01)
        ended = False
        while not ended and time.monotonic() < end:
            try:
                dripping.send(b"G")
                ended = dripping.recv(1) == b""
            except TimeoutError:
                continue
            except OSError:
                ended = True
        assert ended


# --- the command


def test_an_address_that_cannot_be_had_is_one_line_with_the_remedy(
    server: MetricsServer, file: Path
) -> None:
    at = f"127.0.0.1:{server.port}"
    said = refused(1, "metrics", "--file", file, "--listen", at)
    assert said == f"--listen {at}: another program listens there. End it, or choose another port."
    with pytest.raises(RunError, match=r"--listen 192.0.2.1:9123: cannot be listened to: Cannot"):
        MetricsServer(file, "192.0.2.1", 9123)


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
    ("name", "own", "shown"),
    [
        ("gateway.toml", "", "/run/kontronik-can-gw/status.json"),
        ("left.toml", "", "/run/kontronik-can-gw-left/status.json"),
        ("left.toml", '[statistics]\nfile = "own.json"\n', "own.json"),
    ],
)
def test_it_serves_the_file_of_a_configuration_until_sigterm(
    tmp_path: Path, name: str, own: str, shown: str
) -> None:
    config = written(tmp_path / name, f'{own}[[esc]]\nport = "/dev/ttyS0"\npole_pairs = 7\n')
    command = [sys.executable, "-m", "kontronik_can_gw", "metrics", "-c", str(config)]
    paths = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    program = LoggedProcess([*command, "--listen", "127.0.0.1:0"], paths)
    try:
        end = time.monotonic() + PATIENCE
        while not program.lines:
            assert time.monotonic() < end
            time.sleep(0.01)
        assert program.log.endswith(shown)
        port = int(program.log.partition("127.0.0.1:")[2].partition("/")[0])
        assert ask(port)[0] == 503
        program.process.send_signal(signal.SIGTERM)
        assert program.process.wait(PATIENCE) == 0
    finally:
        program.kill()
    assert len(program.lines) == 1
