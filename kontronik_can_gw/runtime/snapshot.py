"""What the gateway knows of itself, as one JSON document for people and programs.

A snapshot is made of what the loop's thread copied at one moment, of the gateway and of what the loop owns, in any thread. Every value in
it was fresh at that moment, or is null.
"""

import json
from collections.abc import Sequence
from dataclasses import fields
from enum import Enum
from functools import cache, lru_cache
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

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
    gateway, program, now = moment.gateway, moment.program, moment.now
    status, store, recorder = gateway.status, moment.store, moment.recorder
    state, nodes = name_in_words(status.state.name), _pairs(moment)
    escs = [
        _esc(esc, port, status, now) for esc, port in zip(gateway.escs, moment.ports, strict=True)
    ]
    kept = store and {"waiting": store.waiting, "last_error": store.last_error or None}
    return (
        f'{{"format":{FORMAT},"program":"{PROGRAM}","version":{_json(program.version)},'
        f'"configuration":{_json(program.configuration)},"monotonic_ns":{now},'
        f'"time":"{utc(moment.wall)}","process":{_process(moment)},"gateway":{{"state":"{state}",'
        f'"esc_count":{status.esc_count},"escs_ok":{status.escs_ok},'
        f'"layout":{_json(gateway.layout)},"core":{_json(gateway.core)},'
        f'"core_reason":{_json(gateway.core_note or None)}}},"can":{_can(moment.can, status)},'
        f'"units":{_UNITS},"escs":[{",".join(escs)}],'
        f'"nodes":[{",".join([_node(esc, *found) for esc, found in nodes])}],'
        f'"outputs":{_dumps(gateway.outputs) if gateway.outputs else "{}"},'
        f'"store":{_dumps(kept) if kept else "null"},'
        f'"recording":{_dumps(vars(recorder)) if recorder else "null"},'
        f'"log":[{",".join([_json(line) for line in moment.log_lines[-LOG_LINES:]])}],'
        f'"rates":{_rates(moment, before)}}}'
    )


def _pairs(moment: Moment) -> list[tuple[str, tuple[int, Any, int]]]:
    """The nodes, each with the name of its ESC."""
    return [
        (port.name, node) for port, node in zip(moment.ports, moment.gateway.nodes, strict=False)
    ]


def _process(moment: Moment) -> str:
    program, process = moment.program, moment.process
    return (
        f'{{"pid":{program.pid},"start_ticks":{program.ticks},'
        f'"pid_namespace":{_json(program.pid_namespace)},"started":{_json(program.started)},'
        f'"uptime_s":{_seconds(moment.now - moment.gateway.status.started_ns)},'
        f'"rss_bytes":{process.rss_bytes},"open_fds":{process.open_fds},'
        f'"threads":{process.threads}}}'
    )


def _node(esc: str, node_id: int, state: Enum, pdos_sent: int) -> str:
    number = "null" if node_id == UNCONFIGURED else node_id
    return (
        f'{{"esc":{_json(esc)},"node_id":{number},"state":"{name_in_words(state.name)}",'
        f'"pdos_sent":{pdos_sent}}}'
    )


def _can(can: CanFacts, status: GatewayStatus) -> str:
    return (
        f'{{"interface":{_json(can.interface)},"channel":{_json(can.channel)},'
        f'"bitrate":{_json(can.bitrate)},"state":"{name_in_words(status.can_state.name)}",'
        f'"open":{_json(can.open)},"stalled":{_json(can.stalled)},'
        f'"complaint":{_json(can.complaint or None)},"restart_ms":{_json(can.restart_ms)},'
        f'"error_counters":{_json(can.error_counters)},'
        f'"counters":{_form(_STATUS_COUNTERS) % _counters_of(status)}}}'
    )


def _rates(moment: Moment, before: Moment | None) -> str:
    """What happens in a second: frames on the bus, PDOs of each node."""
    seconds = 0.0 if before is None else (moment.now - before.now) / SECOND
    if before is None or seconds <= 0:
        return "null"
    new, old = moment.gateway.status, before.gateway.status
    sent = round((new.sent_frames - old.sent_frames) / seconds, 1)
    received = round((new.received_frames - old.received_frames) / seconds, 1)
    pdos = [
        round((now - then) / seconds, 1)
        for (_, _, now), (_, _, then) in zip(
            moment.gateway.nodes, before.gateway.nodes, strict=False
        )
    ]
    return (
        f'{{"seconds":{round(seconds, 3)},"sent_frames_per_s":{sent},'
        f'"received_frames_per_s":{received},"pdos_per_s":{pdos}}}'
    )


def _seconds(ns: int) -> float:
    return round(ns / SECOND, 3)


def name_in_words(name: str) -> str:
    """A constant's name as people read it."""
    return name.lower().replace("_", "-")


