"""The statistics for Prometheus: a document as text (exposition format 0.0.4), and a server for it that listens on loopback only.

``MetricsServer`` never blocks and starts no thread: who owns the selector calls it. It answers GET of /metrics and /, nothing else, to
eight connections at once and fifty in a second; the ninth ends the oldest. Each has two seconds for everything. The Host header must name
loopback, so that no web page can have a browser ask (DNS rebinding).
"""

import contextlib
import errno
import re
import selectors
import socket
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from kontronik_can_gw.canopen.nmt import NmtState
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.kontronik.states import ErrorBit, OperatingError, SelfTestError
from kontronik_can_gw.esc.telemetry import SECOND, LinkState
from kontronik_can_gw.esc.values import CanState, GatewayState
from kontronik_can_gw.runtime.snapshot import STALE_NS, name_in_words

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
CONNECTIONS = 8
REQUEST_LIMIT = 4096
TIME_LIMIT_NS = 2 * SECOND
_PER_SECOND = 50
"""Connections accepted in a second: whoever asks without end must not take the processor from the loop."""
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
_PREFIX = "kontronik_"
_BASE_UNITS: Mapping[str, tuple[str, float, float]] = {
    # unit: its base unit, and value * multiplier / divisor
    "V": ("volts", 1, 1),
    "A": ("amperes", 1, 1),
    "W": ("watts", 1, 1),
    "Wh": ("joules", 3600, 1),
    "mAh": ("coulombs", 3600, 1000),
    "°C": ("celsius", 1, 1),
    "%": ("ratio", 1, 100),
    "s": ("seconds", 1, 1),
    "µs": ("seconds", 1, 1_000_000),
    "1/min": ("revolutions_per_second", 1, 60),
    "": ("", 1, 1),
}
_RENAMED = {"cell_count": "cells"}
"""Names that no gauge may have: promtool keeps _count for summaries."""
_COUNTED = ("energy_used", "motor_run_time")
"""Values that only grow while the process runs."""

Labels = Mapping[str, object]
Sample = tuple[Labels, float | None]
Document = Mapping[str, Any]


def metrics(document: Document) -> str:
    """All metrics of a document. What is not available is left out."""
    lines: list[str] = []
    for name, kind, text, samples in _families(document):
        known = [(labels, value) for labels, value in samples if value is not None]
        if known:
            lines += [f"# HELP {_PREFIX}{name} {text}", f"# TYPE {_PREFIX}{name} {kind}"]
            lines += [
                f"{_PREFIX}{name}{_label_text(labels)} {_number(value)}" for labels, value in known
            ]
    return "\n".join(lines) + "\n"


Family = tuple[str, str, str, Iterable[Sample]]


