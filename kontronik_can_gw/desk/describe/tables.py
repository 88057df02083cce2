"""Makes the tables of ``describe`` and of docs/reference.

Rows are made from DBC, EDS, layout and definitions. Only the meanings of the states of link, CAN
controller and gateway are defined here. Ids, indices and bit numbers are integers, times are in ms.
A physical value is raw * factor + offset.
"""

import math
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, fields
from fractions import Fraction
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from kontronik_can_gw.canopen.emergency_codes import GatewayError
from kontronik_can_gw.canopen.objects import BINDINGS
from kontronik_can_gw.config.keys import TABLES, shipped
from kontronik_can_gw.dbc.prepare import is_mute, reporter
from kontronik_can_gw.desk.dbc.canopen_names import pascal_case
from kontronik_can_gw.desk.describe.markdown import MarkdownTable, Row
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc
from kontronik_can_gw.esc.decoder import EscProtocol, StateText
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import EscSettings, LinkState
from kontronik_can_gw.esc.values import VALUES, Divisor, Group, Value
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
_SEND_TYPES = {
    SendType.CYCLIC: "cyclic",
    SendType.EVENT: "event",
    SendType.ON_CHANGE: "on change",
}


# --- configuration


def configuration() -> list[MarkdownTable]:
    """Return a table for each table of the TOML configuration."""
    found = []
    for name, table in TABLES.items():
        title = f"[[{name}]]" if name == "esc" else f"[{name}]"
        found.append(MarkdownTable(title, [table.__doc__ or ""], _keys(table)))
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


def dbc(bus: BusLayout, escs: Sequence[EscSettings]) -> list[MarkdownTable]:
    """Return tables of the messages that the gateway sends, and of their signals."""
    layout = bus.layout
    copies = bus.copies()
    comments = [each.comment for each in bus.database.buses if each.comment]
    comment = comments[0] if comments else ""
    file = f"{PurePath(layout.file).name}, messages of {layout.node}."
    esc_names: dict[int | None, str] = {}
    if len(escs) > 1:
        esc_names.update(enumerate(esc.name for esc in escs))
    messages: list[Row] = []
    signals: list[Row] = []
    for plan in layout.messages:
        copy = copies[plan.name]
        messages.append(_message(plan, copy.message))
        signal_of_file = {name: signal for signal, name in copy.signals()}
        for signal in plan.signals:
            original = signal_of_file[signal.name]
            row: Row = {"message": plan.name}
            row |= _signal(plan, signal, original, esc_names)
            signals.append(row)
    return [
        MarkdownTable("Messages", [file, _line(comment)], messages),
        MarkdownTable("Signals", [_SIGNALS], signals, by="message"),
    ]


_SIGNALS = (
    "Column start: numbering as in DBC files. Columns not available and error: raw values. "
    "Column page: value of the multiplexer."
)


def _message(plan: MessagePlan, message: Any) -> Row:
    """Return the row of a message. Without cycle or minimum time, these cells are None."""
    cycle_ms = Fraction(plan.cycle_ns, MS)
    delay_ms = Fraction(plan.delay_ns, MS)
    return {
        "name": plan.name,
        "id": plan.can_id,
        "extended": plan.extended,
        "fd": plan.fd,
        "bytes": plan.length,
        "sent": [word for flag, word in _SEND_TYPES.items() if flag in plan.send_type],
        "cycle_ms": number(cycle_ms) or None,
        "delay_ms": number(delay_ms) or None,
        "meaning": _line(message.comment),
    }


