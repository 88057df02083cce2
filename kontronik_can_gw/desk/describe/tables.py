"""Makes the tables of ``describe`` and of docs/reference.

Rows are made from DBC, EDS, layout and definitions. Only the meanings of the states of link, CAN
controller and gateway are defined here. Ids, indices and bit numbers are integers, times are in ms.
A physical value is raw * factor + offset.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, Field, fields
from fractions import Fraction
from pathlib import PurePath
from typing import Any, NamedTuple

from kontronik_can_gw.canopen.dbc_names import pascal_case
from kontronik_can_gw.canopen.emergency_codes import GatewayError
from kontronik_can_gw.canopen.objects import BINDINGS
from kontronik_can_gw.config.keys import TABLES, shipped
from kontronik_can_gw.dbc.prepare import is_mute, reporter
from kontronik_can_gw.desk.describe.markdown import Row, Table
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc
from kontronik_can_gw.esc.decoder import ErrorBit, EscProtocol, State
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import EscSettings, LinkState
from kontronik_can_gw.esc.values import VALUES, Group
from kontronik_can_gw.signals.packer import float_of
from kontronik_can_gw.signals.plan import MessagePlan, Role, SendType, SignalPlan
from kontronik_can_gw.status import CanState, GatewayState
from kontronik_can_gw.times import MS

_AVAILABLE = {
    Group.LIVE: "with fresh live data",
    Group.INFO: "with info of the present device",
    Group.LINK: "always",
    Group.GATEWAY: "always",
}
_SEND_TYPES = {SendType.CYCLIC: "cyclic", SendType.EVENT: "event", SendType.ON_CHANGE: "on change"}


# --- configuration


def configuration() -> list[Table]:
    """Return a table for each table of the TOML configuration."""
    found = []
    for name, table in TABLES.items():
        title = f"[[{name}]]" if name == "esc" else f"[{name}]"
        found.append(Table(title, [table.__doc__ or ""], _keys(table)))
    return found


def _keys(table: Any) -> list[Row]:
    return [
        {
            "key": key.name,
            "range": key.metadata["kind"].span,
            "default": _default(key),
            "meaning": key.metadata["doc"],
        }
        for key in fields(table)
    ]


def _default(key: Field[Any]) -> object:
    """Return the default as the table shows it. None if it is empty."""
    if key.default_factory is not MISSING or key.default == ():
        return None
    if key.default is MISSING:
        return "required"
    if isinstance(key.default, bool | Fraction):
        return str(key.default).lower()
    default: object = key.default
    return default


# --- DBC


def dbc(bus: BusLayout, escs: Sequence[EscSettings]) -> list[Table]:
    """Return tables of the messages that the gateway sends, and of their signals."""
    copies = bus.copies()
    comment = next((each.comment for each in bus.database.buses if each.comment), "")
    file = f"{PurePath(bus.layout.file).name}, messages of {bus.layout.node}."
    messages: list[Row] = []
    signals: list[Row] = []
    for plan in bus.layout.messages:
        copy = copies[plan.name]
        messages.append(_message(plan, copy.message))
        signal_of_file = {name: signal for signal, name in copy.signals()}
        for signal in plan.signals:
            row = _signal(plan, signal, signal_of_file[signal.name], escs)
            signals.append({"message": plan.name, **row})
    return [
        Table("Messages", [file, _line(comment)], messages),
        Table("Signals", [_SIGNALS], signals, by="message"),
    ]


_SIGNALS = (
    "Column start: numbering as in DBC files. Columns not available and error: raw values. "
    "Column page: value of the multiplexer."
)


def _message(plan: MessagePlan, message: Any) -> Row:
    """Return the row of a message. Without cycle or minimum time, these cells are None."""
    return {
        "name": plan.name,
        "id": plan.can_id,
        "extended": plan.extended,
        "fd": plan.fd,
        "bytes": plan.length,
        "sent": [word for flag, word in _SEND_TYPES.items() if flag in plan.send_type],
        "cycle_ms": number(Fraction(plan.cycle_ns, MS)) or None,
        "delay_ms": number(Fraction(plan.delay_ns, MS)) or None,
        "meaning": _line(message.comment),
    }


def _signal(
    message: MessagePlan, plan: SignalPlan, signal: Any, escs: Sequence[EscSettings]
) -> Row:
    """Return the row of a signal.

    ``min`` and ``max`` are the DBC's, or else the limits of the values that can be sent. ``shows``
    is the name of the value, or the role of the bits.
    """
    is_flag = plan.length == 1 and not plan.signed and plan.factor == 1 and plan.offset == 0
    not_available: int | None = plan.not_available
    error: int | None = plan.error
    if plan.role is not Role.SOURCE or (is_flag and plan.numbers is None):
        not_available = None
        error = None
    limits = plan.limits if plan.is_float else (plan.low, plan.high)
    low, high = sorted(float(raw * plan.factor + plan.offset) for raw in limits)
    choices = {int(value): str(word) for value, word in (signal.choices or {}).items()}
    codes = (not_available, error)
    has_esc = plan.esc is not None and len(escs) > 1
    return {
        "signal": plan.name,
        "start": signal.start,
        "bits": plan.length,
        "type": "flag" if is_flag else _number_type(plan),
        "big_endian": signal.byte_order == "big_endian",
        "page": plan.page,
        "factor": number(plan.factor),
        "offset": number(plan.offset) or None,
        "min": _finite(low if signal.minimum is None else signal.minimum),
        "max": _finite(high if signal.maximum is None else signal.maximum),
        "unit": plan.unit,
        "not_available": not_available,
        "error": error,
        "shows": plan.role.value if plan.source is None else plan.source.name,
        "esc": escs[plan.esc or 0].name if has_esc else None,
        "meaning": " ".join(filter(None, [_line(signal.comment), *_notes(message, plan)])),
        "names": {value: choices[value] for value in sorted(choices) if value not in codes},
    }


def _number_type(plan: SignalPlan) -> str:
    if plan.is_float:
        return "float"
    return "signed" if plan.signed else "unsigned"


def _notes(message: MessagePlan, plan: SignalPlan) -> list[str]:
    """Return sentences about lost range, the loss of telemetry, and constants."""
    notes = list(plan.notes)
    if is_mute(plan):
        found = reporter(message, plan)
        if found is not None:
            notes.append(f"{found.name} reports the loss")
    if plan.unbound:
        notes.append(f"not bound to a value: always {held(plan)}")
    elif plan.role is Role.CONSTANT:
        notes.append(f"always raw {plan.constant}")
    return [f"{note[:1].upper()}{note[1:]}." for note in notes]


def held(signal: SignalPlan) -> str:
    """Return the physical value of a constant with its unit, or its text in the value table."""
    raw: float = signal.constant
    if signal.is_float:
        raw = float_of(signal.constant, signal.length)
    else:
        text = signal.texts.get(signal.constant)
        if text:
            return text
    return f"{raw * float(signal.factor) + float(signal.offset):.10g} {signal.unit}".rstrip()


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


# --- values, errors, states


class Text(NamedTuple):
    """Meaning and remedy of a state."""

    meaning: str
    remedy: str = "Nothing to do."


# fmt: off
LINK_STATES: Mapping[LinkState, Text] = {
    LinkState.NEVER_SEEN: Text(
        "nothing was received since the start",
        "Switch the ESC on. Check the cable and the telemetry setting of the ESC. A KOSMIK sends after one throttle pulse."),
    LinkState.SEARCHING: Text(
        "bytes are received, but no valid frame yet",
        "If this persists: the ESC may be set to another protocol, or the line is disturbed. The log and decode show the probable cause."),
    LinkState.OK: Text("valid frames are received"),
    LinkState.DEGRADED: Text("valid frames are received, with many CRC errors or dropped bytes", GatewayError.CRC_RATE.remedy),
    LinkState.LOST: Text("valid frames were received earlier, but none now", GatewayError.TELEMETRY_LOST.remedy),
    LinkState.PORT_ERROR: Text("the serial port cannot be opened or read", GatewayError.PORT_GONE.remedy),
}
CAN_STATES: Mapping[CanState, Text] = {
    CanState.UNKNOWN: Text("the CAN interface does not report it"),
    CanState.ERROR_ACTIVE: Text("works without errors"),
    CanState.ERROR_WARNING: Text("works, but there are errors on the bus", GatewayError.CAN_PASSIVE.remedy),
    CanState.ERROR_PASSIVE: Text("works, with many errors on the bus", GatewayError.CAN_PASSIVE.remedy),
    CanState.BUS_OFF: Text(
        "switched off because of errors on the bus, so no frame can be sent",
        f"{GatewayError.BUS_OFF_LEFT.remedy} With restart-ms 0, restart the interface by hand."),
    CanState.DOWN: Text(
        "the CAN interface is down or missing, so no frame can be sent",
        "Plug in the adapter, and set the interface up. kontronik-can-gw doctor shows the command."),
}
GATEWAY_STATES: Mapping[GatewayState, Text] = {
    GatewayState.STARTING: Text("opening its ports and the CAN interface"),
    GatewayState.RUNNING: Text("running"),
    GatewayState.STOPPING: Text("shutting down"),
    GatewayState.REPLAY: Text("the values come from a recording, not from an ESC"),
}
# fmt: on


def values(escs: Sequence[EscSettings]) -> list[Table]:
    """Return tables of every value that a signal or object can show, of errors, states, devices."""
    meanings = meanings_of(escs)
    sources = [binding.source for binding in BINDINGS.values()]
    only_objects = {source.name: source for source in sources if source.name not in VALUES}
    rows = []
    for name, value in {**VALUES, **only_objects}.items():
        available = _AVAILABLE[value.group]
        if value.optional:
            available += ", if known"
        row = {
            "name": name,
            "unit": value.unit,
            "available": available,
            "counter": value.rolls,
            "objects": [place(*key) for key, each in BINDINGS.items() if each.source.name == name],
            "only_objects": name in only_objects,
            "meaning": meanings.get(name, name.replace("_", " ").capitalize()),
            "names": {int(number): text for number, text in value.names.items()},
        }
        rows.append(row)
    protocols = protocols_of(escs)
    operating = [(n, state.text, state) for p in protocols for n, state in p.states.items()]
    return [
        Table("Values", _VALUES, rows),
        _errors("Operating errors", "Bits of each live frame.", protocols),
        _errors("Selftest errors", "Bits of the info frame, about once a second.", protocols),
        _states("Operating", operating),
        Table("Devices", [], [_device(p, device) for p in protocols for device in p.devices]),
        _states("Link", [(n, pascal_case(n.name), state) for n, state in LINK_STATES.items()]),
        _states("CAN", [(n, pascal_case(n.name), state) for n, state in CAN_STATES.items()]),
        _states(
            "Gateway", [(n, pascal_case(n.name), state) for n, state in GATEWAY_STATES.items()]
        ),
    ]


_VALUES = (
    "Bind signals of your own DBC to these values, by name or in [dbc.bind]. Units may differ.",
    (
        "Column available: when the value is known. Otherwise its signal is sent as not available. "
        '"If known" marks a value that can be missing even then, for example because the device '
        "does not supply it (see Devices), or because nothing has been received yet."
    ),
    (
        "Column counter: yes if the value restarts at 0 after the maximum of its signal or object. "
        "Column objects: the CANopen objects that show the value. Column only objects: yes if the "
        "value exists for objects only, so no signal can be bound to it."
    ),
)


def place(index: int, sub: int) -> str:
    """Return index and sub-index of an object as text, for example "2001h:01"."""
    return f"{index:04X}h:{sub:02X}"


def _errors(title: str, text: str, protocols: Sequence[EscProtocol]) -> Table:
    word = title.lower().replace(" ", "_")
    rows = [
        {"bit": int(bit), "name": bit.text, "severity": bit.severity.value, **_about(bit)}
        for protocol in protocols
        for bit in protocol.errors.get(word, ())
    ]
    return Table(title, [text], rows)


def _states(title: str, states: Iterable[tuple[int, str, Text | State]]) -> Table:
    rows = [{"value": int(n), "name": name, **_about(state)} for n, name, state in states]
    return Table(f"{title} states", [], rows)


def _about(of: Text | State | ErrorBit) -> Row:
    return {"meaning": of.meaning, "remedy": of.remedy}


def _device(protocol: EscProtocol, device: int) -> Row:
    """Return the row of a device. ``peak_current_of`` is None if it is unknown."""
    live = [field for field in protocol.fields if not field.is_info]
    return {
        "value": device,
        "name": protocol.devices[device],
        "peak_current_of": protocol.peak_current_of.get(device),
        "not_supplied": [field.name for field in live if device in field.not_on],
    }


def protocols_of(escs: Sequence[EscSettings]) -> list[EscProtocol]:
    """Return the protocols of these ESCs, each once."""
    return list(dict.fromkeys(protocol_named(esc.protocol) for esc in escs))


def meanings_of(escs: Sequence[EscSettings]) -> dict[str, str]:
    """Return the meaning of each value by name.

    For a flag it is the meaning of its bit. For other values it is the comment of the signal of the
    shipped DBC that is bound to it.
    """
    shipped_dbc = layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))
    found = {}
    for plan in shipped_dbc.layout.messages:
        message = shipped_dbc.database.get_message_by_name(plan.name)
        for signal in plan.signals:
            if signal.source is not None:
                comment = message.get_signal_by_name(signal.name).comment
                found[signal.source.name] = _line(comment)
    for protocol in protocols_of(escs):
        found |= {bit.text: bit.meaning for bit in protocol.bits.values()}
    return found


def number(value: Fraction) -> int | float:
    """Return a whole number as int, another one as float."""
    return value.numerator if value.denominator == 1 else float(value)


def _line(comment: object) -> str:
    """Return a DBC comment in one line."""
    return " ".join(str(comment or "").split())