def _dumps(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"))


_json = lru_cache(1024, typed=True)(_dumps)
"""Of a text, a number or None that stays the same, as a rule."""


@lru_cache(maxsize=64)
def _form(names: tuple[str, ...]) -> str:
    """An object with these keys, and a place for a number each."""
    keys = [f'"{name}":%s' for name in names]
    return f"{{{','.join(keys)}}}"


def _esc(esc: EscTelemetry, port: PortFacts, status: GatewayStatus, now: int) -> str:
    """One ESC. What is not fresh at ``now`` is None, whatever the last call of ``advance`` knew."""
    live, info = esc.live, esc.info
    if live is not None and now - esc.live_bound_ns > esc.settings.timeout_ns:
        live = None
    if info is not None and (
        esc.info_bound_ns is None or now - esc.info_bound_ns > INFO_TIMEOUT_NS
    ):
        info = None
    protocol, rate, age = esc.protocol, esc.frame_rate, esc.age_ms(now)
    counters = esc.counters.as_dict()
    numbers = *counters.values(), esc.suspect_frames, esc.late_frames, esc.line_errors
    diagnosis = port.diagnosis if live is None and port.open else None
    alarms = protocol.value("operating_errors", live), protocol.value("selftest_errors", info)
    return (
        f'{{"name":{_json(esc.settings.name)},"port":{_port(port, now)},'
        f'"link":"{name_in_words(esc.link.name)}","fresh":{_json(live is not None)},'
        f'"diagnosis":{_json(diagnosis)},{_device(protocol, esc.layout, info)},'
        f'"frame_rate_hz":{"null" if rate is None else rate / 10},'
        f'"data_age_ms":{"null" if age is None else age},"losses":{esc.losses},'
        f'"counters":{_form((*counters, *_FURTHER_COUNTERS)) % numbers},'
        f"{_words(protocol, protocol.state_text(live), *alarms)},"
        f'"values":{_values(esc, live, info, status, now)}}}'
    )


def _port(port: PortFacts, now: int) -> str:
    lost = "null" if port.lost_since_ns is None else _seconds(now - port.lost_since_ns)
    errors = _dumps(dict(port.line_errors)) if port.line_errors else "{}"
    return (
        f'{{"path":{_json(port.path)},"open":{_json(port.open)},'
        f'"complaint":{_json(port.complaint or None)},"reopened":{max(0, port.reopened)},'
        f'"lost_for_s":{lost},"line_errors":{errors}}}'
    )


@lru_cache(maxsize=256)
def _device(protocol: EscProtocol, layout: Any, info: Data | None) -> str:
    return (
        f'"protocol":{_json(protocol.name)},"layout":{_json(protocol.layout_text(layout))},'
        f'"device":{_json(protocol.device_text(info))},'
        f'"variant":{_json(protocol.value("variant", info))},'
        f'"firmware":{_json(protocol.firmware_text(info))},'
        f'"peak_current_of":{_json(protocol.peak_current_text(info))}'
    )


def _values(
    esc: EscTelemetry, live: Data | None, info: Data | None, status: GatewayStatus, now: int
) -> str:
    found = [*_of_reading(esc, _LIVE, live), *_of_reading(esc, _INFO, info)]
    for _, value, *_ in _rows(esc.protocol, _LINK):
        found.append(physical(value, esc, steps(value, esc, status, now)))
    return _form(_LIVE + _INFO + _LINK) % tuple(["null" if x is None else x for x in found])


def _of_reading(
    esc: EscTelemetry, names: tuple[str, ...], reading: Data | None
) -> list[float | None]:
    """Values of live data or information."""
    if reading is None:
        return [None] * len(names)
    return [
        physical(value, esc, steps_of(value, esc, reading))
        if word is None
        else reading[word]  # as ``physical`` has it
        if per_unit == 1
        else reading[word] / per_unit
        for _, value, word, per_unit in _rows(esc.protocol, names)
    ]


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
    is_exact = 10**6 % value.per_unit == 0  # of six decimals
    return value.words[0] if is_whole and is_exact and value.divisor is Divisor.ONE else None


@lru_cache(maxsize=256)
def _words(protocol: EscProtocol, state: str | None, word: int | None, selftest: int | None) -> str:
    """State and error bits in words."""
    alarms = _alarms(protocol, word)
    return (
        f'"operating_state":{_json(state)},"errors":{_dumps(alarms.get(Severity.ERROR))},'
        f'"warnings":{_dumps(alarms.get(Severity.WARNING))},'
        f'"statuses":{_dumps(alarms.get(Severity.STATUS))},'
        f'"selftest_errors":{_dumps(_selftest(protocol, selftest))}'
    )


def _selftest(protocol: EscProtocol, word: int | None) -> list[str] | None:
    if word is None:
        return None
    return bit_texts(word, protocol.errors.get("selftest_errors", ()))


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
_UNITS = _dumps({value.name: value.unit for value in _numbers(Group.LIVE, Group.INFO, Group.LINK)})
_FURTHER_COUNTERS = ("suspect_frames", "late_frames", "line_errors")
_STATUS_COUNTERS = tuple(
    f.name
    for f in fields(GatewayStatus)
    if f.type in (int, "int") and f.name not in ("esc_count", "escs_ok", "started_ns")
)
_counters_of = attrgetter(*_STATUS_COUNTERS)
