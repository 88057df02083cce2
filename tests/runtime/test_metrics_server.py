"""The server for Prometheus over real sockets, with its time passed in: what it answers, whom it refuses, and that nobody stops it."""

import contextlib
import errno
import os
import selectors
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest
from prometheus_client.parser import text_string_to_metric_families
from statistics_bench import Bench

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.runtime.metrics_server import (
    CONNECTIONS,
    REQUEST_LIMIT,
    TIME_LIMIT_NS,
    MetricsServer,
)
from kontronik_can_gw.runtime.snapshot import STALE_NS
from kontronik_can_gw.runtime.statistics import Statistics

PATIENCE = 60.0
COMPLETE = b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n"


@pytest.fixture(scope="module")
def example() -> dict[str, Any]:
    bench = Bench(8)
    bench.run(2)
    return bench.document()


class Client(socket.socket):
    """A connection that never waits."""

    def __init__(self, address: tuple[str, int]) -> None:
        super().__init__()
        self.settimeout(PATIENCE)
        self.connect(address)
        self.setblocking(False)
        self.answer = b""
        self.ended = False

    def look(self) -> bool:
        """Take what has come; True when the other side has ended it."""
        try:
            while data := self.recv(1 << 16):
                self.answer += data
            self.ended = True
        except BlockingIOError:
            pass
        except ConnectionError:
            self.ended = True
        return self.ended


class Served:
    """A server on a port that the system chose. Its clock stands still unless a test moves it."""

    def __init__(self, document: dict[str, Any] | None, host: str = "127.0.0.1") -> None:
        self.server = MetricsServer((host, 0))
        self.server.document = document
        self.now = document["monotonic_ns"] if document else 0
        self.selector = selectors.DefaultSelector()
        self.server.listen(self.selector)
        self.clients: list[Client] = []

    def connect(self) -> Client:
        self.clients.append(Client(self.server.address))
        return self.clients[-1]

    def turn(self, wait_s: float = 0.0) -> None:
        for key, _ in self.selector.select(wait_s):
            self.server.serve(key.fileobj, self.now)
        self.server.advance(self.now)

    def until(self, condition: Callable[[], object]) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, "it did not come about"
            self.turn(0.01)

    def accept(self, count: int) -> list[Client]:
        """So many connections that the server has taken."""
        made = [self.connect() for _ in range(count)]
        self.until(lambda: len(self.server._connections) == count)
        return made

    def ask(self, request: bytes) -> bytes:
        """The whole answer to a request; what an abrupt end leaves of it."""
        client, rest = self.connect(), memoryview(request)

        def done() -> bool:
            nonlocal rest
            with contextlib.suppress(BlockingIOError, ConnectionError):
                while rest:
                    rest = rest[client.send(rest) :]
            return client.look()

        self.until(done)
        return client.answer

    def get(self, path: str = "/metrics", host: str = "localhost", method: str = "GET") -> bytes:
        return self.ask(f"{method} {path} HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())

    def close(self) -> None:
        self.server.close()
        self.selector.close()
        for client in self.clients:
            client.close()


def status_of(answer: bytes) -> int:
    assert answer.startswith(b"HTTP/1.1 "), answer
    return int(answer.split()[1])


@pytest.fixture
def served(example: dict[str, Any]) -> Iterator[Served]:
    made = Served(example)
    yield made
    made.close()


# --- what it answers


def test_metrics_are_fetched_as_prometheus_does(tmp_path: Path, example: dict[str, Any]) -> None:
    """By the thread that also writes the file."""
    statistics = Statistics(None, ("127.0.0.1", 0))
    assert statistics.address is not None
    statistics.publish(example | {"monotonic_ns": time.monotonic_ns() + 3600 * SECOND})
    host, port = statistics.address
    end = time.monotonic() + PATIENCE
    text = ""
    while "battery" not in text and time.monotonic() < end:
        with (
            contextlib.suppress(OSError),
            urlopen(f"http://{host}:{port}/metrics", timeout=PATIENCE) as answer,
        ):
            assert answer.headers["Content-Type"] == "text/plain; version=0.0.4; charset=utf-8"
            text = answer.read().decode()
    found = {family.name: family for family in text_string_to_metric_families(text)}
    assert len(found["kontronik_battery_voltage_volts"].samples) == 8
    client = Client(statistics.address)
    statistics.close()
    while not client.look():
        assert time.monotonic() < end
    client.close()


@pytest.mark.parametrize(
    ("status", "hosts"),
    [
        (200, ["localhost", "LOCALHOST:1", "127.0.0.1:9123", "127.9.9.9", "[::1]:5"]),
        (
            403,
            [
                "example.com",
                "localhost.example.com",
                "127.0.0.1.example.com",
                "192.168.0.1",
                "",
                "[::2]",
            ],
        ),
    ],
)
def test_a_page_that_has_its_own_name_lead_here_is_refused(
    served: Served, status: int, hosts: list[str]
) -> None:
    assert [status_of(served.get(host=host)) for host in hosts] == [status] * len(hosts)


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n", 200),
        (b"GET /metrics HTTP/1.0\r\nhost:localhost\r\n\r\n", 200),
        (b"GET /metrics?x=1 HTTP/1.1\r\nUser-Agent: x\r\nHost: localhost\r\n\r\n", 200),
        (b"GET /metrics/ HTTP/1.1\r\nHost: localhost\r\n\r\n", 404),
        (b"HEAD / HTTP/1.1\r\nHost: localhost\r\n\r\n", 405),
        (b"GET /metrics HTTP/1.1\r\n\r\n", 400),
        (b"GET /metrics HTTP/1.1\r\nHost: localhost\r\nHost: example.com\r\n\r\n", 400),
        (b"GET http://localhost/metrics HTTP/1.1\r\nHost: localhost\r\n\r\n", 400),
        (b"\x16\x03\x01\x02\x00\r\n", 400),
        (b"GET /" + b"x" * REQUEST_LIMIT, 431),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"x" * (1 << 20), 431),
    ],
)
def test_only_get_of_two_paths_is_answered_and_the_rest_has_its_status(
    served: Served, request_: bytes, status: int
) -> None:
    answer = served.ask(request_)
    assert status_of(answer) == status
    assert (b"\r\nAllow: GET\r\n" in answer) == (status == 405)
    assert answer.endswith(b"\r\n\r\n") == request_.startswith(b"HEAD"), "HEAD has no body"


