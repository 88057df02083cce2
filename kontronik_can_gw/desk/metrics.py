"""Metrics for Prometheus from the status file of a gateway; prometheus_client makes the text and serves it.

What is not available is left out. A gateway that does not run has no metrics: the answer is 503, so Prometheus's own ``up`` is 0.
"""

import re
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
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
from kontronik_can_gw.gateway_status import CanState, GatewayState
from kontronik_can_gw.node_state import NmtState
from kontronik_can_gw.runtime.snapshot import name_in_words

Document = Mapping[str, Any]
Sample = tuple[str, float | None, dict[str, object]]
"""Name without prefix, value, labels. Counters are those whose names end in _total."""

REQUEST_S = 5.0
"""Maximum silence of a client."""
_LOOPBACK = re.compile(r"(localhost|127(\.[0-9]{1,3}){3}|\[::1\])(:[0-9]{1,5})?", re.IGNORECASE)
_UNITS: Mapping[str, tuple[str, float]] = {
    "V": ("_volts", 1),
    "A": ("_amperes", 1),
    "W": ("_watts", 1),
    "Wh": ("_joules", 3600),
    "mAh": ("_coulombs", 3.6),
    "°C": ("_celsius", 1),
    "%": ("_ratio", 0.01),
    "s": ("_seconds", 1),
    "µs": ("_seconds", 1e-6),
    "1/min": ("_revolutions_per_second", 1 / 60),
    "": ("", 1),
}
"""Unit to base unit and factor."""
_NAMES = {
    "cell_count": "cells",  # promtool keeps _count for summaries
    "energy_used": "energy_used_joules_total",
    "motor_run_time": "motor_run_time_seconds_total",
    "bytes": "received_bytes",
    "live": "live_frames",
    "info": "info_frames",
}
_GATEWAY = {
    "uptime_seconds": "process.uptime_s",
    "process_resident_memory_bytes": "process.rss_bytes",
    "process_open_fds": "process.open_fds",
    "process_threads": "process.threads",
    "gateway_escs": "gateway.esc_count",
    "gateway_escs_ok": "gateway.escs_ok",
    "can_bitrate": "can.bitrate",
    "can_open": "can.open",
    "can_stalled": "can.stalled",
    "store_waiting": "store.waiting",
    "recording_bytes_total": "recording.bytes",
    "recording_lost_total": "recording.lost",
}
_ESC = {
    "esc_fresh": "fresh",
    "esc_port_open": "port.open",
    "esc_port_reopened_total": "port.reopened",
    "esc_frame_rate_hertz": "frame_rate_hz",
    "esc_losses_total": "losses",
    "esc_data_age_seconds": "data_age_ms",
}
"""Metrics that are a value of the document as it stands, and its place."""
_WORDS = {
    "operating_error": ("errors", "warnings", "statuses"),
    "selftest_error": ("selftest_errors",),
}
"""Error words, and the lists of the document that hold their bits."""


def families(document: Document, age_s: float) -> list[Metric]:
    """All metrics of a document. KeyError, TypeError or ValueError where it is damaged."""
    found: dict[str, Metric] = {}
    for name, value, labels in _samples(document, age_s):
        if value is not None:
            kind = "counter" if name.endswith("_total") else "gauge"
            full, text = f"kontronik_{name}", name.replace("_", " ")
            metric = found.setdefault(full, Metric(full.removesuffix("_total"), text, kind))
            # a file's name may be no UTF-8
            plain = {k: str(v).encode("utf-8", "replace").decode() for k, v in labels.items()}
            metric.add_sample(full, plain, float(value))
    return list(found.values())


def _samples(document: Document, age_s: float) -> Iterator[Sample]:
    can, store, recording = document["can"], document["store"], document["recording"]
    yield "build_info", 1, {"version": document["version"]}
    yield "snapshot_age_seconds", round(age_s, 3), {}
    for name, place in _GATEWAY.items():
        yield name, _at(document, place), {}
    yield "store_failed", None if store is None else store["last_error"] is not None, {}
    yield "recording_failed", None if recording is None else recording["problem"] != "", {}
    yield from _states("gateway_state", GatewayState, document["gateway"]["state"], {})
    yield "can_info", 1, {"interface": can["interface"], "channel": can["channel"]}
    yield from _states("can_state", CanState, can["state"], {})
    for way, count in zip(("transmit", "receive"), can["error_counters"] or (), strict=False):
        yield f"can_{way}_errors", count, {}
    for key, count in can["counters"].items():
        yield f"can_{key.removesuffix('_count')}_total", count, {}
    for esc in document["escs"]:
        yield from _esc(esc, document["units"])
    for node in document["nodes"]:
        if node["node_id"] is not None:
            of = {"esc": node["esc"], "node_id": node["node_id"]}
            yield from _states("canopen_node_state", NmtState, node["state"], of)
            yield "canopen_pdos_sent_total", node["pdos_sent"], of


