"""What the gateway knows of itself, as one JSON document for people and programs.

A snapshot is made of what the loop's thread copied at one moment, of the gateway and of what the loop owns, in any thread. Every value in
it was fresh at that moment, or is null.
"""

from collections.abc import Sequence
from dataclasses import fields
from enum import Enum
from functools import cache, lru_cache
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.esc.decoder import Data, EscProtocol, Severity, bit_texts
from kontronik_can_gw.esc.telemetry import INFO_TIMEOUT_NS, SECOND, EscTelemetry
from kontronik_can_gw.esc.values import (
    VALUES,
    Divisor,
    Group,
    Kind,
    Value,
    physical,
    steps,
    steps_of,
    values_of,
)
from kontronik_can_gw.gateway_status import GatewayStatus
from kontronik_can_gw.node_state import UNCONFIGURED
from kontronik_can_gw.runtime.facts import (
    CanFacts,
    GatewayFacts,
    PortFacts,
    ProgramFacts,
    StoreFacts,
    utc,
)
from kontronik_can_gw.runtime.process import ProcessFacts

if TYPE_CHECKING:
    from kontronik_can_gw.runtime.recorder import RecorderFacts

FORMAT = 1
"""Of the document; another number for a change that readers must know of. New keys may come without one."""
PROGRAM = "kontronik-can-gw"
STALE_NS = 3 * SECOND
"""A document older than this says nothing of now."""
LOG_LINES = 20
_OTHERWISE = ("variant", "device_raw", "firmware_main", "firmware_sub")
"""Values that are shown apart from the others."""

Document = dict[str, Any]


def snapshot(
    gateway: GatewayFacts,
    *,
    now: int,
    wall: float,
    program: ProgramFacts,
    process: ProcessFacts,
    ports: Sequence[PortFacts],
    can: CanFacts,
    store: StoreFacts | None = None,
    log_lines: Sequence[str] = (),
    recorder: "RecorderFacts | None" = None,
) -> Document:
    """The document: plain dictionaries, lists, texts and numbers. ``now`` monotonic nanoseconds, ``wall`` seconds of the wall clock."""
    status = gateway.status
    return {
        "format": FORMAT,
        "program": PROGRAM,
        "version": program.version,
        "configuration": program.configuration,
        "monotonic_ns": now,
        "time": utc(wall),
        "process": _process(program, process, now - status.started_ns),
        "gateway": {
            "state": name_in_words(status.state.name),
            "esc_count": status.esc_count,
            "escs_ok": status.escs_ok,
            "layout": gateway.layout,
            "core": gateway.core,
            "core_reason": gateway.core_note or None,
        },
        "can": _can(can, status),
        "units": _UNITS,
        "escs": [
            _esc(esc, port, status, now) for esc, port in zip(gateway.escs, ports, strict=True)
        ],
        "nodes": [
            _node(port.name, *found) for port, found in zip(ports, gateway.nodes, strict=False)
        ],
        "outputs": gateway.outputs,
        "store": store and {"waiting": store.waiting, "last_error": store.last_error or None},
        "recording": None if recorder is None else vars(recorder),
        "log": list(log_lines)[-LOG_LINES:],
    }


def _process(program: ProgramFacts, process: ProcessFacts, uptime_ns: int) -> Document:
    return {
        "pid": program.pid,
        "start_ticks": program.ticks,
        "pid_namespace": program.pid_namespace,
        "started": program.started,
        "uptime_s": _seconds(uptime_ns),
        **vars(process),
    }


def _node(esc: str, node_id: int, state: Enum, pdos_sent: int) -> Document:
    return {
        "esc": esc,
        "node_id": None if node_id == UNCONFIGURED else node_id,
        "state": name_in_words(state.name),
        "pdos_sent": pdos_sent,
    }


def _can(can: CanFacts, status: GatewayStatus) -> Document:
    return {
        "interface": can.interface,
        "channel": can.channel,
        "bitrate": can.bitrate,
        "state": name_in_words(status.can_state.name),
        "open": can.open,
        "stalled": can.stalled,
        "complaint": can.complaint or None,
        "restart_ms": can.restart_ms,
        "error_counters": None if can.error_counters is None else list(can.error_counters),
        "counters": dict(zip(_STATUS_COUNTERS, _counters_of(status), strict=True)),
    }


def with_rates(document: Document, before: Document | None) -> Document:
    """The document with what happens in a second since ``before``: frames on the bus, PDOs of each node. None without a ``before``."""
    seconds = (
        0.0 if before is None else (document["monotonic_ns"] - before["monotonic_ns"]) / SECOND
    )
    if before is None or seconds <= 0:
        return document | {"rates": None}
    new, old = document["can"]["counters"], before["can"]["counters"]
    pdos = zip(document["nodes"], before["nodes"], strict=False)
    rates: Document = {
        f"{name}_per_s": round((new[name] - old[name]) / seconds, 1)
        for name in ("sent_frames", "received_frames")
    }
    rates["pdos_per_s"] = [
        round((now["pdos_sent"] - then["pdos_sent"]) / seconds, 1) for now, then in pdos
    ]
    return document | {"rates": {"seconds": round(seconds, 3)} | rates}


def _seconds(ns: int) -> float:
    return round(ns / SECOND, 3)


def name_in_words(name: str) -> str:
    """A constant's name as people read it."""
    return name.lower().replace("_", "-")


