"""Makes the status document: the state of the gateway as JSON, for people and programs.

The document is made from copies of the state that the loop's thread has taken at one moment. So any
thread can make it. Every value in it was fresh at that moment, or is null.
"""

import json
from collections.abc import Sequence
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
from kontronik_can_gw.runtime.system.clock import ClockFacts
from kontronik_can_gw.runtime.system.process import ProcessFacts
from kontronik_can_gw.status import COUNTERS, UNCONFIGURED, GatewayStatus, name_in_words
from kontronik_can_gw.times import SECOND

if TYPE_CHECKING:
    from kontronik_can_gw.runtime.files.recorder import RecorderFacts

FORMAT = 1
"""Version of the document. New keys do not change it, but incompatible changes do."""
PROGRAM = "kontronik-can-gw"
_encoded = json.JSONEncoder(ensure_ascii=False, check_circular=False, separators=(",", ":")).encode
STALE_NS = 3 * SECOND
"""An older document is out of date."""
LOG_LINES = 20
_OTHERWISE = ("variant", "device_raw", "firmware_main", "firmware_sub")
"""Values that have their own keys, apart from ``values``."""

Document = dict[str, Any]
"""A part of the document."""


class Moment(NamedTuple):
    """The data of a document. The copies in it never change."""

    gateway: GatewayFacts
    now: int
    """Monotonic time in ns."""
    wall: float
    """Unix time in seconds."""
    program: ProgramFacts
    process: ProcessFacts
    ports: Sequence[PortFacts]
    can: CanFacts
    store: StoreFacts | None = None
    log_lines: Sequence[str] = ()
    recorder: "RecorderFacts | None" = None
    clock: ClockFacts = ClockFacts()


def snapshot(moment: Moment, before: Moment | None = None) -> str:
    """Return the document as one line of JSON.

    Its rates count from ``before``, the data of an earlier document. Without it there are no rates.
    """
    gateway = moment.gateway
    program = moment.program
    status = gateway.status
    now = moment.now
    escs = []
    for esc, port in zip(gateway.escs, moment.ports, strict=True):
        escs.append(_esc(esc, port, status, now))
    nodes = []
    for port, node in zip(moment.ports, gateway.nodes, strict=False):
        node_id = None if node.node_id == UNCONFIGURED else node.node_id
        state = name_in_words(node.state.name)
        nodes.append({"esc": port.name, "node_id": node_id, "state": state, "pdos_sent": node.sent})
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
            **vars(moment.process),
        },
        "gateway": {
            "state": name_in_words(status.state.name),
            "esc_count": status.esc_count,
            "escs_ok": status.escs_ok,
            "layout": gateway.layout,
            "core": gateway.core,
            "core_reason": gateway.core_reason or None,
        },
        "can": {
            **moment.can._asdict(),
            "state": name_in_words(status.can_state.name),
            "counters": {name: getattr(status, name) for name in COUNTERS},
        },
        "escs": escs,
        "nodes": nodes,
        "outputs": gateway.outputs,
        "store": None if moment.store is None else moment.store._asdict(),
        "recording": None if moment.recorder is None else vars(moment.recorder),
        "clock": _clock(moment.clock),
        "log": moment.log_lines[-LOG_LINES:],
        "rates": _rates(moment, before),
    }
    return f'{{"units":{_UNITS},{_encoded(document)[1:]}'


def _clock(clock: ClockFacts) -> Document:
    """Return the state of the wall clock. null means unknown."""
    step_ns = clock.last_step_ns
    return {
        "synchronized": clock.synchronized,
        "max_error_s": clock.max_error_s,
        "hardware": clock.hardware,
        "steps": clock.steps,
        "last_step": None if step_ns is None else utc(step_ns / SECOND),
        "last_step_s": None if step_ns is None else _seconds(clock.last_step_by_ns),
    }


def _rates(moment: Moment, before: Moment | None) -> Document | None:
    """Return the rates per second: frames on the bus, PDOs of each node."""
    if before is None or moment.now <= before.now:
        return None
    seconds = (moment.now - before.now) / SECOND
    new = moment.gateway.status
    old = before.gateway.status
    sent = new.sent_frames - old.sent_frames
    received = new.received_frames - old.received_frames
    pdos_per_s = []
    for new_node, old_node in zip(moment.gateway.nodes, before.gateway.nodes, strict=False):
        pdos = new_node.sent - old_node.sent
        pdos_per_s.append(round(pdos / seconds, 1))
    return {
        "seconds": round(seconds, 3),
        "sent_frames_per_s": round(sent / seconds, 1),
        "received_frames_per_s": round(received / seconds, 1),
        "pdos_per_s": pdos_per_s,
    }


def _seconds(ns: int) -> float:
    return round(ns / SECOND, 3)


