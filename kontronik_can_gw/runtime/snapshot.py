"""What the gateway knows of itself, as one JSON document for people and programs.

A snapshot is made by the loop's thread from the gateway and from facts about what the loop owns. Every value in it was fresh when it was
made, or is null.
"""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from enum import Enum
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kontronik_can_gw import __version__
from kontronik_can_gw.esc.decoder import Data, EscProtocol, Severity, bit_texts
from kontronik_can_gw.esc.telemetry import INFO_TIMEOUT_NS, SECOND, EscTelemetry
from kontronik_can_gw.esc.values import VALUES, Group, Value, physical, steps, steps_of, values_of
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.gateway_status import GatewayStatus
from kontronik_can_gw.node_state import UNCONFIGURED
from kontronik_can_gw.runtime.process import ProcessFacts, pid_namespace, start_ticks

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


@dataclass(frozen=True)
class PortFacts:
    """What the loop knows of one ESC's port. ``lost_since_ns``: monotonic, None while it is open."""

    name: str
    path: str
    open: bool
    complaint: str = ""
    reopened: int = 0
    line_errors: Mapping[str, int] = field(default_factory=dict)
    lost_since_ns: int | None = None


@dataclass(frozen=True)
class CanFacts:
    """What the loop knows of the CAN interface; its state and its counters are in GatewayStatus."""

    interface: str
    channel: str
    bitrate: int | None
    open: bool
    complaint: str = ""
    stalled: bool = False
    restart_ms: int | None = None
    error_counters: tuple[int, int] | None = None
    """Transmit and receive error counter of the controller, where known."""


@dataclass(frozen=True)
class StoreFacts:
    """Parameters that wait for the disk, and why the last saving failed ('' where it did not)."""

    waiting: int = 0
    last_error: str = ""


@dataclass(frozen=True)
class ProgramFacts:
    """What stays the same while the process runs. ``started``: wall clock at start, UTC; ``ticks``: start time in /proc."""

    configuration: str
    version: str = __version__
    pid: int = 0
    ticks: int = 0
    pid_namespace: str = ""
    started: str = ""


def program_facts(configuration: Path | str) -> ProgramFacts:
    """About this process."""
    pid = os.getpid()
    return ProgramFacts(
        str(Path(configuration).absolute()),
        pid=pid,
        ticks=start_ticks(pid),
        pid_namespace=pid_namespace(),
        started=utc(time.time()),
    )


def utc(wall: float) -> str:
    """Wall clock seconds as text."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(wall))


def snapshot(
    gateway: Gateway,
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
            "core": gateway.core.language,
            "core_reason": gateway.core_note or None,
        },
        "can": _can(can, status),
        "units": _UNITS,
        "escs": [
            _esc(esc, port, status, now) for esc, port in zip(gateway.escs, ports, strict=True)
        ],
        "nodes": [
            _node(port.name, *found)
            for port, found in zip(ports, gateway.node_states(), strict=False)
        ],
        "outputs": {output.name: found for output in gateway.outputs if (found := output.facts())},
        "store": store and {"waiting": store.waiting, "last_error": store.last_error or None},
        "recording": None if recorder is None else asdict(recorder),
        "log": list(log_lines)[-LOG_LINES:],
    }


def _process(program: ProgramFacts, process: ProcessFacts, uptime_ns: int) -> Document:
    return {
        "pid": program.pid,
        "start_ticks": program.ticks,
        "pid_namespace": program.pid_namespace,
        "started": program.started,
        "uptime_s": _seconds(uptime_ns),
        **asdict(process),
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
        "counters": {name: getattr(status, name) for name in _STATUS_COUNTERS},
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
        "diagnosis": esc.diagnosis() if live is None and port.open else None,
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
            **_physical(esc, _LIVE, lambda value: steps_of(value, esc, live)),
            **_physical(esc, _INFO, lambda value: steps_of(value, esc, info)),
            **_physical(esc, _LINK, lambda value: steps(value, esc, status, now)),
        },
    }


def _physical(
    esc: EscTelemetry, names: Sequence[str], found: Callable[[Value], int | None]
) -> Document:
    values = values_of(esc.protocol)
    return {name: physical(values[name], esc, found(values[name])) for name in names}


def _words(protocol: EscProtocol, live: Data | None, info: Data | None) -> Document:
    """State and error bits in words."""
    alarms = _alarms(protocol, protocol.value("operating_errors", live))
    selftest = protocol.value("selftest_errors", info)
    return {
        "operating_state": protocol.state_text(live),
        "errors": alarms.get(Severity.ERROR),
        "warnings": alarms.get(Severity.WARNING),
        "statuses": alarms.get(Severity.STATUS),
        "selftest_errors": None
        if selftest is None
        else bit_texts(selftest, protocol.errors.get("selftest_errors", ())),
    }


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
