"""What the gateway knows of itself, as one JSON document for people and programs.

A snapshot is made of what the loop's thread copied at one moment, of the gateway and of what the loop owns, in any thread. Every value in
it was fresh at that moment, or is null.
"""

import json
from collections.abc import Sequence
from dataclasses import fields
from enum import Enum
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

from kontronik_can_gw.esc.decoder import Data, EscProtocol, Severity, bit_texts
from kontronik_can_gw.esc.telemetry import INFO_TIMEOUT_NS, EscTelemetry
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
from kontronik_can_gw.runtime.status.facts import (
    CanFacts,
    GatewayFacts,
    PortFacts,
    ProgramFacts,
    StoreFacts,
    utc,
)
from kontronik_can_gw.runtime.system.process import ProcessFacts
from kontronik_can_gw.status import UNCONFIGURED, GatewayStatus, name_in_words
from kontronik_can_gw.times import SECOND

if TYPE_CHECKING:
    from kontronik_can_gw.runtime.files.recorder import RecorderFacts

FORMAT = 1
"""Of the document; another number for a change that readers must know of. New keys may come without one."""
PROGRAM = "kontronik-can-gw"
_encoded = json.JSONEncoder(ensure_ascii=False, check_circular=False, separators=(",", ":")).encode
STALE_NS = 3 * SECOND
"""A document older than this says nothing of now."""
LOG_LINES = 20
_OTHERWISE = ("variant", "device_raw", "firmware_main", "firmware_sub")
"""Values that are shown apart from the others."""

Document = dict[str, Any]
"""As readers have it."""


class Moment(NamedTuple):
    """What a document is made of, in copies that nobody changes. ``now`` monotonic ns, ``wall`` seconds of the wall clock."""

    gateway: GatewayFacts
    now: int
    wall: float
    program: ProgramFacts
    process: ProcessFacts
    ports: Sequence[PortFacts]
    can: CanFacts
    store: StoreFacts | None = None
    log_lines: Sequence[str] = ()
    recorder: "RecorderFacts | None" = None


def snapshot(moment: Moment, before: Moment | None = None) -> str:
    """The document, JSON in one line. ``before``: since when events are counted for its rates; None: it has none."""
    gateway, program, process = moment.gateway, moment.program, moment.process
    status, store, now = gateway.status, moment.store, moment.now
    pairs = zip(moment.ports, gateway.nodes, strict=False)
    document = {
        "format": FORMAT,
        "program": PROGRAM,
        "version": program.version,
        "configuration": program.configuration,
        "monotonic_ns": now,
        "time": utc(moment.wall),
        "process": {
            "pid": program.pid,
            "start_ticks": program.ticks,
            "pid_namespace": program.pid_namespace,
            "started": program.started,
            "uptime_s": _seconds(now - status.started_ns),
            **vars(process),
        },
        "gateway": {
            "state": name_in_words(status.state.name),
            "esc_count": status.esc_count,
            "escs_ok": status.escs_ok,
            "layout": gateway.layout,
            "core": gateway.core,
            "core_reason": gateway.core_note or None,
        },
        "can": _can(moment.can, status),
        "escs": [
            _esc(esc, port, status, now)
            for esc, port in zip(gateway.escs, moment.ports, strict=True)
        ],
        "nodes": [_node(port.name, *node) for port, node in pairs],
        "outputs": gateway.outputs,
        "store": store and {"waiting": store.waiting, "last_error": store.last_error or None},
        "recording": moment.recorder and vars(moment.recorder),
        "log": moment.log_lines[-LOG_LINES:],
        "rates": _rates(moment, before),
    }
    return f'{{"units":{_UNITS},{_encoded(document)[1:]}'


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
        "error_counters": can.error_counters,
        "counters": {name: getattr(status, name) for name in _STATUS_COUNTERS},
    }


def _rates(moment: Moment, before: Moment | None) -> Document | None:
    """What happens in a second: frames on the bus, PDOs of each node."""
    seconds = 0.0 if before is None else (moment.now - before.now) / SECOND
    if before is None or seconds <= 0:
        return None
    new, old = moment.gateway.status, before.gateway.status
    pdos = zip(moment.gateway.nodes, before.gateway.nodes, strict=False)
    return {
        "seconds": round(seconds, 3),
        "sent_frames_per_s": round((new.sent_frames - old.sent_frames) / seconds, 1),
        "received_frames_per_s": round((new.received_frames - old.received_frames) / seconds, 1),
        "pdos_per_s": [round((now - then) / seconds, 1) for (_, _, now), (_, _, then) in pdos],
    }


def _seconds(ns: int) -> float:
    return round(ns / SECOND, 3)