def _esc(esc: EscTelemetry, port: PortFacts, status: GatewayStatus, now: int) -> Document:
    """Return one ESC. Values that are not fresh at ``now`` are None.

    They may have expired since the last call of ``advance``.
    """
    live = esc.live
    info = esc.info
    if live is not None and now > esc.live_until_ns:
        live = None
    if esc.info_bound_ns is None or now - esc.info_bound_ns > INFO_TIMEOUT_NS:
        info = None
    diagnosis = None
    if live is None and port.open:
        diagnosis = port.diagnosis
    frame_rate_hz = None
    if esc.frame_rate is not None:
        frame_rate_hz = esc.frame_rate / 10
    protocol = esc.protocol
    word = protocol.value("operating_errors", live)
    errors, warnings, statuses = _alarms(protocol, word)
    counters = esc.counters.as_dict()
    for name in _FURTHER_COUNTERS:
        counters[name] = getattr(esc, name)
    selftest_errors = None
    selftest = protocol.value("selftest_errors", info)
    if selftest is not None:
        selftest_errors = bit_texts(selftest, protocol.errors.get("selftest_errors", ()))
    return {
        "name": esc.settings.name,
        "port": _port(port, now),
        "link": name_in_words(esc.link.name),
        "fresh": live is not None,
        "diagnosis": diagnosis,
        "protocol": protocol.name,
        "layout": protocol.layout_text(esc.layout),
        "device": protocol.device_text(info),
        "variant": protocol.value("variant", info),
        "firmware": protocol.firmware_text(info),
        "peak_current_of": protocol.peak_current_text(info),
        "frame_rate_hz": frame_rate_hz,
        "data_age_ms": esc.age_ms(now),
        "losses": esc.losses,
        "counters": counters,
        "operating_state": protocol.state_text(live),
        "errors": errors,
        "warnings": warnings,
        "statuses": statuses,
        "selftest_errors": selftest_errors,
        "values": _values(esc, live, info, status, now),
    }


def _port(port: PortFacts, now: int) -> Document:
    lost_for_s = None
    if port.lost_since_ns is not None:
        lost_for_s = _seconds(now - port.lost_since_ns)
    return {
        "path": port.path,
        "open": port.open,
        "complaint": port.complaint or None,
        "reopened": port.reopened,
        "lost_for_s": lost_for_s,
        "line_errors": port.line_errors,
    }


def _values(
    esc: EscTelemetry,
    live: Data | None,
    info: Data | None,
    status: GatewayStatus,
    now: int,
) -> dict[str, float | None]:
    found: dict[str, float | None] = dict.fromkeys(_NAMES)
    for names, reading in ((_LIVE, live), (_INFO, info)):
        if reading is not None:
            whole, parts, derived = _rows(esc.protocol, names)
            for name, word in whole:  # the same results as of ``physical``, but faster
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
    """Return three lists of values:

    1. values that are a word of the reading: name and position of the word,
    2. values whose word must be divided: name, position and divisor,
    3. all other values.
    """
    whole = []
    parts = []
    derived = []
    for name in names:
        value = values_of(protocol)[name]
        if not _is_plain(value):
            derived.append(value)
        elif value.per_unit == 1:
            whole.append((name, value.words[0]))
        else:
            parts.append((name, value.words[0], value.per_unit))
    return whole, parts, derived


def _is_plain(value: Value) -> bool:
    is_whole = value.kind is Kind.WIRE and value.supplied and not value.not_on
    is_exact = 10**6 % value.per_unit == 0  # six decimals suffice
    return is_whole and is_exact and value.divisor is Divisor.ONE


@lru_cache(maxsize=256)
def _alarms(protocol: EscProtocol, word: int | None) -> Sequence[list[str] | None]:
    """Return the texts of the errors, warnings and statuses in the error word.

    A bit without a name is an error. All three are None without a word.
    """
    if word is None:
        return None, None, None
    bits = protocol.errors.get("operating_errors", ())
    severities = {bit.text: bit.severity for bit in bits}
    found: dict[Severity, list[str]] = {severity: [] for severity in Severity}
    for text in bit_texts(word, bits):
        found[severities.get(text, Severity.ERROR)].append(text)
    return tuple(found.values())


def _numbers(*groups: Group) -> tuple[Value, ...]:
    """Return the values of these groups that are numbers of the ESC.

    Flags, enumerations and counters of the link are left out.
    """
    found = []
    for value in VALUES.values():
        is_number = value.bit is None and not value.names
        is_of_esc = value.group is not Group.LINK or value.pace is Group.LIVE
        if is_number and is_of_esc and value.group in groups and value.name not in _OTHERWISE:
            found.append(value)
    return tuple(found)


_LIVE = tuple(value.name for value in _numbers(Group.LIVE))
_INFO = tuple(value.name for value in _numbers(Group.INFO))
_LINK = tuple(value.name for value in _numbers(Group.LINK))
_NAMES = _LIVE + _INFO + _LINK
_UNITS = json.dumps(
    {value.name: value.unit for value in _numbers(Group.LIVE, Group.INFO, Group.LINK)}
)
"""The units as text in ASCII. A document in ASCII is converted to bytes most quickly."""
_FURTHER_COUNTERS = ("suspect_frames", "late_frames", "line_errors")
