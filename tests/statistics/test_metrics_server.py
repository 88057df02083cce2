"""The server for Prometheus over real sockets: what it answers, whom it refuses, and that nobody stops it for the others or the file."""

import contextlib
import errno
import json
import os
import random
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest
from prometheus_client.parser import text_string_to_metric_families
from statistics_bench import Bench

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.runtime.prometheus import CONNECTIONS, REQUEST_LIMIT
from kontronik_can_gw.runtime.snapshot import STALE_NS
from kontronik_can_gw.runtime.statistics import Statistics

PATIENCE = 30.0


@pytest.fixture(scope="module")
def example() -> dict[str, Any]:
    bench = Bench(8)
    bench.run(2)
    return bench.document()


class Served:
    """Statistics with a server on a port that the system chose, and a document of this instant."""

    def __init__(self, file: Path, example: dict[str, Any]) -> None:
        self.file = file
        self.example = example
        self.statistics = Statistics(file, ("127.0.0.1", 0))
        assert self.statistics.address is not None
        self.address = self.statistics.address
        self.publish()

    def publish(self) -> None:
        now = time.monotonic_ns()
        self.statistics.publish(self.example | {"monotonic_ns": now})
        self.until_written(now)

    def until_written(self, number: int) -> None:
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            with contextlib.suppress(FileNotFoundError):
                if json.loads(self.file.read_bytes())["monotonic_ns"] >= number:
                    return
            time.sleep(0.002)
        raise AssertionError("the file was not written")

    def connect(self) -> socket.socket:
        return socket.create_connection(self.address, PATIENCE)

    def ask(self, request: bytes) -> bytes:
        """The whole answer to a request; what an abrupt end leaves of it."""
        with self.connect() as client:
            with contextlib.suppress(ConnectionError):
                client.sendall(request)
            return rest_of(client)

    def get(self, path: str = "/metrics", host: str = "localhost", method: str = "GET") -> bytes:
        return self.ask(f"{method} {path} HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())


def rest_of(client: socket.socket) -> bytes:
    found = b""
    with contextlib.suppress(ConnectionError):
        while data := client.recv(1 << 16):
            found += data
    return found


def status_of(answer: bytes) -> int:
    assert answer.startswith(b"HTTP/1.1 "), answer
    return int(answer.split()[1])


@pytest.fixture
def served(tmp_path: Path, example: dict[str, Any]) -> Iterator[Served]:
    made = Served(tmp_path / "status.json", example)
    yield made
    begin = time.monotonic()
    made.statistics.close()
    assert time.monotonic() - begin < 0.2


# --- what it answers


def test_metrics_are_fetched_as_prometheus_does(served: Served) -> None:
    host, port = served.address
    with urlopen(f"http://{host}:{port}/metrics", timeout=PATIENCE) as answer:
        assert answer.headers["Content-Type"] == "text/plain; version=0.0.4; charset=utf-8"
        text = answer.read().decode()
    found = {family.name: family for family in text_string_to_metric_families(text)}
    assert len(found["kontronik_battery_voltage_volts"].samples) == 8
    (age,) = found["kontronik_snapshot_age_seconds"].samples
    assert 0 <= age.value < 3


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:1", "127.0.0.1", "127.0.0.1:9123", "127.9.9.9", "[::1]:5"])
def test_hosts_that_are_this_machine_are_answered(served: Served, host: str) -> None:
    assert status_of(served.get(host=host)) == 200


@pytest.mark.parametrize(
    "host", ["example.com", "localhost.example.com", "127.0.0.1.example.com", "192.168.0.1", "", "evil:9123", "[::2]"]
)
def test_a_page_that_has_its_own_name_lead_here_is_refused(served: Served, host: str) -> None:
    assert status_of(served.get(host=host)) == 403


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n", 200),
        (b"GET /metrics HTTP/1.0\r\nhost:localhost\r\n\r\n", 200),
        (b"GET /metrics?x=1 HTTP/1.1\r\nUser-Agent: x\r\nHost: localhost\r\n\r\n", 200),
        (b"GET /metrics/ HTTP/1.1\r\nHost: localhost\r\n\r\n", 404),
        (b"GET /../../etc/passwd HTTP/1.1\r\nHost: localhost\r\n\r\n", 404),
        (b"POST /metrics HTTP/1.1\r\nHost: localhost\r\nContent-Length: 3\r\n\r\nabc", 405),
        (b"DELETE / HTTP/1.1\r\nHost: localhost\r\n\r\n", 405),
        (b"GET /metrics HTTP/1.1\r\n\r\n", 400),
        (b"GET /metrics HTTP/1.1\r\nHost: localhost\r\nHost: example.com\r\n\r\n", 400),
        (b"GET http://localhost/metrics HTTP/1.1\r\nHost: localhost\r\n\r\n", 400),
        (b"GET /metrics HTTP/2.0\r\nHost: localhost\r\n\r\n", 400),
        (b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", 400),
        (b"get /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n", 400),
        (b"\x16\x03\x01\x02\x00\r\n", 400),
        (b"\r\n\r\n", 400),
        (b"GET /" + b"x" * REQUEST_LIMIT, 431),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"x" * (1 << 20), 431),
    ],
)
def test_only_get_of_two_paths_is_answered_and_the_rest_has_its_status(
    served: Served, request_: bytes, status: int
) -> None:
    assert status_of(served.ask(request_)) == status