def _esc(esc: EscTelemetry, port: PortFacts, status: GatewayStatus, now: int) -> Document:
    """One ESC. What is not fresh at ``now`` is None, whatever the last call of ``advance`` knew."""
    live, info = esc.live, esc.info
    if live is not None and now - esc.live_bound_ns > esc.settings.timeout_ns:
        live = None
    if info is not None and (
        esc.info_bound_ns is None or now - esc.info_bound_ns > INFO_TIMEOUT_NS
    ):
        info = None
    protocol = esc.protocol
    return {
        "name": esc.settings.name,
        "port": {
            "path": port.path,
            "open": port.open,
            "complaint": port.complaint or None,
            "reopened": max(0, port.reopened),
            "lost_for_s": None
            if port.lost_since_ns is None
            else _seconds(now - port.lost_since_ns),
            "line_errors": dict(port.line_errors),
        },
        "link": name_in_words(esc.link.name),
        "fresh": live is not None,
        "diagnosis": port.diagnosis if live is None and port.open else None,
        "protocol": protocol.name,
        "layout": protocol.layout_text(esc.layout),
        "device": protocol.device_text(info),
        "variant": protocol.value("variant", info),
        "firmware": protocol.firmware_text(info),
        "peak_current_of": protocol.peak_current_text(info),
        "frame_rate_hz": None if esc.frame_rate is None else esc.frame_rate / 10,
        "data_age_ms": esc.age_ms(now),
        "losses": esc.losses,
        "counters": esc.counters.as_dict()
        | {
            "suspect_frames": esc.suspect_frames,
            "late_frames": esc.late_frames,
            "line_errors": esc.line_errors,
        },
        **_words(protocol, live, info),
        "values": {
            **_of_reading(esc, _LIVE, live),
            **_of_reading(esc, _INFO, info),
            **{
                name: physical(value, esc, steps(value, esc, status, now))
                for name, value, *_ in _rows(protocol, _LINK)
            },
        },
    }


def _of_reading(esc: EscTelemetry, names: tuple[str, ...], reading: Data | None) -> Document:
    """Values of live data or information."""
    if reading is None:
        return dict.fromkeys(names)
    found: Document = {}
    for name, value, word, per_unit in _rows(esc.protocol, names):
        if word is None:
            found[name] = physical(value, esc, steps_of(value, esc, reading))
        else:  # as ``physical`` has it
            found[name] = reading[word] if per_unit == 1 else round(reading[word] / per_unit, 6)
    return found


@cache
def _rows(
    protocol: EscProtocol, names: tuple[str, ...]
) -> tuple[tuple[str, Value, int | None, int], ...]:
    """Name, value, the place of its word where that is all of it, and steps of a unit."""
    values = values_of(protocol)
    return tuple(
        (name, values[name], _whole(values[name]), values[name].per_unit) for name in names
    )


def _whole(value: Value) -> int | None:
    is_whole = value.kind is Kind.WIRE and value.supplied and not value.not_on
    return value.words[0] if is_whole and value.divisor is Divisor.ONE else None


def _words(protocol: EscProtocol, live: Data | None, info: Data | None) -> Document:
    """State and error bits in words."""
    alarms = _alarms(protocol, protocol.value("operating_errors", live))
    selftest = protocol.value("selftest_errors", info)
    return {
        "operating_state": protocol.state_text(live),
        "errors": alarms.get(Severity.ERROR),
        "warnings": alarms.get(Severity.WARNING),
        "statuses": alarms.get(Severity.STATUS),
        "selftest_errors": _selftest(protocol, selftest),
    }


@lru_cache(maxsize=256)
def _selftest(protocol: EscProtocol, word: int | None) -> list[str] | None:
    if word is None:
        return None
    return bit_texts(word, protocol.errors.get("selftest_errors", ()))


@lru_cache(maxsize=256)
def _alarms(protocol: EscProtocol, word: int | None) -> dict[Severity, list[str]]:
    """The bits of the error word by their class, one without a name is an error; empty without a word."""
    if word is None:
        return {}
    bits = protocol.errors.get("operating_errors", ())
    severities = {bit.text: bit.severity for bit in bits}
    found: dict[Severity, list[str]] = {severity: [] for severity in Severity}
    for text in bit_texts(word, bits):
        found[severities.get(text, Severity.ERROR)].append(text)
    return found


def _numbers(*groups: Group) -> tuple[Value, ...]:
    """The values of these groups that are numbers of the ESC: no flags, no names, no counters of the link."""
    return tuple(
        value
        for value in VALUES.values()
        if value.bit is None
        and not value.names
        and value.name not in _OTHERWISE
        and value.group in groups
        and (value.group is not Group.LINK or value.pace is Group.LIVE)
    )


_LIVE, _INFO, _LINK = (
    tuple(value.name for value in _numbers(group)) for group in (Group.LIVE, Group.INFO, Group.LINK)
)
_UNITS = {value.name: value.unit for value in _numbers(Group.LIVE, Group.INFO, Group.LINK)}
_STATUS_COUNTERS = tuple(
    f.name
    for f in fields(GatewayStatus)
    if f.type in (int, "int") and f.name not in ("esc_count", "escs_ok", "started_ns")
)
_counters_of = attrgetter(*_STATUS_COUNTERS)