def _families(document: Document) -> Iterator[Family]:
    process, can, escs = document["process"], document["can"], document["escs"]
    yield "build_info", "gauge", "The version that runs.", [({"version": document["version"]}, 1)]
    yield "uptime_seconds", "gauge", "Time since the gateway started.", [({}, process["uptime_s"])]
    for name, key in (
        ("resident_memory_bytes", "rss_bytes"),
        ("open_fds", "open_fds"),
        ("threads", "threads"),
    ):
        yield (
            f"process_{name}",
            "gauge",
            f"The process: {name.replace('_', ' ')}.",
            [({}, process[key] or None)],
        )
    state = document["gateway"]["state"]
    yield (
        "gateway_state",
        "gauge",
        "State of the gateway: 1 for the one it is in.",
        _states({}, GatewayState, state),
    )
    yield (
        "gateway_escs",
        "gauge",
        "ESCs that are configured.",
        [({}, document["gateway"]["esc_count"])],
    )
    yield (
        "gateway_escs_ok",
        "gauge",
        "ESCs with fresh telemetry.",
        [({}, document["gateway"]["escs_ok"])],
    )

    names = {"interface": can["interface"], "channel": can["channel"]}
    yield "can_info", "gauge", "The CAN interface.", [(names, 1)]
    yield "can_bitrate", "gauge", "Bit rate of the CAN bus in bit/s.", [({}, can["bitrate"])]
    yield (
        "can_state",
        "gauge",
        "State of the CAN controller: 1 for the one it is in.",
        _states({}, CanState, can["state"]),
    )
    yield "can_open", "gauge", "1 while the CAN interface is open.", [({}, int(can["open"]))]
    yield "can_stalled", "gauge", "1 while the bus takes no frame.", [({}, int(can["stalled"]))]
    for number, way in enumerate(("transmit", "receive")):
        count = None if can["error_counters"] is None else can["error_counters"][number]
        yield (
            f"can_{way}_errors",
            "gauge",
            f"The CAN controller's {way} error counter.",
            [({}, count)],
        )
    for name, value in can["counters"].items():
        text = f"CAN: {name.removesuffix('_count').replace('_', ' ')} since start."
        yield f"can_{name.removesuffix('_count')}_total", "counter", text, [({}, value)]

    yield from _links(escs)
    yield from _values(document)
    yield from _nodes(document)
    if document["store"] is not None:
        yield (
            "store_waiting",
            "gauge",
            "Parameters that wait for the disk.",
            [({}, document["store"]["waiting"])],
        )
        failed = int(document["store"]["last_error"] is not None)
        yield "store_failed", "gauge", "1 if the last saving of parameters failed.", [({}, failed)]
    if (recording := document["recording"]) is not None:
        yield (
            "recording_bytes_total",
            "counter",
            "Bytes of captures written since start.",
            [({}, recording["bytes"])],
        )
        text = "Entries that could not be recorded since start."
        yield "recording_lost_total", "counter", text, [({}, recording["lost"])]
        yield (
            "recording_failed",
            "gauge",
            "1 while nothing can be recorded.",
            [({}, int(recording["problem"] != ""))],
        )


def _links(escs: Iterable[Document]) -> Iterator[Family]:
    """What is known of each ESC's line, whether it is heard or not."""
    yield (
        "esc_fresh",
        "gauge",
        "1 while the ESC's live values are fresh.",
        [(_of(e), int(e["fresh"])) for e in escs],
    )
    states = [sample for esc in escs for sample in _states(_of(esc), LinkState, esc["link"])]
    yield "esc_link_state", "gauge", "State of the ESC's line: 1 for the one it is in.", states
    described = [
        (_of(e) | {key: e[key] or "" for key in ("layout", "device", "variant", "firmware")}, 1)
        for e in escs
        if e["device"] is not None
    ]
    yield "esc_info", "gauge", "What the ESC tells of itself.", described
    yield (
        "esc_port_open",
        "gauge",
        "1 while the serial port is open.",
        [(_of(e), int(e["port"]["open"])) for e in escs],
    )
    reopened = [(_of(e), e["port"]["reopened"]) for e in escs]
    yield (
        "esc_port_reopened_total",
        "counter",
        "How often the serial port was opened again.",
        reopened,
    )
    kinds = [
        (_of(e) | {"kind": kind}, count)
        for e in escs
        for kind, count in e["port"]["line_errors"].items()
    ]
    yield (
        "esc_port_line_errors_total",
        "counter",
        "Line errors that the serial driver counted, by kind.",
        kinds,
    )
    yield (
        "esc_frame_rate_hertz",
        "gauge",
        "Live frames in a second.",
        [(_of(e), e["frame_rate_hz"]) for e in escs],
    )
    ages = [(_of(e), None if e["data_age_ms"] is None else e["data_age_ms"] / 1000) for e in escs]
    yield (
        "esc_data_age_seconds",
        "gauge",
        "Age of the newest live frame when the snapshot was made.",
        ages,
    )
    yield (
        "esc_losses_total",
        "counter",
        "How often telemetry was lost.",
        [(_of(e), e["losses"]) for e in escs],
    )
    for name in escs[0]["counters"] if isinstance(escs, list) and escs else ():
        counts = [(_of(e), e["counters"][name]) for e in escs]
        yield (
            f"esc_{_counter_name(name)}_total",
            "counter",
            f"The ESC's stream: {name.replace('_', ' ')}.",
            counts,
        )