def _signal(
    message: MessagePlan,
    plan: SignalPlan,
    signal: Any,
    esc_names: Mapping[int | None, str],
) -> Row:
    """Return the row of a signal.

    ``min`` and ``max`` are the DBC's, or else the limits of the values that can be sent. ``shows``
    is the name of the value, or the role of the bits.
    """
    kind = "signed" if plan.signed else "unsigned"
    if plan.is_float:
        kind = "float"
    elif kind == "unsigned" and plan.length == plan.factor == 1 and plan.offset == 0:
        kind = "flag"
    not_available: int | None = plan.not_available
    error: int | None = plan.error
    if plan.role is not Role.SOURCE or (kind == "flag" and plan.numbers is None):
        not_available = None
        error = None
    raws = plan.limits if plan.is_float else (plan.low, plan.high)
    low, high = sorted(float(raw * plan.factor + plan.offset) for raw in raws)
    choices = sorted((signal.choices or {}).items())
    comment = _line(signal.comment)
    notes = [note for note in _notes(message, plan) if note.lower() not in comment.lower()]
    sentences = [comment, *notes]
    return {
        "signal": plan.name,
        "start": signal.start,
        "bits": plan.length,
        "type": kind,
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
        "esc": esc_names.get(plan.esc),
        "meaning": " ".join(filter(None, sentences)),
        "names": {
            int(value): str(word) for value, word in choices if value not in (not_available, error)
        },
    }


def _notes(message: MessagePlan, plan: SignalPlan) -> list[str]:
    """Return sentences about lost range, the loss of telemetry, and constants."""
    notes = list(plan.notes)
    if is_mute(plan):
        found = reporter(message, plan)
        if found is not None:
            notes.append(f"{found.name} reports the loss")
    if plan.role is Role.CRC:
        notes.append(str(message.e2e))
    if plan.is_unbound:
        notes.append(f"not bound to a value: always {held(plan)}")
    elif plan.role in (Role.CONSTANT, Role.DATA_ID):
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
    value = raw * float(signal.factor) + float(signal.offset)
    return f"{value:.10g} {signal.unit}".rstrip()


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


# --- values, errors, states


class Text(NamedTuple):
    """Meaning and remedy of a state."""

    meaning: str
    remedy: str = "Nothing to do."


_REMEDIES = {error.name: error.remedy for error in GatewayError}
_STATES = tomllib.loads(Path(__file__).with_name("states.toml").read_text(encoding="ascii"))


def _texts_of(states: Any, kind: str) -> dict[Any, Text]:
    """Return the meanings and remedies of the states of an enumeration."""
    found = {}
    for name, row in _STATES[kind].items():
        text = Text(**row)
        found[states[name]] = text._replace(remedy=text.remedy.format(**_REMEDIES))
    return found


LINK_STATES: Mapping[LinkState, Text] = _texts_of(LinkState, "link")
CAN_STATES: Mapping[CanState, Text] = _texts_of(CanState, "can")
GATEWAY_STATES: Mapping[GatewayState, Text] = _texts_of(GatewayState, "gateway")


def values(escs: Sequence[EscSettings]) -> list[MarkdownTable]:
    """Return tables of every value that a signal or object can show, of errors, states, devices."""
    meanings = meanings_of(escs)
    only_objects = {}
    objects_of: dict[str, list[str]] = {}
    for key, binding in BINDINGS.items():
        source = binding.source
        objects_of.setdefault(source.name, []).append(place(*key))
        if source.name not in VALUES:
            only_objects[source.name] = source
    rows = []
    for name, value in {**VALUES, **only_objects}.items():
        plain_name = name.replace("_", " ").capitalize()
        available = _AVAILABLE[value.group]
        if value.optional:
            available += ", if known"
        row = {
            "name": name,
            "unit": value.unit,
            "resolution": _resolution(value),
            "available": available,
            "counter": value.rolls,
            "objects": objects_of.get(name, []),
            "only_objects": name in only_objects,
            "meaning": meanings.get(name, plain_name),
            "names": {int(number): text for number, text in value.names.items()},
        }
        rows.append(row)
    protocols = protocols_of(escs)
    operating = []
    devices = []
    for protocol in protocols:
        for code, state in protocol.states.items():
            operating.append((code, state.text, state))
        devices += [_device(protocol, device) for device in protocol.devices]
    return [
        MarkdownTable("Values", _VALUES, rows),
        _errors("Operating errors", "Bits of each live frame.", protocols),
        _errors("Selftest errors", "Bits of the info frame, about once a second.", protocols),
        _states("Operating", operating),
        MarkdownTable("Devices", [], devices),
        _states("Link", _named(LINK_STATES)),
        _states("CAN", _named(CAN_STATES)),
        _states("Gateway", _named(GATEWAY_STATES)),
    ]