def _esc(esc: Document, units: Mapping[str, str]) -> Iterator[Sample]:
    """What is known of an ESC's line, what it measures in base units, and its error bits."""
    of = {"esc": esc["name"]}
    for name, place in _ESC.items():
        value = _at(esc, place)
        yield name, value / 1000 if value is not None and place.endswith("_ms") else value, of
    yield from _states("esc_link_state", LinkState, esc["link"], of)
    about = {key: esc[key] or "" for key in ("layout", "device", "variant", "firmware")}
    yield "esc_info", None if esc["device"] is None else 1, of | about
    for kind, count in esc["port"]["line_errors"].items():
        yield "esc_port_line_errors_total", count, of | {"kind": kind}
    for key, count in esc["counters"].items():
        yield f"esc_{_NAMES.get(key, key)}_total", count, of
    for name, unit in units.items():
        value, (base, factor) = esc["values"][name], _UNITS[unit]
        yield _NAMES.get(name, f"{name}{base}"), None if value is None else value * factor, of
    bits = protocol_named(esc.get("protocol")).errors
    for word, keys in _WORDS.items():
        lists = [esc[key] for key in keys]
        if None in lists:  # the word is not known
            continue
        is_set = {name for names in lists for name in names}
        known = {bit.text: bit.severity.value for bit in bits.get(f"{word}s", ())}
        for error, severity in (dict.fromkeys(sorted(is_set), "error") | known).items():
            yield word, error in is_set, of | {"error": error, "severity": severity}


def _states(name: str, kind: type[Any], now: str, labels: dict[str, object]) -> Iterator[Sample]:
    """A sample for each state that there is: 1 for the present one."""
    for state in kind:
        word = name_in_words(state.name)
        yield name, word == now, labels | {"state": word}


def _at(part: Any, place: str) -> float | None:
    """The value at a place such as "port.open"; None below a part that is null."""
    for key in place.split("."):
        part = None if part is None else part[key]
    return part  # type: ignore[no-any-return]


class _Collected:
    """Metrics that are made already, as prometheus_client takes them."""

    def __init__(self, metrics: list[Metric]) -> None:
        self.collect = lambda: metrics


class _Handler(WSGIRequestHandler):
    timeout = REQUEST_S

    def log_message(self, *_: object) -> None:
        """A log of all requests is of no use."""


def server_of(
    look: Callable[[int], Seen], host: str, port: int, clock: Callable[[], int] = time.monotonic_ns
) -> WSGIServer:
    """Return a server of the metrics of one gateway at an address. RunError if it cannot listen there.

    ``look`` returns the gateway's status at a monotonic time.
    """

    def answer(environ: dict[str, Any], start: Callable[..., Any]) -> Iterable[bytes]:
        status, seen = "503 Service Unavailable", look(clock())
        file = seen.file
        reason = seen.sentence
        if seen.document is not None:
            reason = f"{file}: {reason}"
        if _LOOPBACK.fullmatch(environ.get("HTTP_HOST", "")) is None:
            # no web page may have a browser ask (DNS rebinding)
            status = "403 Forbidden"
            reason = "only for this machine: the Host header must name localhost"
        elif seen.document is not None and seen.code != NOT_RUNNING:
            try:
                found = families(seen.document, max(0, seen.age_s or 0))
                registry = CollectorRegistry(auto_describe=False)
                registry.register(_Collected(found))
                made: Iterable[bytes] = make_wsgi_app(registry)(environ, start)
                return made
            except MALFORMED:
                reason = f"{file}: {FOREIGN}"
        start(status, [("Content-Type", "text/plain; charset=utf-8")])
        return [f"{reason}\n".encode(errors="replace")]

    class Server(ThreadingWSGIServer):
        address_family = socket.AF_INET6 if ":" in host else socket.AF_INET

        def handle_error(self, *_: object) -> None:
            """A client that ends early or never comes to an end is no fault of ours."""

    try:
        return make_server(host, port, answer, Server, _Handler)
    except OSError as error:
        where = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        reason = f"cannot be listened to: {error.strerror}. Choose another address or port."
        raise RunError(f"--listen {where}: {reason}") from None