def test_head_has_no_body_and_is_told_what_is_allowed(served: Served) -> None:
    answer = served.get(method="HEAD")
    assert status_of(answer) == 405
    assert b"\r\nAllow: GET\r\n" in answer
    assert answer.endswith(b"\r\n\r\n")


def test_a_request_in_single_bytes_is_answered_too(served: Served) -> None:
    with served.connect() as client:
        for byte in b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n":
            client.sendall(bytes([byte]))
            time.sleep(0.001)
        assert status_of(rest_of(client)) == 200


def test_a_frozen_gateway_has_no_values(tmp_path: Path, example: dict[str, Any]) -> None:
    statistics = Statistics(None, ("127.0.0.1", 0))
    served = Served.__new__(Served)
    assert statistics.address is not None
    served.address = statistics.address
    answer = served.get()
    assert status_of(answer) == 503 and b"no statistics yet" in answer
    statistics.publish(example | {"monotonic_ns": time.monotonic_ns() - STALE_NS - 9 * 10**9})
    while b"yet" in (answer := served.get()):
        time.sleep(0.01)
    assert status_of(answer) == 503 and b"does not answer since 12 s" in answer
    assert b"battery" not in answer
    statistics.close()


# --- addresses


def test_an_address_that_is_taken_is_told_at_once_in_one_line_and_leaves_nothing(served: Served) -> None:
    with pytest.raises(RunError) as caught:
        Statistics(None, served.address)
    port = served.address[1]
    expected = f"statistics.prometheus 127.0.0.1:{port}: another program listens there. End it, or choose another port."
    assert caught.value.problems == (expected,)
    assert caught.value.exit_code == 1


def test_a_unit_that_leaves_network_addresses_out_is_told_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise OSError(errno.EAFNOSUPPORT, os.strerror(errno.EAFNOSUPPORT))

    monkeypatch.setattr(socket, "socket", refused)
    with pytest.raises(RunError, match=r"Address family not supported by protocol.*RestrictAddressFamilies="):
        Statistics(None, ("127.0.0.1", 0))


def test_an_address_of_another_machine_is_told_in_one_line() -> None:
    with pytest.raises(RunError, match=r"statistics.prometheus 192.0.2.1:9123: cannot be listened to: Cannot assign"):
        Statistics(None, ("192.0.2.1", 9123))


def test_an_address_is_free_again_at_once_also_after_it_was_used(served: Served) -> None:
    assert status_of(served.get()) == 200
    served.statistics.close()
    again = Statistics(None, served.address)
    assert again.address == served.address
    again.close()
    with pytest.raises(ConnectionRefusedError):
        served.connect()


def test_ipv6_loopback_is_served_where_there_is_one(tmp_path: Path) -> None:
    try:
        statistics = Statistics(None, ("::1", 0))
    except RunError as error:
        pytest.skip(f"no IPv6 on this machine: {error}")
    assert statistics.address is not None
    with socket.create_connection(statistics.address, PATIENCE) as client:
        client.sendall(b"GET / HTTP/1.1\r\nHost: [::1]\r\n\r\n")
        assert status_of(rest_of(client)) == 200
    statistics.close()


