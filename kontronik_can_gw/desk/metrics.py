"""Metrics for Prometheus from the status file of a gateway; prometheus_client makes the text and serves it.

What is not available is left out. A gateway that does not run has no metrics: the answer is 503, so Prometheus's own ``up`` is 0.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from prometheus_client import Metric

from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import LinkState
from kontronik_can_gw.gateway_status import CanState, GatewayState
from kontronik_can_gw.node_state import NmtState
from kontronik_can_gw.runtime.snapshot import name_in_words

Document = Mapping[str, Any]
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
_ESC: tuple[Row, ...] = (
    ("esc_fresh", "1 while the ESC's live values are fresh.", "fresh"),
    ("esc_port_open", "1 while the serial port is open.", "port.open"),
    ("esc_port_reopened_total", "How often the serial port was opened again.", "port.reopened"),
    ("esc_frame_rate_hertz", "Live frames in a second.", "frame_rate_hz"),
    ("esc_losses_total", "How often telemetry was lost.", "losses"),
)
"""Metrics that are a value of the document as it stands: name, help, and the value's place."""
_PROCESS = {"resident_memory_bytes": "rss_bytes", "open_fds": "open_fds", "threads": "threads"}
_ABOUT = ("layout", "device", "variant", "firmware")
_WORDS = {
    "operating_error": ("errors", "warnings", "statuses"),
    "selftest_error": ("selftest_errors",),
}
"""Error words, and the lists of the document that hold their bits."""


class _Metrics:
    """Metrics by name, in the order in which the first sample of each was added."""

    def __init__(self) -> None:
        self.found: dict[str, Metric] = {}

    def add(self, name: str, text: str, value: float | None, **labels: object) -> None:
        """Add a sample, if its value is known. Counters are those whose names end in _total."""
        if value is None:
            return
        full = f"kontronik_{name}"
        if full not in self.found:
            kind = "counter" if name.endswith("_total") else "gauge"
            self.found[full] = Metric(full.removesuffix("_total"), text, kind)
        plain = {key: _plain(label) for key, label in labels.items()}
        self.found[full].add_sample(full, plain, float(value))

    def add_states(self, name: str, text: str, kind: type[Any], now: str, **labels: object) -> None:
        """Add a sample for each state that there is: 1 for the present one."""
        for state in kind:
            word = name_in_words(state.name)
            self.add(name, f"{text}: 1 for the one it is in.", word == now, **labels, state=word)


def families(document: Document, age_s: float) -> list[Metric]:
    """All metrics of a document. KeyError, TypeError or ValueError where it is damaged."""
    made = _Metrics()
    made.add("build_info", "The version that runs.", 1, version=document["version"])
    made.add("snapshot_age_seconds", "Age of these statistics.", round(age_s, 3))
    _gateway(made, document)
    for esc in document["escs"]:
        _esc(made, esc)
        _values(made, esc, document["units"])
    for node in document["nodes"]:
        _node(made, node)
    return list(made.found.values())


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


def _gateway(made: _Metrics, document: Document) -> None:
    for name, text, place in _GATEWAY:
        made.add(name, text, _at(document, place))
    for name, key in _PROCESS.items():
        text = f"The process: {name.replace('_', ' ')}."
        made.add(f"process_{name}", text, document["process"][key] or None)
    if (store := document["store"]) is not None:
        failed = store["last_error"] is not None
        made.add("store_failed", "1 if the last saving of parameters failed.", failed)
    if (recording := document["recording"]) is not None:
        failed = recording["problem"] != ""
        made.add("recording_failed", "1 while nothing can be recorded.", failed)
    can, state = document["can"], document["gateway"]["state"]
    made.add_states("gateway_state", "State of the gateway", GatewayState, state)
    names = {"interface": can["interface"], "channel": can["channel"]}
    made.add("can_info", "The CAN interface.", 1, **names)
    made.add_states("can_state", "State of the CAN controller", CanState, can["state"])
    for way, count in zip(("transmit", "receive"), can["error_counters"] or (), strict=False):
        made.add(f"can_{way}_errors", f"The CAN controller's {way} error counter.", count)
    for key, count in can["counters"].items():
        name = key.removesuffix("_count")
        made.add(f"can_{name}_total", f"CAN: {name.replace('_', ' ')} since start.", count)


def _esc(made: _Metrics, esc: Document) -> None:
    """What is known of an ESC's line, whether telemetry arrives or not."""
    of = {"esc": esc["name"]}
    for name, text, place in _ESC:
        made.add(name, text, _at(esc, place), **of)
    age_ms = esc["data_age_ms"]
    text = "Age of the newest live frame when the snapshot was made."
    made.add("esc_data_age_seconds", text, None if age_ms is None else age_ms / 1000, **of)
    made.add_states("esc_link_state", "State of the ESC's line", LinkState, esc["link"], **of)
    if esc["device"] is not None:
        about = {key: esc[key] or "" for key in _ABOUT}
        made.add("esc_info", "What the ESC tells of itself.", 1, **of, **about)
    text = "Line errors that the serial driver counted, by kind."
    for kind, count in esc["port"]["line_errors"].items():
        made.add("esc_port_line_errors_total", text, count, **of, kind=kind)
    for key, count in esc["counters"].items():
        text = f"The ESC's stream: {key.replace('_', ' ')}."
        made.add(f"esc_{_COUNTER_NAMES.get(key, key)}_total", text, count, **of)


def _values(made: _Metrics, esc: Document, units: Mapping[str, str]) -> None:
    """What an ESC measures, in base units, and its error bits."""
    of = {"esc": esc["name"]}
    for name, unit in units.items():
        base, multiplier, divisor = _BASE_UNITS[unit]
        words = (_RENAMED.get(name, name), base, "total" if name in _COUNTED else "")
        text = f"The ESC's {name.replace('_', ' ')}"
        text += f" in {base.replace('_', ' ')}." if base else "."
        value = esc["values"][name]
        scaled = None if value is None else value * multiplier / divisor
        made.add("_".join(filter(None, words)), text, scaled, **of)
    for name, keys in _WORDS.items():
        text = f"1 while the bit of the ESC's {name.replace('_', ' ')} word is set."
        for error, severity, is_set in _flags(esc, keys, f"{name}s"):
            made.add(name, text, is_set, **of, error=error, severity=severity)


def _flags(esc: Document, keys: Iterable[str], word: str) -> Sequence[tuple[str, str, bool]]:
    """Name, severity and state of each bit that has a name, and of those without one that are set; none while the word is unknown."""
    lists = [esc[key] for key in keys]
    if None in lists:
        return []
    found = {name for names in lists for name in names}
    protocol = protocol_named(esc.get("protocol"))
    known = {bit.text: bit.severity.value for bit in protocol.errors.get(word, ())}
    known |= dict.fromkeys(sorted(found - set(known)), "error")
    return [(name, severity, name in found) for name, severity in known.items()]


def _node(made: _Metrics, node: Document) -> None:
    if node["node_id"] is not None:
        of = {"esc": node["esc"], "node_id": node["node_id"]}
        text = "NMT state of the CANopen node"
        made.add_states("canopen_node_state", text, NmtState, node["state"], **of)
        sent = node["pdos_sent"]
        made.add("canopen_pdos_sent_total", "PDOs that the CANopen node sent.", sent, **of)
