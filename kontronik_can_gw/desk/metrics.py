"""Serves metrics for Prometheus, made from the status file of a gateway.

prometheus_client renders and serves them. Values that are not available are left out. If the
gateway does not run, the answer is 503, so that Prometheus's own metric ``up`` is 0.
"""

import re
import socket
import time
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from prometheus_client import CollectorRegistry, Metric, make_wsgi_app
from prometheus_client.exposition import ThreadingWSGIServer

from kontronik_can_gw.desk.monitor.status import (
    FOREIGN,
    MALFORMED,
    NOT_RUNNING,
    Seen,
)
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import LinkState
from kontronik_can_gw.status import CanState, GatewayState, NmtState, name_in_words

Document = Mapping[str, Any]
Sample = tuple[str, float | None, dict[str, object]]
"""Name without prefix, value, labels. A name that ends in _total is a counter."""

REQUEST_S = 5.0
"""Longest time that a client may be silent."""
_LOOPBACK = re.compile(r"(localhost|127(\.[0-9]{1,3}){3}|\[::1\])(:[0-9]{1,5})?", re.IGNORECASE)
_TABLES = tomllib.loads(Path(__file__).with_name("metrics.toml").read_text(encoding="utf-8"))


def families(document: Document, age_s: float) -> list[Metric]:
    """Return all metrics of a document of this age.

    Raises KeyError, TypeError or ValueError if the document is damaged.
    """
    found: dict[str, Metric] = {}
    for name, value, labels in _samples(document, age_s):
        if value is None:
            continue
        full_name = f"kontronik_{name}"
        if full_name not in found:
            kind = "counter" if name.endswith("_total") else "gauge"
            text = name.replace("_", " ")
            found[full_name] = Metric(full_name.removesuffix("_total"), text, kind)
        texts = {}
        for label, content in labels.items():
            # the name of a file is not always valid UTF-8
            texts[label] = str(content).encode("utf-8", "replace").decode()
        found[full_name].add_sample(full_name, texts, float(value))
    return list(found.values())


def _samples(document: Document, age_s: float) -> Iterator[Sample]:
    can = document["can"]
    store = document["store"]
    recording = document["recording"]
    yield "build_info", 1, {"version": document["version"]}
    yield "snapshot_age_seconds", round(age_s, 3), {}
    for name, place in _TABLES["gateway"].items():
        yield name, _at(document, place), {}
    if store is not None:
        yield "store_failed", store["last_error"] is not None, {}
    if recording is not None:
        yield "recording_failed", recording["problem"] != "", {}
        yield "recording_events_total", recording.get("events"), {}
    yield from _states("gateway_state", GatewayState, document["gateway"]["state"], {})
    yield "can_info", 1, {"interface": can["interface"], "channel": can["channel"]}
    yield from _states("can_state", CanState, can["state"], {})
    if can["error_counters"]:
        transmit, receive = can["error_counters"]
        yield "can_transmit_errors", transmit, {}
        yield "can_receive_errors", receive, {}
    for key, count in can["counters"].items():
        name = key.removeprefix("can_").removesuffix("_count")
        yield f"can_{name}_total", count, {}
    yield from _clock(document.get("clock") or {})
    for esc in document["escs"]:
        yield from _esc(esc, document["units"])
    for node in document["nodes"]:
        if node["node_id"] is not None:
            labels = {"esc": node["esc"], "node_id": node["node_id"]}
            yield from _states("canopen_node_state", NmtState, node["state"], labels)
            yield "canopen_pdos_sent_total", node["pdos_sent"], labels


def _clock(clock: Document) -> Iterator[Sample]:
    """Yield the samples of the wall clock. Documents before 0.6 do not have it."""
    if not clock:
        return
    yield "clock_synchronized", clock["synchronized"], {}
    yield "clock_max_error_seconds", clock["max_error_s"], {}
    has_hardware = None if clock["hardware"] is None else clock["hardware"] != ""
    yield "clock_hardware", has_hardware, {}
    yield "clock_steps_total", clock["steps"], {}


