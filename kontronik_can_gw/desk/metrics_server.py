"""Serves the metrics of one gateway's status file on a loopback address, by prometheus_client and the standard library's WSGI server."""

import contextlib
import errno
import re
import socket
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, make_server

from prometheus_client import CollectorRegistry, Metric, generate_latest
from prometheus_client.exposition import ThreadingWSGIServer

from kontronik_can_gw.desk.metrics import families
from kontronik_can_gw.desk.monitor.status import FOREIGN, MALFORMED, NOT_RUNNING, look_at
from kontronik_can_gw.errors import RunError

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
REQUEST_S = 5.0
"""Maximum time of a connection."""
MAX_CLIENTS = 8
"""At a time; others are turned away."""
_LOOPBACK = re.compile(r"(localhost|127(\.[0-9]{1,3}){3}|\[::1\])(:[0-9]{1,5})?", re.IGNORECASE)


class NoMetrics(Exception):
    """The status file says nothing of now; the text says why."""


class Collected:
    """Metrics that are made already, as prometheus_client takes them."""

    def __init__(self, metrics: list[Metric]) -> None:
        self._metrics = metrics

    def collect(self) -> list[Metric]:
        return self._metrics


def metrics_of(file: Path, now: int) -> list[Metric]:
    """The metrics of a status file at ``now`` (monotonic). NoMetrics where it is missing, stale or damaged."""
    seen = look_at(file, now)
    if seen.code == NOT_RUNNING or seen.document is None:
        raise NoMetrics(f"{file}: {seen.sentence.removeprefix(f'{file}: ')}")
    try:
        return families(seen.document, max(0, seen.age_s or 0))
    except MALFORMED:
        raise NoMetrics(f"{file}: {FOREIGN}") from None


class _Server(ThreadingWSGIServer):
    def __init__(self, *arguments: Any, **more: Any) -> None:
        self._places = threading.BoundedSemaphore(MAX_CLIENTS)
        super().__init__(*arguments, **more)

    def process_request(self, request: Any, client_address: Any) -> None:
        if self._places.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve a client, for no longer than ``REQUEST_S``."""
        end = threading.Timer(REQUEST_S, _end, (request,))
        end.daemon = True
        end.start()
        try:
            super().process_request_thread(request, client_address)
        finally:
            end.cancel()
            self._places.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that ends early or never comes to an end is no fault of ours."""


def _end(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):  # it has ended already
        connection.shutdown(socket.SHUT_RDWR)


class _Server6(_Server):
    address_family = socket.AF_INET6


class _Handler(WSGIRequestHandler):
    def log_message(self, *_: object) -> None:
        """A log of all requests is of no use."""


class MetricsServer:
    """Answers until ``close``. RunError with one clear line where it cannot listen."""

    def __init__(
        self, file: Path, host: str, port: int, clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._file, self._clock = file, clock
        where = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        try:
            kind = _Server6 if ":" in host else _Server
            self._server = make_server(host, port, self._answer, kind, _Handler)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                reason = "another program listens there. End it, or choose another port."
            else:
                reason = f"cannot be listened to: {error.strerror}. Choose another address."
            raise RunError(f"--listen {where}: {reason}") from None
        self.port: int = self._server.server_port
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End, and give the address back."""
        self._server.shutdown()
        self._server.server_close()

    def _answer(self, environ: dict[str, Any], start: Callable[..., Any]) -> Iterable[bytes]:
        """The metrics, or the reason why there are none. A WSGI application."""
        if _LOOPBACK.fullmatch(environ.get("HTTP_HOST", "")) is None:
            # no web page may have a browser ask (DNS rebinding)
            text = "only for this machine: the Host header must name localhost"
            return _refusal("403 Forbidden", text, start)
        if environ["REQUEST_METHOD"] != "GET" or environ["PATH_INFO"] not in ("/", "/metrics"):
            return _refusal("404 Not Found", "there is only GET /metrics", start)
        try:
            found = metrics_of(self._file, self._clock())
        except NoMetrics as reason:
            return _refusal("503 Service Unavailable", str(reason), start)
        registry = CollectorRegistry(auto_describe=False)
        registry.register(Collected(found))
        start("200 OK", [("Content-Type", CONTENT_TYPE), ("Cache-Control", "no-store")])
        return [generate_latest(registry)]


def _refusal(status: str, text: str, start: Callable[..., Any]) -> list[bytes]:
    start(status, [("Content-Type", "text/plain; charset=utf-8")])
    return [f"{text}\n".encode(errors="replace")]
