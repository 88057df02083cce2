"""Damaged requests, slow clients and oversized requests do not disturb a good client."""

import json
import os
import random
import re
import socket
import threading
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from harness import LoggedProcess
from live_bench import wait_until
from simulated_bus import flight, layout_of, write_log
from vcan_tools import PROGRAM

pytestmark = [
    pytest.mark.promise("live-access"),
    pytest.mark.extended,
]

COUNT = 20_000
SLOW = 200
GROWTH_BYTES = 24 << 20
GOOD = b"GET /static/live.js HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
PARTS = (
    b"GET / HTTP/1.1\r\n",
    b"HEAD /events HTTP/1.1\r\n",
    b"GET /flights.json HTTP/1.0\r\n",
    b"GET /flights/0123/report HTTP/1.1\r\n",
    b"GET /make/0123/report HTTP/1.1\r\nX-Kontronik-Page: 1\r\n",
    b"POST / HTTP/1.1\r\nContent-Length: 100000\r\n",
    b"GET /?token=%00%ff HTTP/1.1\r\n",
    b"GET /" + b"../" * 50 + b"etc/passwd HTTP/1.1\r\n",
    b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
    b"GET / HTTP/1.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n",
    b"Host: 127.0.0.1\r\n",
    b"Host: [::\r\n",
    b"Cookie: kontronik-8044=" + b"x" * 300 + b"\r\n",
    b"Cookie: ;;=;\xff\r\n",
    b"Transfer-Encoding: chunked\r\n\r\nFFFFFFFFFFFF\r\n",
    b"Content-Length: -1\r\n",
    b"Range: bytes=0-,5-1,999999999999999999-\r\n",
    b"X: " + b"y" * 70_000 + b"\r\n",
    b"X\0Y: 1\r\n",
    b"\r\n",
)


class Served(LoggedProcess):
    """A separate process of ``web`` with a recording."""

    def __init__(self, folder: Path) -> None:
        log = write_log(folder / "flight.log", flight(layout_of(["esc1"]), 5))
        words = ["web", str(log), "--listen", "127.0.0.1:0", "--captures", str(folder)]
        super().__init__([*map(str, PROGRAM), *words, "--cache", str(folder / "cache")])
        wait_until(lambda: re.search(r"http://127.0.0.1:(\d+)/", self.log), "the address")
        found = re.search(r"http://127.0.0.1:(\d+)/", self.log)
        assert found is not None
        self.port = int(found[1])

    @property
    def memory(self) -> int:
        """Resident memory in bytes."""
        pages = Path(f"/proc/{self.process.pid}/statm").read_text().split()[1]
        return int(pages) * os.sysconf("SC_PAGESIZE")


class GoodClient:
    """A client that counts its updates."""

    def __init__(self, port: int) -> None:
        self.count = 0
        self._answer = urllib.request.urlopen(f"http://127.0.0.1:{port}/events", timeout=60)
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self._answer:
            if line.startswith(b"data: {") and b'"notices"' in line:
                json.loads(line[6:])
                self.count += 1

    def expect_updates(self) -> None:
        before = self.count
        wait_until(lambda: self.count > before + 3, "updates of the good client")


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    process = Served(tmp_path)
    yield process
    process.process.terminate()
    assert process.wait() == 0
    assert "Traceback" not in process.log
    assert len(process.log.splitlines()) == 1, process.log


def damaged(rng: random.Random) -> bytes:
    """Return one or more requests with random parts and bytes."""
    if rng.random() < 0.05:
        return rng.randbytes(rng.randrange(3000))
    request = b"".join(rng.choices(PARTS, k=rng.randrange(1, 6))) + b"\r\n"
    spoilt = bytearray(request)
    for _ in range(rng.randrange(6)):
        spoilt[rng.randrange(len(spoilt))] = rng.randrange(256)
    if rng.random() < 0.2:
        del spoilt[rng.randrange(len(spoilt)) :]
    return bytes(spoilt)


def ask(port: int, request: bytes, read: bool) -> bytes:
    """Send bytes on a new connection, and return the begin of the answer."""
    with socket.create_connection(("127.0.0.1", port), timeout=20) as sock:
        try:
            sock.sendall(request)
            if not read:
                return b""
            if request != GOOD:  # a damaged request may have no end
                sock.shutdown(socket.SHUT_WR)
            return sock.recv(4096)
        except OSError:
            return b""


def test_damaged_requests_leave_no_trace(served: Served) -> None:
    client = GoodClient(served.port)
    client.expect_updates()
    ask(served.port, GOOD, True)
    rng = random.Random(44)
    before = served.memory
    name = socket.gethostname().encode()
    for number in range(COUNT):
        answer = ask(served.port, damaged(rng), rng.random() < 0.8)
        if answer:
            assert re.match(rb"HTTP/1\.1 (200|204|403|404|405|421|400|431|503) ", answer), answer
            wrong = not answer.startswith(b"HTTP/1.1 200")
            assert not (wrong and (b"/usr" in answer or b"python" in answer.lower()))
            assert not (wrong and len(name) > 3 and name in answer)
        if number % 2000 == 0:
            client.expect_updates()
    client.expect_updates()
    assert ask(served.port, GOOD, True).startswith(b"HTTP/1.1 200")
    assert served.memory - before < GROWTH_BYTES


def test_slow_clients_do_not_hold_up_others(served: Served) -> None:
    """Some send their request byte by byte, others accept no data."""
    client = GoodClient(served.port)
    client.expect_updates()
    before = served.memory
    slow = []
    for number in range(SLOW):
        sock = socket.socket()
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        sock.settimeout(20)
        sock.connect(("127.0.0.1", served.port))
        sock.sendall(b"GET /events HTTP/1.1\r\nHost: 127.0.0.1\r\n" + b"\r\n" * (number % 2))
        slow.append(sock)
    for _ in range(30):
        for sock in slow[::2]:
            try:
                sock.sendall(b"X")
            except OSError:
                continue
        client.expect_updates()
    # others are still served, because the waiting connections make room
    wait_until(lambda: ask(served.port, GOOD, True).startswith(b"HTTP/1.1 200"), "an answer")
    assert served.memory - before < GROWTH_BYTES
    for sock in slow:
        sock.close()
    client.expect_updates()


def test_oversized_requests_end_early(served: Served) -> None:
    client = GoodClient(served.port)
    before = served.memory
    for request in (
        b"GET /" + b"a" * 10_000_000,
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"y" * 10_000_000,
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n" + b"X: y\r\n" * 1_000_000,
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9999999999\r\n\r\n"
        + b"z" * 50_000_000,
    ):
        ask(served.port, request, True)
    time.sleep(0.1)
    client.expect_updates()
    assert served.memory - before < GROWTH_BYTES
