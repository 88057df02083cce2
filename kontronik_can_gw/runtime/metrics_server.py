"""A server for the metrics (prometheus.py) that listens on loopback only.

It never blocks and starts no thread: the owner of the selector calls it. It answers GET of /metrics and /, nothing else, to eight
connections at once and fifty in a second; the ninth ends the oldest. Each has two seconds for everything. The Host header must name
loopback, so that no web page can have a browser ask (DNS rebinding).
"""

import contextlib
import errno
import re
import selectors
import socket
from collections.abc import Mapping
from typing import Any

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.runtime.prometheus import metrics
from kontronik_can_gw.runtime.snapshot import STALE_NS

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
CONNECTIONS = 8
REQUEST_LIMIT = 4096
TIME_LIMIT_NS = 2 * SECOND
_PER_SECOND = 50
"""Connections accepted in a second: a client that asks without end must not take the processor from the loop."""
_REQUEST = re.compile(rb"([A-Z]{1,16}) (/[!-~]*) HTTP/1\.[01]")
_LOOPBACK = re.compile(r"(localhost|127(\.[0-9]{1,3}){3}|\[::1\])(:[0-9]{1,5})?", re.IGNORECASE)
_REASONS = {
    200: "OK",
    400: "Bad Request",
    403: "Forbidden",
    404: "Not Found",
    405: "Method Not Allowed",
    431: "Request Header Fields Too Large",
    503: "Service Unavailable",
}
_AGE = "kontronik_snapshot_age_seconds"

Document = Mapping[str, Any]


class _Connection:
    """One client: its request as far as it has come, then the answer as far as it has not gone."""

    def __init__(self, made: socket.socket, now: int) -> None:
        self.socket = made
        self.due = now + TIME_LIMIT_NS
        self.request = b""
        self.answer = memoryview(b"")