def test_a_frozen_gateway_has_no_values(example: dict[str, Any]) -> None:
    served = Served(None)
    answer = served.get()
    assert status_of(answer) == 503 and b"no statistics yet" in answer
    served.server.document = example
    served.now = example["monotonic_ns"] + STALE_NS + 9 * SECOND
    answer = served.get()
    assert status_of(answer) == 503 and b"does not answer since 12 s" in answer
    assert b"battery" not in answer
    served.close()


# --- addresses


def test_an_address_that_cannot_be_had_is_one_line_with_the_remedy(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = r"statistics.prometheus 127.0.0.1:\d+: another program listens there. End it, or choose another port."
    with pytest.raises(RunError, match=taken) as caught:
        Statistics(None, served.server.address)
    assert caught.value.exit_code == 1
    with pytest.raises(
        RunError,
        match=r"statistics.prometheus 192.0.2.1:9123: cannot be listened to: Cannot assign",
    ):
        MetricsServer(("192.0.2.1", 9123))

    def refused(*_: object) -> None:
        raise OSError(errno.EAFNOSUPPORT, os.strerror(errno.EAFNOSUPPORT))

    monkeypatch.setattr(socket, "socket", refused)
    with pytest.raises(
        RunError, match=r"Address family not supported by protocol.*RestrictAddressFamilies="
    ):
        MetricsServer(("127.0.0.1", 0))


def test_an_address_is_free_again_at_once_also_after_it_was_used(served: Served) -> None:
    assert status_of(served.get()) == 200
    served.server.close()
    again = MetricsServer(served.server.address)
    assert again.address == served.server.address
    again.close()
    with pytest.raises(ConnectionRefusedError):
        served.connect()


# --- abuse


@pytest.mark.parametrize("trickles", [False, True])
def test_who_does_not_come_to_an_end_is_ended_after_two_seconds(
    served: Served, trickles: bool
) -> None:
    (client,) = served.accept(1)
    client.send(b"GET /metr")
    for _ in range(19):
        served.now += TIME_LIMIT_NS // 20
        served.turn()
        assert not client.look()
        if trickles:
            client.send(b"X")
    assert served.server.pause_s(served.now) == pytest.approx(0.1)
    served.now += TIME_LIMIT_NS // 20
    served.until(client.look)
    assert client.answer == b""


def test_who_does_not_read_is_ended_and_the_others_are_answered(served: Served) -> None:
    # those that it accepts have it, too
    served.server._listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    lazy = socket.socket()
    lazy.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
    lazy.connect(served.server.address)
    lazy.send(COMPLETE)
    served.until(lambda: any(c.answer for c in served.server._connections.values()))
    assert status_of(served.get()) == 200
    served.now += TIME_LIMIT_NS
    served.until(lambda: not served.server._connections)
    lazy.close()
    assert status_of(served.get()) == 200


def test_slow_clients_on_all_places_do_not_stop_the_others(served: Served) -> None:
    for client in served.accept(CONNECTIONS):
        client.send(b"GET /metrics HTTP/1.1\r\nHost: loc")
    assert status_of(served.get()) == 200
    assert len(served.server._connections) == CONNECTIONS - 1, "the oldest had to go"


def test_a_flood_of_connections_is_held_to_fifty_in_a_second(served: Served) -> None:
    assert [status_of(served.get()) for _ in range(50)] == [200] * 50
    late = served.connect()
    late.send(COMPLETE)
    served.until(lambda: served.server.pause_s(served.now) == 1.0)
    served.now += SECOND - 1
    served.turn()
    assert served.selector.select(0) == []
    served.now += 1
    served.until(late.look)
    assert status_of(late.answer) == 200


def test_without_descriptors_it_waits_a_second_and_goes_on(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none_left(_listener: socket.socket) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    client = served.connect()
    client.send(COMPLETE)
    with monkeypatch.context() as patch:
        patch.setattr(socket.socket, "accept", none_left)
        served.until(lambda: served.server.pause_s(served.now) == 1.0)
        assert served.selector.select(0) == [], "it does not spin"
    served.now += SECOND
    served.until(client.look)
    assert status_of(client.answer) == 200