def _resolution(value: Value) -> str:
    """Return the steps of a value in its unit. Empty for a value without a unit."""
    if not value.unit:
        return ""
    step = f"{1 / value.per_unit:.3g}"
    if value.divisor is Divisor.ONE:
        return step
    return f"{step} / ({value.divisor.value.replace(' and ', ' x ')})"


def _named(states: Mapping[Any, Text]) -> Iterator[tuple[int, str, Text]]:
    """Yield number, name and description of each state of the gateway."""
    for state, text in states.items():
        yield state, pascal_case(state.name), text


_VALUES = (
    "Bind signals of your own DBC to these values, by name or in [dbc.bind]. Units may differ.",
    "Column resolution: the steps of the value. A signal with a finer factor has these steps, too.",
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


def _errors(title: str, text: str, protocols: Sequence[EscProtocol]) -> MarkdownTable:
    word = title.lower().replace(" ", "_")
    rows = [
        {
            "bit": int(bit),
            "name": bit.text,
            "severity": bit.severity.value,
            "meaning": bit.meaning,
            "remedy": bit.remedy,
        }
        for protocol in protocols
        for bit in protocol.errors.get(word, ())
    ]
    return MarkdownTable(title, [text], rows)


def _states(title: str, states: Iterable[tuple[int, str, Text | StateText]]) -> MarkdownTable:
    rows = [
        {
            "value": int(value),
            "name": name,
            "meaning": state.meaning,
            "remedy": state.remedy,
        }
        for value, name, state in states
    ]
    return MarkdownTable(f"{title} states", [], rows)


def _device(protocol: EscProtocol, device: int) -> Row:
    """Return the row of a device. ``peak_current_of`` is None if it is unknown."""
    return {
        "value": device,
        "name": protocol.devices[device],
        "peak_current_of": protocol.peak_current_of.get(device),
        "not_supplied": [
            field.name for field in protocol.fields if not field.is_info and device in field.not_on
        ],
    }


def protocols_of(escs: Sequence[EscSettings]) -> list[EscProtocol]:
    """Return the protocols of these ESCs, each once."""
    return list(dict.fromkeys(protocol_named(esc.protocol) for esc in escs))


_LIMITS = re.compile(
    r" (It restarts at 0 after \d+|NotAvailable before the first frame, Error [^.]*)\."
)
"""Sentences of a comment that hold for the signal, but not for an object with more bits."""


def meanings_of(escs: Sequence[EscSettings]) -> dict[str, str]:
    """Return the meaning of each value by name.

    For a flag it is the meaning of its bit. For other values it is the comment of the signal of the
    shipped DBC that is bound to it, without the limits of this signal.
    """
    shipped_dbc = layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))
    found = {}
    for plan in shipped_dbc.layout.messages:
        message = shipped_dbc.database.get_message_by_name(plan.name)
        for signal in plan.signals:
            if signal.source is not None:
                comment = message.get_signal_by_name(signal.name).comment
                found[signal.source.name] = _LIMITS.sub("", _line(comment))
    for protocol in protocols_of(escs):
        for bit in protocol.bits.values():
            found[bit.text] = bit.meaning
    return found


def number(value: Fraction) -> int | float:
    """Return a whole number as int, another one as float."""
    return value.numerator if value.denominator == 1 else float(value)


def _line(comment: object) -> str:
    """Return a DBC comment in one line."""
    return " ".join(str(comment or "").split())