def _esc(esc: EscTelemetry, port: PortFacts, status: GatewayStatus, now: int) -> Document:
    """One ESC. What is not fresh at ``now`` is None, whatever the last call of ``advance`` knew."""
    live, info = esc.live, esc.info
    if live is not None and now - esc.live_bound_ns > esc.settings.timeout_ns:
        live = None
    if info is not None and (
        esc.info_bound_ns is None or now - esc.info_bound_ns > INFO_TIMEOUT_NS
    ):
        info = None
    protocol, rate = esc.protocol, esc.frame_rate
    errors, warnings, statuses = _alarms(protocol, protocol.value("operating_errors", live))
    selftest = protocol.value("selftest_errors", info)
    return {
        "name": esc.settings.name,
        "port": _port(port, now),
        "link": name_in_words(esc.link.name),
        "fresh": live is not None,
        "diagnosis": port.diagnosis if live is None and port.open else None,
        "protocol": protocol.name,
        "layout": protocol.layout_text(esc.layout),
        "device": protocol.device_text(info),
        "variant": protocol.value("variant", info),
        "firmware": protocol.firmware_text(info),
        "peak_current_of": protocol.peak_current_text(info),
        "frame_rate_hz": None if rate is None else rate / 10,
        "data_age_ms": esc.age_ms(now),
        "losses": esc.losses,
        "counters": esc.counters.as_dict()
        | {name: getattr(esc, name) for name in _FURTHER_COUNTERS},
        "operating_state": protocol.state_text(live),
        "errors": errors,
        "warnings": warnings,
        "statuses": statuses,
        "selftest_errors": None
        if selftest is None
        else bit_texts(selftest, protocol.errors.get("selftest_errors", ())),
        "values": _values(esc, live, info, status, now),
    }


def _port(port: PortFacts, now: int) -> Document:
    return {
        "path": port.path,
        "open": port.open,
        "complaint": port.complaint or None,
        "reopened": max(0, port.reopened),
        "lost_for_s": None if port.lost_since_ns is None else _seconds(now - port.lost_since_ns),
        "line_errors": port.line_errors,
    }


def _values(
    esc: EscTelemetry, live: Data | None, info: Data | None, status: GatewayStatus, now: int
) -> dict[str, float | None]:
    found: dict[str, float | None] = dict.fromkeys(_NAMES)
    for names, reading in ((_LIVE, live), (_INFO, info)):
        if reading is not None:
            whole, parts, derived = _rows(esc.protocol, names)
            for name, word in whole:  # as ``physical`` has them
                found[name] = reading[word]
            for name, word, per_unit in parts:
                found[name] = reading[word] / per_unit
            for value in derived:
                found[value.name] = physical(value, esc, steps_of(value, esc, reading))
    for value in _rows(esc.protocol, _LINK)[2]:
        found[value.name] = physical(value, esc, steps(value, esc, status, now))
    return found


@cache
def _rows(
    protocol: EscProtocol, names: tuple[str, ...]
) -> tuple[list[tuple[str, int]], list[tuple[str, int, int]], list[Value]]:
    """Values that are a word of the reading, by name; those that are parts of a unit, and how many make one; the others."""
    values = [values_of(protocol)[name] for name in names]
    plain = [value for value in values if _is_plain(value)]
    return (
        [(value.name, value.words[0]) for value in plain if value.per_unit == 1],
        [(value.name, value.words[0], value.per_unit) for value in plain if value.per_unit != 1],
        [value for value in values if value not in plain],
    )


def _is_plain(value: Value) -> bool:
    is_whole = value.kind is Kind.WIRE and value.supplied and not value.not_on
    is_exact = 10**6 % value.per_unit == 0  # of six decimals
    return is_whole and is_exact and value.divisor is Divisor.ONE


@lru_cache(maxsize=256)
def _alarms(protocol: EscProtocol, word: int | None) -> Sequence[list[str] | None]:
    """The bits of the error word that are errors, warnings, statuses; one without a name is an error. None without a word."""
    if word is None:
        return None, None, None
    bits = protocol.errors.get("operating_errors", ())
    severities = {bit.text: bit.severity for bit in bits}
    found: dict[Severity, list[str]] = {severity: [] for severity in Severity}
    for text in bit_texts(word, bits):
        found[severities.get(text, Severity.ERROR)].append(text)
    return tuple(found.values())


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
_NAMES = _LIVE + _INFO + _LINK
_UNITS = json.dumps(
    {value.name: value.unit for value in _numbers(Group.LIVE, Group.INFO, Group.LINK)}
)
"""As text, in ASCII: a document without any other character is bytes without further ado."""
_FURTHER_COUNTERS = ("suspect_frames", "late_frames", "line_errors")
_STATUS_COUNTERS = tuple(
    f.name
    for f in fields(GatewayStatus)
    if f.type in (int, "int") and f.name not in ("esc_count", "escs_ok", "started_ns")
)
