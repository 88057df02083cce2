"""A served page on a bus that the test feeds, and connections that can lose all data."""

import contextlib
import http.client
import queue
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Any, Self

from simulated_bus import Timed, layout_of

from kontronik_can_gw.desk.live.content import Content
from kontronik_can_gw.desk.live.flights import Flights
from kontronik_can_gw.desk.live.server import Hub, LiveServer, feed, listen
from kontronik_can_gw.desk.sources import Source, Take
from kontronik_can_gw.frames import CanFrame


class FedBus(Source):
    """A bus whose frames and clock the test sets."""

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__("vcan7", layout_of(names))
        self._items: queue.Queue[tuple[int, CanFrame | None]] = queue.Queue()
        self._now_ns = 0

    def feed(self, frames: Timed, until_ns: int | None = None) -> None:
        """Pass frames to the page, and wait until it has taken them. Set the clock to the end."""
        for item in frames:
            self._items.put(item)
        if until_ns is not None:
            self._items.put((until_ns, None))
        self._items.join()

    def pump(self, take: Take, until_s: float) -> None:
        while (left := until_s - time.monotonic()) > 0:
            try:
                now, frame = self._items.get(timeout=left)
            except queue.Empty:
                return
            self._now_ns = max(self._now_ns, now)
            if frame is not None:
                take(frame, self._now_ns)
            self._items.task_done()

    def now(self) -> int:
        return self._now_ns


class ServedPage:
    """The served page of a source. ``stop`` and ``start`` restart its server at the same port."""

    def __init__(
        self,
        source: Source,
        token: str | None = None,
        flights: Flights | None = None,
    ) -> None:
        self.source = source
        self._token = token
        self._flights = flights or Flights()
        self.port = 0
        self.start()

    def start(self) -> None:
        self.content = Content(self.source)
        self.hub = Hub(self.content)
        sock = listen("127.0.0.1", self.port)
        self.port = sock.getsockname()[1]
        self._server = LiveServer(self.hub, sock, self._token, self._flights)
        self._is_stopped = threading.Event()
        arguments = (self.source, self.hub, self._is_stopped.is_set)
        self._threads = [
            threading.Thread(target=feed, args=arguments),
            threading.Thread(target=self._server.serve),
        ]
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        self._is_stopped.set()
        self._server.stop()
        for thread in self._threads:
            thread.join()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def get(
        self, path: str, method: str = "GET", **headers: str
    ) -> tuple[int, dict[str, str], bytes]:
        """Return status, headers and body of a request. ``_`` in a header's name means ``-``."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        named = {name.replace("_", "-"): text for name, text in headers.items()}
        connection.request(method, path, headers=named)
        answer = connection.getresponse()
        found = {name.lower(): text for name, text in answer.getheaders()}
        body = answer.read()
        connection.close()
        return answer.status, found, body

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


class Line:
    """TCP connections to a port that can lose everything without closing: ``is_cut``.

    With ``delay_s``, all data arrive so much later.
    """

    def __init__(self, port: int) -> None:
        self._port = port
        self.is_cut = False
        self.delay_s = 0.0
        self._held: deque[tuple[float, socket.socket, bytes]] = deque()
        """Data that wait for their time of arrival."""
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._pairs: dict[socket.socket, socket.socket] = {}
        self._is_stopped = False
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def _run(self) -> None:
        while not self._is_stopped:
            if self.is_cut:
                time.sleep(0.02)
                continue
            readable, _, _ = select.select([self._listener, *self._pairs], [], [], 0.02)
            for sock in readable:
                if sock is self._listener:
                    self._connect(sock.accept()[0])
                elif sock in self._pairs:
                    self._forward(sock)
            while self._held and self._held[0][0] <= time.monotonic():
                _, other, data = self._held.popleft()
                with contextlib.suppress(OSError):
                    other.sendall(data)

    def _connect(self, client: socket.socket) -> None:
        try:
            server = socket.create_connection(("127.0.0.1", self._port))
        except OSError:
            client.close()
            return
        self._pairs[client] = server
        self._pairs[server] = client

    def _forward(self, sock: socket.socket) -> None:
        other = self._pairs[sock]
        try:
            data = sock.recv(1 << 16)
            if data:
                self._held.append((time.monotonic() + self.delay_s, other, data))
                return
        except OSError:
            pass
        for each in (sock, other):
            del self._pairs[each]
            each.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._is_stopped = True
        self._thread.join()
        for sock in (self._listener, *self._pairs):
            sock.close()


def wait_until(condition: Any, what: str, timeout_s: float = 20) -> Any:
    """Return the first true result of a function. The timeout only ends a test that hangs."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        found = condition()
        if found:
            return found
        time.sleep(0.02)
    raise AssertionError(f"not within {timeout_s} s: {what}")
