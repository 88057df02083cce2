"""``kontronik-can-gw metrics``: what is answered for a good, a missing, a stale and a damaged status file, and to whom."""

import json
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import pytest
from command_line import refused, written
from prometheus_client.parser import text_string_to_metric_families
from statistics_bench import Bench
from vcan_tools import GatewayProcess

from kontronik_can_gw.desk import metrics
from kontronik_can_gw.desk.metrics import server_of
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


def ask(port: int, path: str = "/metrics", **headers: str) -> tuple[int, str, str]:
    """Status, content type and text of an answer."""
    with closing(HTTPConnection("127.0.0.1", port, timeout=PATIENCE)) as connection:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.headers["Content-Type"], answer.read().decode()


def test_the_newest_metrics_are_fetched_as_prometheus_does(
    port: int, file: Path, clock: Clock, document: dict[str, Any]
) -> None:
    for accept in ("*/*", "application/openmetrics-text;version=1.0.0", "a/b;version=x;;=,"):
        status, _, text = ask(port, Accept=accept)
        assert (status, text.count("\nkontronik_battery_voltage_volts{")) == (200, 8)
    kind, text = ask(port, "/metrics?x=1")[1:]
    assert kind == "text/plain; version=0.0.4; charset=utf-8"
    found = {family.name: family for family in text_string_to_metric_families(text)}
    assert found["kontronik_snapshot_age_seconds"].samples[0].value == 0.5
    file.unlink()
    assert ask(port)[0] == 503
    file.write_text(json.dumps(document | {"version": "9.9.9"}))
    assert 'kontronik_build_info{version="9.9.9"} 1.0' in ask(port)[2]
    for age_ns, said in ((STALE_NS + 9 * SECOND, "for 12.0 s"), (-STALE_NS - 1, "not running")):
        clock.now = document["monotonic_ns"] + age_ns
        status, _, text = ask(port)
        assert (status, said in text) == (503, True)


@pytest.mark.parametrize(
    ("status", "hosts"),
    [
        (200, ["localhost", "LOCALHOST:1", "127.0.0.1:9123", "[::1]:5"]),
        (403, ["example.com", "localhost.example.com", "127.0.0.1.example.com", "10.0.0.1", ""]),
    ],
)
def test_a_page_that_has_its_own_name_lead_here_is_refused(
    port: int, status: int, hosts: list[str]
) -> None:
    assert [ask(port, Host=host)[0] for host in hosts] == [status] * len(hosts)


def test_a_damaged_file_is_one_line_and_never_a_traceback(
    port: int, file: Path, document: dict[str, Any], capfd: pytest.CaptureFixture[str]
) -> None:
    text = json.dumps(document)
    damaged: list[object] = [None, 3, [], "x", {}, {"program": "x"}, document | {"format": 99}]
    for key in ("can", "escs", "gateway", "monotonic_ns", "process", "units"):
        damaged += [{k: v for k, v in document.items() if k != key}, document | {key: ["x"]}]
    cut = [text[: len(text) * part // 9].encode() for part in range(9)]
    for data in [*cut, b"\xff\xfe", b"[" * 100_000, *(json.dumps(d).encode() for d in damaged)]:
        file.write_bytes(data)
        status, _, line = ask(port)
        assert (status, str(file) in line, line.count("\n")) == (503, True, 1), data[:99]
    assert "Traceback" not in capfd.readouterr().err


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


def test_without_the_library_its_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in list(sys.modules):
        if name.startswith(("prometheus_client", "kontronik_can_gw.desk.metrics")):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    said = refused(1, "metrics", "--listen", "127.0.0.1:0")
    assert said == "needs prometheus-client: pip install 'kontronik-can-gw[metrics]'"


def test_it_serves_the_file_of_a_configuration_on_this_machine_until_sigterm(
    tmp_path: Path, port: int, file: Path
) -> None:
    text = '[[esc]]\nport = "/dev/ttyS0"\n[statistics]\nfile = '
    toml = written(tmp_path / "g.toml", f'{text}"own.json"\n')
    for text in ("0.0.0.0:9123", "10.0.0.1:1", "9123", "localhost:x", "[::]:1"):
        assert "is no port on this machine" in refused(2, "metrics", toml, "--listen", text)
    said = refused(1, "metrics", "--file", file, "--listen", f"127.0.0.1:{port}")
    assert "cannot be listened to: Address already in use. Choose another" in said
    program = GatewayProcess(None, toml, "--listen", "127.0.0.1:0", command="metrics")
    try:
        program.wait_for_line(f"serves {tmp_path}/own.json")
        assert ask(int(program.log.partition("127.0.0.1:")[2].partition("/")[0]))[0] == 503
        assert program.end() == 0
    finally:
        program.kill()