class MetricsServer:
    """Answers on one loopback address. RunError with one clear line where that cannot be had.

    ``document``: the newest one; set by who owns the selector's thread.
    """

    def __init__(self, address: tuple[str, int]) -> None:
        host, port = address
        shown = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        self.document: Document | None = None
        self._text: tuple[Document | None, str] = (None, "")
        self._connections: dict[socket.socket, _Connection] = {}
        self._selector: selectors.BaseSelector | None = None
        self._second = 0
        self._accepted = 0
        self._resume: int | None = None
        try:
            self._listener = socket.socket(
                socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM
            )
        except OSError as error:  # the service's unit leaves network addresses out
            raise RunError(
                f"statistics.prometheus {shown}: cannot be listened to: {error.strerror}. For a service: allow AF_INET and AF_INET6 "
                "in its unit (RestrictAddressFamilies=)."
            ) from None
        try:
            self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._listener.setblocking(False)
            self._listener.bind(address)
            self._listener.listen(CONNECTIONS)
        except OSError as error:
            self._listener.close()
            if error.errno == errno.EADDRINUSE:
                raise RunError(
                    f"statistics.prometheus {shown}: another program listens there. End it, or choose another port."
                ) from None
            raise RunError(
                f"statistics.prometheus {shown}: cannot be listened to: {error.strerror}. Choose another address, or leave it out."
            ) from None
        self.address: tuple[str, int] = self._listener.getsockname()[:2]

    def listen(self, selector: selectors.BaseSelector) -> None:
        """Begin: whatever ``selector`` finds ready and belongs to this server is handed to ``serve``."""
        self._selector = selector
        selector.register(self._listener, selectors.EVENT_READ)

    def pause_s(self, now: int) -> float | None:
        """How long the selector may wait before ``advance`` has something to do; None for ever."""
        due = [connection.due for connection in self._connections.values()]
        if self._resume is not None:
            due.append(self._resume)
        return max(0, min(due) - now) / SECOND if due else None

    def serve(self, ready: object, now: int) -> None:
        """Go on with what is ready."""
        if ready is self._listener:
            self._accept(now)
            return
        connection = self._connections.get(ready) if isinstance(ready, socket.socket) else None
        if connection is None:  # it was ended in favour of a newer one a moment ago
            return
        try:
            if connection.answer:
                self._send(connection)
            else:
                self._read(connection, now)
        except BlockingIOError:
            return
        except OSError:
            self._end(connection)

    def advance(self, now: int) -> None:
        """Let time pass: end who is too slow, accept again."""
        for connection in [c for c in self._connections.values() if now >= c.due]:
            self._end(connection)
        if self._resume is not None and now >= self._resume:
            self._resume = None
            if self._selector is not None and self._listener.fileno() >= 0:
                self._selector.register(self._listener, selectors.EVENT_READ)

    def stop_listening(self) -> None:
        """Give the address back; may be called from elsewhere, when the thread does not answer."""
        self._listener.close()

    def close(self) -> None:
        """End everything."""
        for connection in list(self._connections.values()):
            self._end(connection)
        if self._selector is not None:
            with contextlib.suppress(KeyError, ValueError, OSError):
                self._selector.unregister(self._listener)
        self._listener.close()

    def _accept(self, now: int) -> None:
        if now - self._second >= SECOND:
            self._second, self._accepted = now, 0
        if self._accepted >= _PER_SECOND:
            self._pause(self._second + SECOND)
            return
        try:
            made, _ = self._listener.accept()
        except (BlockingIOError, ConnectionAbortedError):
            return
        except OSError:
            # no descriptor to be had, or closed: what waits would wake us again and again
            self._pause(now + SECOND)
            return
        self._accepted += 1
        made.setblocking(False)
        if len(self._connections) >= CONNECTIONS:
            self._end(next(iter(self._connections.values())))
        connection = self._connections[made] = _Connection(made, now)
        assert self._selector is not None
        self._selector.register(made, selectors.EVENT_READ)
        self.serve(connection.socket, now)  # the request has come with it, as a rule

    def _pause(self, until: int) -> None:
        self._resume = until
        if self._selector is not None:
            with contextlib.suppress(KeyError, ValueError, OSError):
                self._selector.unregister(self._listener)

    def _read(self, connection: _Connection, now: int) -> None:
        data = connection.socket.recv(REQUEST_LIMIT)
        if not data:
            self._end(connection)
            return
        connection.request += data
        status, text = self._answer(connection.request, now)
        if status is None:
            return
        body = text.encode()
        lines = [
            f"HTTP/1.1 {status} {_REASONS[status]}",
            f"Content-Type: {CONTENT_TYPE}",
            f"Content-Length: {len(body)}",
            "Cache-Control: no-store",
            "X-Content-Type-Options: nosniff",
            "Connection: close",
            *(["Allow: GET"] if status == 405 else []),
        ]
        if connection.request.startswith(b"HEAD "):
            body = b""
        connection.answer = memoryview("\r\n".join([*lines, "", ""]).encode() + body)
        self._send(connection)

    def _send(self, connection: _Connection) -> None:
        assert self._selector is not None
        with contextlib.suppress(BlockingIOError):
            while connection.answer:
                connection.answer = connection.answer[connection.socket.send(connection.answer) :]
        if connection.answer:
            self._selector.modify(connection.socket, selectors.EVENT_WRITE)
        else:
            self._end(connection)

    def _end(self, connection: _Connection) -> None:
        del self._connections[connection.socket]
        if self._selector is not None:
            with contextlib.suppress(KeyError, ValueError, OSError):
                self._selector.unregister(connection.socket)
        connection.socket.close()

    def _answer(self, request: bytes, now: int) -> tuple[int | None, str]:
        """Status and body; no status while the request is not complete."""
        head, end, _ = request.partition(b"\r\n\r\n")
        line, *headers = head.split(b"\r\n")
        if (end or headers) and (asked := _REQUEST.fullmatch(line)) is None:
            return 400, "this is no HTTP request that is understood here\n"
        if len(request) > REQUEST_LIMIT or (not end and len(request) == REQUEST_LIMIT):
            return 431, "the request is too long\n"
        if not end:
            return None, ""
        assert asked is not None
        hosts = [
            h.partition(b":")[2].strip()
            for h in headers
            if h.partition(b":")[0].strip().lower() == b"host"
        ]
        if len(hosts) != 1:
            return 400, "exactly one Host header is needed\n"
        if _LOOPBACK.fullmatch(hosts[0].decode("latin-1")) is None:
            return (
                403,
                "only for this machine: the Host header must name localhost, 127.0.0.1 or [::1]\n",
            )
        if asked[1] != b"GET":
            return 405, "only GET\n"
        path = asked[2].partition(b"?")[0]
        if path == b"/":
            return 200, "kontronik-can-gw: statistics for Prometheus are at /metrics\n"
        if path != b"/metrics":
            return 404, "there is only /metrics\n"
        return self._metrics(now)

    def _metrics(self, now: int) -> tuple[int, str]:
        document = self.document
        if document is None:
            return 503, "there are no statistics yet\n"
        age = max(0, now - document["monotonic_ns"])
        if age > STALE_NS:
            return 503, f"the gateway does not answer since {age // SECOND} s\n"
        if self._text[0] is not document:
            self._text = (document, metrics(document))
        text = f"# HELP {_AGE} Age of these statistics.\n# TYPE {_AGE} gauge\n"
        return 200, f"{self._text[1]}{text}{_AGE} {age / SECOND:.3f}\n"
