"""Metrics for Prometheus from the status file of a gateway; prometheus_client makes the text and serves it.

What is not available is left out. A gateway that does not run has no metrics: the answer is 503, so Prometheus's own ``up`` is 0.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from prometheus_client import Metric

from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import LinkState
from kontronik_can_gw.gateway_status import CanState, GatewayState
from kontronik_can_gw.node_state import NmtState
from kontronik_can_gw.runtime.snapshot import name_in_words

Document = Mapping[str, Any]
Labels = Mapping[str, object]
Sample = tuple[Labels, float | None]
Row = tuple[str, str, str]

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
_COUNTER_NAMES = {"bytes": "received_bytes", "live": "live_frames", "info": "info_frames"}

_GATEWAY: tuple[Row, ...] = (
    ("uptime_seconds", "Time since the gateway started.", "process.uptime_s"),
    ("gateway_escs", "ESCs that are configured.", "gateway.esc_count"),
    ("gateway_escs_ok", "ESCs with fresh telemetry.", "gateway.escs_ok"),
    ("can_bitrate", "Bit rate of the CAN bus in bit/s.", "can.bitrate"),
    ("can_open", "1 while the CAN interface is open.", "can.open"),
    ("can_stalled", "1 while the bus takes no frame.", "can.stalled"),
    ("store_waiting", "Parameters that wait for the disk.", "store.waiting"),
    ("recording_bytes_total", "Bytes of captures written since start.", "recording.bytes"),
    ("recording_lost_total", "Entries that could not be recorded since start.", "recording.lost"),
)
_PROCESS = {
    "resident_memory_bytes": "rss_bytes",
    "open_fds": "open_fds",
    "threads": "threads",
}
_ESC: tuple[Row, ...] = (
    ("esc_fresh", "1 while the ESC's live values are fresh.", "fresh"),
    ("esc_port_open", "1 while the serial port is open.", "port.open"),
    ("esc_port_reopened_total", "How often the serial port was opened again.", "port.reopened"),
    ("esc_frame_rate_hertz", "Live frames in a second.", "frame_rate_hz"),
    ("esc_losses_total", "How often telemetry was lost.", "losses"),
)
"""Metrics that are a value of the document as it stands: name, help, and the value's place."""


def families(document: Document, age_s: float) -> list[Metric]:
    """All metrics of a document. KeyError, TypeError or ValueError where it is damaged."""
    return [
        *_one("build_info", "The version that runs.", [({"version": document["version"]}, 1)]),
        *_one("snapshot_age_seconds", "Age of these statistics.", [({}, round(age_s, 3))]),
        *_gateway(document),
        *_escs(document["escs"]),
        *_values(document),
        *_nodes(document["nodes"]),
    ]


def _one(name: str, text: str, samples: Iterable[Sample]) -> Iterator[Metric]:
    """The metric of a name, if any of its samples is known. Counters are those whose names end in _total."""
    kind = "counter" if name.endswith("_total") else "gauge"
    full = f"kontronik_{name}"
    metric = Metric(full.removesuffix("_total"), text, kind)
    for labels, value in samples:
        if value is not None:
            plain = {key: _plain(label) for key, label in labels.items()}
            metric.add_sample(full, plain, float(value))
    if metric.samples:
        yield metric


def _plain(label: object) -> str:
    """The label as text that UTF-8 can hold: a file's name may be none."""
    return str(label).encode("utf-8", "replace").decode()


def _at(part: Document, place: str) -> float | None:
    """The value at a place such as "port.open"; None below a part that is null."""
    found: Any = part
    for key in place.split("."):
        if found is None:
            return None
        found = found[key]
    return found  # type: ignore[no-any-return]


def _gateway(document: Document) -> Iterator[Metric]:
    for name, text, place in _GATEWAY:
        yield from _one(name, text, [({}, _at(document, place))])
    for name, key in _PROCESS.items():
        text = f"The process: {name.replace('_', ' ')}."
        yield from _one(f"process_{name}", text, [({}, document["process"][key] or None)])
    if (store := document["store"]) is not None:
        failed = store["last_error"] is not None
        yield from _one(
            "store_failed", "1 if the last saving of parameters failed.", [({}, failed)]
        )
    if (recording := document["recording"]) is not None:
        failed = recording["problem"] != ""
        yield from _one("recording_failed", "1 while nothing can be recorded.", [({}, failed)])
    can = document["can"]
    states = _states({}, GatewayState, document["gateway"]["state"])
    yield from _one("gateway_state", "State of the gateway: 1 for the one it is in.", states)
    names = {"interface": can["interface"], "channel": can["channel"]}
    yield from _one("can_info", "The CAN interface.", [(names, 1)])
    states = _states({}, CanState, can["state"])
    yield from _one("can_state", "State of the CAN controller: 1 for the one it is in.", states)
    for way, count in zip(("transmit", "receive"), can["error_counters"] or (), strict=False):
        text = f"The CAN controller's {way} error counter."
        yield from _one(f"can_{way}_errors", text, [({}, count)])
    for key, count in can["counters"].items():
        name = key.removesuffix("_count")
        text = f"CAN: {name.replace('_', ' ')} since start."
        yield from _one(f"can_{name}_total", text, [({}, count)])


