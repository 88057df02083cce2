"""The statistics for Prometheus: a document as text (exposition format 0.0.4)."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from kontronik_can_gw.esc.kontronik.states import ErrorBit, OperatingError, SelfTestError
from kontronik_can_gw.esc.telemetry import LinkState
from kontronik_can_gw.gateway_status import CanState, GatewayState
from kontronik_can_gw.node_state import NmtState
from kontronik_can_gw.runtime.snapshot import name_in_words

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