def _values(document: Document) -> Iterator[Family]:
    """What the ESCs measure, in base units."""
    escs = document["escs"]
    for name, unit in document["units"].items():
        base, multiplier, divisor = _BASE_UNITS[unit]
        kind = "counter" if name in _COUNTED else "gauge"
        full = "_".join(
            filter(None, (_RENAMED.get(name, name), base, "total" if kind == "counter" else ""))
        )
        text = (
            f"The ESC's {name.replace('_', ' ')}{' in ' + base.replace('_', ' ') if base else ''}."
        )
        values = [(_of(e), e["values"][name]) for e in escs]
        yield (
            full,
            kind,
            text,
            [(of, v if v is None or not base else v * multiplier / divisor) for of, v in values],
        )
    for name, key, bits in (
        ("operating_error", ("errors", "warnings", "statuses"), OperatingError),
        ("selftest_error", ("selftest_errors",), SelfTestError),
    ):
        flags = [flag for esc in escs for flag in _flags(esc, key, bits)]
        yield (
            name,
            "gauge",
            f"1 while the bit of the ESC's {name.replace('_', ' ')} word is set.",
            flags,
        )


def _nodes(document: Document) -> Iterator[Family]:
    known = [node for node in document["nodes"] if node["node_id"] is not None]
    of = [{"esc": node["esc"], "node_id": node["node_id"]} for node in known]
    states = [
        s
        for labels, node in zip(of, known, strict=True)
        for s in _states(labels, NmtState, node["state"])
    ]
    yield (
        "canopen_node_state",
        "gauge",
        "NMT state of the CANopen node: 1 for the one it is in.",
        states,
    )
    sent = [(labels, node["pdos_sent"]) for labels, node in zip(of, known, strict=True)]
    yield "canopen_pdos_sent_total", "counter", "PDOs that the CANopen node sent.", sent


def _of(esc: Document) -> dict[str, object]:
    return {"esc": esc["name"]}


def _states(labels: Labels, states: type[Any], now: str) -> list[Sample]:
    names = [name_in_words(state.name) for state in states]
    return [(dict(labels) | {"state": name}, int(name == now)) for name in names]


def _flags(esc: Document, keys: Iterable[str], bits: type[ErrorBit]) -> list[Sample]:
    """Each bit that has a name, and those without one that are set; none of them where the word is not available."""
    lists = [esc[key] for key in keys]
    if None in lists:
        return []
    found = {name for names in lists for name in names}
    known = {bit.text: bit.severity.value for bit in bits}
    known |= dict.fromkeys(sorted(found - set(known)), "error")
    return [
        (_of(esc) | {"error": name, "severity": known[name]}, int(name in found)) for name in known
    ]


def _counter_name(name: str) -> str:
    return {"bytes": "received_bytes", "live": "live_frames", "info": "info_frames"}.get(name, name)


def _label_text(labels: Labels) -> str:
    if not labels:
        return ""
    return (
        "{" + ",".join(f'{name}="{_escaped(str(value))}"' for name, value in labels.items()) + "}"
    )


def _escaped(text: str) -> str:
    plain = text.encode("utf-8", "replace").decode()
    return plain.replace("\\", r"\\").replace("\n", r"\n").replace('"', r"\"")


def _number(value: float) -> str:
    return repr(value)


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
        text = f"# HELP {_PREFIX}snapshot_age_seconds Age of what is told here.\n# TYPE {_PREFIX}snapshot_age_seconds gauge\n"
        return 200, f"{self._text[1]}{text}{_PREFIX}snapshot_age_seconds {age / SECOND:.3f}\n"