# --- abuse


def test_who_says_nothing_is_ended_after_two_seconds(served: Served) -> None:
    begin = time.monotonic()
    with served.connect() as client:
        client.sendall(b"GET /metr")
        assert rest_of(client) == b""
    assert 1.9 < time.monotonic() - begin < 4


def test_who_trickles_is_ended_after_two_seconds_all_the_same(served: Served) -> None:
    begin = time.monotonic()
    with served.connect() as client, contextlib.suppress(ConnectionError):
        while time.monotonic() - begin < PATIENCE:
            client.sendall(b"X")
            time.sleep(0.05)
    assert 1.9 < time.monotonic() - begin < 4


def test_who_does_not_read_is_ended_and_the_others_are_answered(served: Served) -> None:
    with socket.socket() as lazy:
        lazy.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
        lazy.settimeout(PATIENCE)
        lazy.connect(served.address)
        lazy.sendall(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n")
        begin = time.monotonic()
        for _ in range(5):
            assert status_of(served.get()) == 200
        assert time.monotonic() - begin < 1
        time.sleep(2.2)
        served.publish()
        assert status_of(served.get()) == 200


def test_slow_clients_on_all_places_stop_neither_the_others_nor_the_file(served: Served) -> None:
    slow = [served.connect() for _ in range(CONNECTIONS)]
    for client in slow:
        client.sendall(b"GET /metrics HTTP/1.1\r\nHost: loc")
    begin = time.monotonic()
    assert status_of(served.get()) == 200
    served.publish()
    assert time.monotonic() - begin < 1
    for client in slow:
        client.close()


def test_a_hundred_connections_at_once_are_all_got_rid_of(served: Served) -> None:
    crowd: list[socket.socket] = []
    for _ in range(100):
        client = socket.socket()
        client.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            client.connect(served.address)
        crowd.append(client)
    begin = time.monotonic()
    served.publish()
    assert time.monotonic() - begin < 1
    assert status_of(served.get()) == 200
    assert time.monotonic() - begin < 10
    for client in crowd:
        client.close()
    time.sleep(0.1)
    assert status_of(served.get()) == 200


def test_a_flood_of_requests_is_held_to_fifty_in_a_second(served: Served) -> None:
    begin, answered = time.monotonic(), 0
    while time.monotonic() - begin < 2:
        answered += status_of(served.get()) == 200
    assert 20 < answered <= 151


def test_garbage_of_all_kinds_does_no_harm(served: Served) -> None:
    dice = random.Random(1)
    for number in range(40):
        with served.connect() as client, contextlib.suppress(ConnectionError):
            client.sendall(dice.randbytes(dice.choice((1, 10, 300, 5000))))
            if number % 2:
                client.sendall(b"\r\n\r\n")
                rest_of(client)
    served.publish()
    assert status_of(served.get()) == 200


def test_the_end_comes_at_once_with_clients_still_there(served: Served) -> None:
    clients = [served.connect() for _ in range(CONNECTIONS)]
    time.sleep(0.05)
    begin = time.monotonic()
    served.statistics.close()
    assert time.monotonic() - begin < 0.2
    for client in clients:
        assert rest_of(client) == b""
        client.close()


def test_without_descriptors_it_waits_and_goes_on(served: Served) -> None:
    """In a process of its own, whose limit is reached."""
    import subprocess
    import sys

    code = """
import os, resource, socket, sys, time
from kontronik_can_gw.runtime.statistics import Statistics
statistics = Statistics(None, ("127.0.0.1", 0))
client = socket.socket()
resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))
held = []
try:
    while True:
        held.append(os.open("/dev/null", os.O_RDONLY))
except OSError:
    pass
client.settimeout(20)
client.connect(statistics.address)
client.sendall(b"GET / HTTP/1.1\\r\\nHost: localhost\\r\\n\\r\\n")
before = time.process_time()
time.sleep(1.0)
busy = time.process_time() - before
for fd in held:
    os.close(fd)
print(busy < 0.3, client.recv(15))
statistics.close()
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False, cwd=Path.cwd()
    )
    assert done.stdout.strip() == "True b'HTTP/1.1 200 OK'", done.stderr