def _escs(escs: list[Document]) -> Iterator[Metric]:
    """What is known of each ESC's line, whether telemetry arrives or not."""
    for name, text, place in _ESC:
        yield from _one(name, text, [(_of(esc), _at(esc, place)) for esc in escs])
    ages = [(esc, esc["data_age_ms"]) for esc in escs]
    text = "Age of the newest live frame when the snapshot was made."
    seconds = [(_of(esc), None if age is None else age / 1000) for esc, age in ages]
    yield from _one("esc_data_age_seconds", text, seconds)
    states = [sample for esc in escs for sample in _states(_of(esc), LinkState, esc["link"])]
    yield from _one("esc_link_state", "State of the ESC's line: 1 for the one it is in.", states)
    keys = ("layout", "device", "variant", "firmware")
    described = [
        (_of(esc) | {key: esc[key] or "" for key in keys}, 1)
        for esc in escs
        if esc["device"] is not None
    ]
    yield from _one("esc_info", "What the ESC tells of itself.", described)
    kinds = [
        (_of(esc) | {"kind": kind}, count)
        for esc in escs
        for kind, count in esc["port"]["line_errors"].items()
    ]
    text = "Line errors that the serial driver counted, by kind."
    yield from _one("esc_port_line_errors_total", text, kinds)
    for key in dict.fromkeys(key for esc in escs for key in esc["counters"]):
        text = f"The ESC's stream: {key.replace('_', ' ')}."
        counts = [(_of(esc), esc["counters"].get(key)) for esc in escs]
        yield from _one(f"esc_{_COUNTER_NAMES.get(key, key)}_total", text, counts)


def _values(document: Document) -> Iterator[Metric]:
    """What the ESCs measure, in base units."""
    escs = document["escs"]
    for name, unit in document["units"].items():
        base, multiplier, divisor = _BASE_UNITS[unit]
        words = (_RENAMED.get(name, name), base, "total" if name in _COUNTED else "")
        unit_text = f" in {base.replace('_', ' ')}" if base else ""
        values = [(_of(esc), esc["values"][name]) for esc in escs]
        scaled = [(of, v if v is None else v * multiplier / divisor) for of, v in values]
        text = f"The ESC's {name.replace('_', ' ')}{unit_text}."
        yield from _one("_".join(filter(None, words)), text, scaled)
    words_of_bits: tuple[tuple[str, tuple[str, ...]], ...] = (
        ("operating_error", ("errors", "warnings", "statuses")),
        ("selftest_error", ("selftest_errors",)),
    )
    for name, keys in words_of_bits:
        text = f"1 while the bit of the ESC's {name.replace('_', ' ')} word is set."
        yield from _one(
            name, text, [flag for esc in escs for flag in _flags(esc, keys, f"{name}s")]
        )


def _nodes(nodes: Iterable[Document]) -> Iterator[Metric]:
    known = [
        ({"esc": node["esc"], "node_id": node["node_id"]}, node)
        for node in nodes
        if node["node_id"] is not None
    ]
    states = [sample for of, node in known for sample in _states(of, NmtState, node["state"])]
    text = "NMT state of the CANopen node: 1 for the one it is in."
    yield from _one("canopen_node_state", text, states)
    sent = [(of, node["pdos_sent"]) for of, node in known]
    yield from _one("canopen_pdos_sent_total", "PDOs that the CANopen node sent.", sent)


def _of(esc: Document) -> dict[str, object]:
    return {"esc": esc["name"]}


def _states(labels: Labels, states: type[Any], now: str) -> list[Sample]:
    names = [name_in_words(state.name) for state in states]
    return [(dict(labels) | {"state": name}, int(name == now)) for name in names]


def _flags(esc: Document, keys: Iterable[str], word: str) -> list[Sample]:
    """Each bit that has a name, and those without one that are set; empty while the word is not available."""
    lists = [esc[key] for key in keys]
    if None in lists:
        return []
    found = {name for names in lists for name in names}
    protocol = protocol_named(esc.get("protocol"))
    known = {bit.text: bit.severity.value for bit in protocol.errors.get(word, ())}
    known |= dict.fromkeys(sorted(found - set(known)), "error")
    return [
        (_of(esc) | {"error": name, "severity": known[name]}, int(name in found)) for name in known
    ]