def _esc(esc: Document, units: Mapping[str, str]) -> Iterator[Sample]:
    """Yield the samples of an ESC: its line, its values in base units, its error bits."""
    labels: dict[str, object] = {"esc": esc["name"]}
    for name, place in _TABLES["esc"].items():
        value = _at(esc, place)
        if value is not None and place.endswith("_ms"):
            value /= 1000
        yield name, value, labels
    yield from _states("esc_link_state", LinkState, esc["link"], labels)
    if esc["device"] is not None:
        about = {key: esc[key] or "" for key in ("layout", "device", "variant", "firmware")}
        yield "esc_info", 1, labels | about
    for kind, count in esc["port"]["line_errors"].items():
        yield "esc_port_line_errors_total", count, labels | {"kind": kind}
    for key, count in esc["counters"].items():
        yield f"esc_{_TABLES['names'].get(key, key)}_total", count, labels
    for name, unit in units.items():
        value = esc["values"][name]
        base, factor = _TABLES["units"][unit]
        if value is not None:
            value *= factor
        yield _TABLES["names"].get(name, f"{name}{base}"), value, labels
    yield from _error_bits(esc, labels)


def _error_bits(esc: Document, labels: dict[str, object]) -> Iterator[Sample]:
    """Yield a sample for each bit of the error words that are available: 1 if it is set."""
    bits = protocol_named(esc.get("protocol")).errors
    for word, keys in _TABLES["error_words"].items():
        lists = [esc[key] for key in keys]
        if None in lists:  # the word is not available
            continue
        set_names: set[str] = set()
        for names in lists:
            set_names.update(names)
        severities = dict.fromkeys(sorted(set_names), "error")
        for bit in bits.get(f"{word}s", ()):
            severities[bit.text] = bit.severity.value
        for error, severity in severities.items():
            yield word, error in set_names, labels | {"error": error, "severity": severity}


def _states(name: str, states: type[Any], now: str, labels: dict[str, object]) -> Iterator[Sample]:
    """Yield a sample for each possible state: 1 for the present state, else 0."""
    for state in states:
        word = name_in_words(state.name)
        yield name, word == now, labels | {"state": word}


def _at(part: Any, place: str) -> float | None:
    """Return the value at a place such as "port.open". None if it or a part above it is null."""
    for key in place.split("."):
        if part is None:
            return None
        part = part[key]
    return part  # type: ignore[no-any-return]


class _Collected:
    """Finished metrics in the form that prometheus_client accepts."""

    def __init__(self, metrics: list[Metric]) -> None:
        self.collect = lambda: metrics


class _Handler(WSGIRequestHandler):
    timeout = REQUEST_S

    def log_message(self, *_: object) -> None:
        """Log nothing: a log of all requests is useless."""


def server_of(
    look: Callable[[int], Seen],
    host: str,
    port: int,
    clock: Callable[[], int] = time.monotonic_ns,
) -> WSGIServer:
    """Return a server of the metrics of one gateway. Raises RunError if it cannot listen.

    ``look`` returns the gateway's status at a monotonic time.
    """

    def answer(environ: dict[str, Any], start: Callable[..., Any]) -> Iterable[bytes]:
        status = "503 Service Unavailable"
        seen = look(clock())
        file = seen.file
        reason = seen.sentence
        if seen.document is not None:
            reason = f"{file}: {reason}"
        if _LOOPBACK.fullmatch(environ.get("HTTP_HOST", "")) is None:
            # Refuses requests that a web page causes a browser to send (DNS rebinding).
            status = "403 Forbidden"
            reason = "only for this machine: the Host header must name localhost"
        elif seen.document is not None and seen.code != NOT_RUNNING:
            try:
                found = families(seen.document, max(0, seen.age_s or 0))
                registry = CollectorRegistry(auto_describe=False)
                registry.register(_Collected(found))
                body: Iterable[bytes] = make_wsgi_app(registry)(environ, start)
                return body
            except MALFORMED:
                reason = f"{file}: {FOREIGN}"
        start(status, [("Content-Type", "text/plain; charset=utf-8")])
        return [f"{reason}\n".encode(errors="replace")]

    class Server(ThreadingWSGIServer):
        address_family = socket.AF_INET6 if ":" in host else socket.AF_INET

        def handle_error(self, *_: object) -> None:
            """Log nothing: clients that disconnect early or never finish are not our fault."""

    try:
        return make_server(
            host,
            port,
            answer,
            Server,
            _Handler,
        )
    except OSError as error:
        where = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        reason = f"cannot be used: {error.strerror}. Choose another address or port."
        raise RunError(f"--listen {where}: {reason}") from None
