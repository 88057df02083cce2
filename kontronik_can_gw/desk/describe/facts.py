"""Collects everything about what a gateway sends as plain data: the content of ``describe --format json``.

Nothing is defined here: messages and signals are from the DBC in use, objects from the EDS in use, their sources from the compiled layout
and the bindings, errors and states from their definitions. Ids, indices and bit numbers are integers; times in ms.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import IntEnum
from fractions import Fraction
from pathlib import PurePath
from typing import Any, Protocol

from kontronik_can_gw import __version__
from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.cob_ids import all_ids
from kontronik_can_gw.canopen.data_types import ARRAY, DOMAIN, RECORD, VAR, codec
from kontronik_can_gw.canopen.dbc_names import pascal_case
from kontronik_can_gw.canopen.dictionary import Dictionary
from kontronik_can_gw.canopen.eds import Eds
from kontronik_can_gw.canopen.eds_object import Entry
from kontronik_can_gw.canopen.emergency_codes import GatewayError, code_of_bit, register_of
from kontronik_can_gw.canopen.node import Node
from kontronik_can_gw.canopen.nodes import CanopenSetup
from kontronik_can_gw.canopen.objects import BINDINGS
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.describe.line_states import CAN_STATES, GATEWAY_STATES, LINK_STATES, Text
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc
from kontronik_can_gw.esc.kontronik.fields import LiveData, rows
from kontronik_can_gw.esc.kontronik.states import (
    Device,
    ErrorBit,
    OperatingError,
    OperatingState,
    SelfTestError,
    Severity,
    peak_current_of,
)
from kontronik_can_gw.esc.telemetry import MS, EscSettings
from kontronik_can_gw.esc.values import VALUES, Group
from kontronik_can_gw.node_state import UNCONFIGURED
from kontronik_can_gw.signals.plan import Role, SendType, SignalPlan

FORMAT = "kontronik-can-gw description"
VERSION = 1
"""Version of the document: grows when something is renamed or removed, not when something is added."""

BY_GATEWAY = 0xFF
"""Byte 3 of an emergency that is no error bit of the ESC."""
DATA_TYPES: Mapping[int, str] = {
    0x01: "BOOLEAN",
    0x02: "INTEGER8",
    0x03: "INTEGER16",
    0x04: "INTEGER32",
    0x05: "UNSIGNED8",
    0x06: "UNSIGNED16",
    0x07: "UNSIGNED32",
    0x08: "REAL32",
    0x09: "VISIBLE_STRING",
    0x0A: "OCTET_STRING",
    0x0B: "UNICODE_STRING",
    0x0F: "DOMAIN",
    0x11: "REAL64",
    0x15: "INTEGER64",
    0x1B: "UNSIGNED64",
}
"""CiA 301, table 44: the types supported in an EDS."""
_KINDS = {DOMAIN: "DOMAIN", VAR: "VAR", ARRAY: "ARRAY", RECORD: "RECORD"}
_SEND_TYPES = {SendType.CYCLIC: "cyclic", SendType.EVENT: "event", SendType.ON_CHANGE: "on change"}
_AVAILABLE = {
    Group.LIVE: "with fresh live data",
    Group.INFO: "with info of the present device",
    Group.LINK: "always",
    Group.GATEWAY: "always",
}
_BEGINS_WITH = re.compile(r"(?:[0-9A-F]{4}h(?::[0-9A-F]{1,2})?(?:, | and | to | / )?)+: ")
_MASK = (at.SETTINGS, 6)
"""The object that selects the error bits reported as emergencies."""


@dataclass(frozen=True)
class ValueFacts:
    """A row of a value table: raw value and its name."""

    value: int
    name: str


@dataclass(frozen=True)
class SignalFacts:
    """A signal. Physical value in ``unit``: raw * factor + offset. ``start_bit`` as DBC files count; ``page``: multiplexer value."""

    name: str
    start_bit: int
    length: int
    byte_order: str
    signed: bool
    is_float: bool
    unit: str
    factor: float
    offset: float
    minimum: float | None
    maximum: float | None
    """Limits in the DBC, else of what can be sent; None: no limit."""
    not_available: int | None
    """Raw value of the code; None where the signal has none."""
    error: int | None
    page: int | None
    role: str
    """source, alive counter, CRC, constant or multiplexer."""
    source: str | None
    esc: str | None
    comment: str
    values: tuple[ValueFacts, ...]
    notes: tuple[str, ...]
    """Notes on the resolution or range of the source that is lost."""


@dataclass(frozen=True)
class MessageFacts:
    """A message. ``send_type``: of cyclic, event (with each new value), on change. 0 ms: none."""

    name: str
    id: int
    extended: bool
    fd: bool
    length: int
    send_type: tuple[str, ...]
    cycle_ms: float
    delay_ms: float
    """Minimum distance between two frames."""
    comment: str
    signals: tuple[SignalFacts, ...]


@dataclass(frozen=True)
class DbcFacts:
    """The messages that the gateway sends."""

    file: str
    node: str
    comment: str
    messages: tuple[MessageFacts, ...]


@dataclass(frozen=True)
class SourceFacts:
    """A value that signals and objects can carry."""

    name: str
    unit: str
    available: str
    meaning: str
    counter: bool
    """It restarts at 0 after the maximum."""
    bindable: bool
    """True if a signal can be bound to it; otherwise it is for objects only."""
    values: tuple[ValueFacts, ...]
    signals: tuple[str, ...]
    """``Message.Signal`` names that carry it."""
    objects: tuple[str, ...]
    """As ``2000h:02``."""


@dataclass(frozen=True)
class EntryFacts:
    """An entry of the object dictionary. Value in ``unit``: raw * ``resolution``. ``default``: None where the EDS has none."""

    sub: int
    name: str
    type: str
    bits: int | None
    """Length in bits; None for texts and domains."""
    access: str
    readable: bool
    writable: bool
    mappable: bool
    default: int | float | str | None
    plus_node_id: bool
    """True if the node-ID is added to the default."""
    low: int | None
    high: int | None
    unit: str
    resolution: float | None
    source: str | None
    meaning: str


@dataclass(frozen=True)
class ObjectFacts:
    """An object. ``notes``: the lines of the EDS's comment that name it."""

    index: int
    name: str
    kind: str
    notes: tuple[str, ...]
    entries: tuple[EntryFacts, ...]


@dataclass(frozen=True)
class PdoFacts:
    """An enabled transmit PDO. ``mapped``: as ``2000h:02 Battery voltage``, from the lowest bit up."""

    number: int
    cob_id: int
    transmission_type: int
    inhibit_ms: float
    event_ms: float
    mapped: tuple[str, ...]


@dataclass(frozen=True)
class CobIdFacts:
    """A COB-ID that a node sends or receives."""

    id: int
    use: str


@dataclass(frozen=True)
class NodeFacts:
    """The node of an ESC; ``node_id`` None: it waits for LSS."""

    esc: str
    node_id: int | None
    cob_ids: tuple[CobIdFacts, ...]
    pdos: tuple[PdoFacts, ...]


@dataclass(frozen=True)
class EmergencyFacts:
    """An emergency: code (bytes 0 and 1), ``byte3`` bit of the ESC or 255 for the gateway, ``byte4`` None: not fixed."""

    code: int
    byte3: int
    byte4: int | None
    register: int
    """Bits of 1001h that it sets."""
    name: str
    severity: str
    meaning: str
    remedy: str


@dataclass(frozen=True)
class CanopenFacts:
    """The CANopen nodes and their common object dictionary."""

    file: str
    read_only: bool
    notes: tuple[str, ...]
    """Lines of the EDS's comment that name none of its objects."""
    nodes: tuple[NodeFacts, ...]
    objects: tuple[ObjectFacts, ...]
    emergencies: tuple[EmergencyFacts, ...]


@dataclass(frozen=True)
class ErrorFacts:
    """A bit of an error word. ``severity``: error, warning or status."""

    bit: int
    name: str
    severity: str
    meaning: str
    remedy: str


@dataclass(frozen=True)
class StateFacts:
    """A state with its meaning."""

    value: int
    name: str
    meaning: str
    remedy: str


@dataclass(frozen=True)
class DeviceFacts:
    """A kind of ESC. ``peak_current``: the meaning of its peak current, None where not known."""

    value: int
    name: str
    peak_current: str | None
    not_supplied: tuple[str, ...]


@dataclass(frozen=True)
class FaultFacts:
    """A fault that the gateway detects, and the emergency that reports it on a CANopen node."""

    name: str
    meaning: str
    remedy: str
    emergency_code: int


@dataclass(frozen=True)
class Description:
    """The whole description. ``dbc`` or ``canopen`` None: the gateway has no such output."""

    program: str
    escs: tuple[str, ...]
    dbc: DbcFacts | None
    canopen: CanopenFacts | None
    sources: tuple[SourceFacts, ...]
    operating_errors: tuple[ErrorFacts, ...]
    selftest_errors: tuple[ErrorFacts, ...]
    operating_states: tuple[StateFacts, ...]
    devices: tuple[DeviceFacts, ...]
    link_states: tuple[StateFacts, ...]
    can_states: tuple[StateFacts, ...]
    gateway_states: tuple[StateFacts, ...]
    gateway_faults: tuple[FaultFacts, ...]

    def as_json(self) -> dict[str, Any]:
        """The document of ``--format json``."""
        return {"format": FORMAT, "version": VERSION, **asdict(self)}


def describe(
    bus: BusLayout | None, canopen: CanopenSetup | None, escs: Sequence[EscSettings]
) -> Description:
    """Describe a gateway with this DBC, these CANopen nodes and these ESCs. None: without that output."""
    names = tuple(esc.name for esc in escs)
    dbc = None if bus is None else _dbc(bus, names)
    meanings = _meanings()
    return Description(
        program=f"kontronik-can-gw {__version__}",
        escs=names,
        dbc=dbc,
        canopen=None if canopen is None else _canopen(canopen, escs, meanings),
        sources=tuple(_sources(dbc, None if canopen is None else canopen.eds, meanings)),
        operating_errors=_errors(OperatingError),
        selftest_errors=_errors(SelfTestError),
        operating_states=tuple(
            StateFacts(int(s), s.text, s.meaning, s.remedy) for s in OperatingState
        ),
        devices=tuple(_devices()),
        link_states=_states(LINK_STATES),
        can_states=_states(CAN_STATES),
        gateway_states=_states(GATEWAY_STATES),
        gateway_faults=tuple(
            FaultFacts(e.name.lower(), e.meaning, e.remedy, e.value[0]) for e in GatewayError
        ),
    )


# --- the DBC


def _dbc(bus: BusLayout, escs: Sequence[str]) -> DbcFacts:
    found = {message.name: message for message in bus.database.messages}
    messages = []
    for plan in bus.layout.messages:
        message = found[plan.name]
        signals = {signal.name: signal for signal in message.signals}
        messages.append(
            MessageFacts(
                name=plan.name,
                id=plan.can_id,
                extended=plan.extended,
                fd=plan.fd,
                length=plan.length,
                send_type=tuple(
                    text for flag, text in _SEND_TYPES.items() if flag in plan.send_type
                ),
                cycle_ms=_number(Fraction(plan.cycle_ns, MS)),
                delay_ms=_number(Fraction(plan.delay_ns, MS)),
                comment=_line(message.comment),
                signals=tuple(
                    _signal(signal, signals[signal.name], escs) for signal in plan.signals
                ),
            )
        )
    comment = next((bus.comment for bus in bus.database.buses if bus.comment), "")
    return DbcFacts(
        PurePath(bus.layout.file).name, bus.layout.node, _line(comment), tuple(messages)
    )


class _Stated(Protocol):
    """The attributes used of a cantools signal; cantools itself is imported only in some modules."""

    @property
    def start(self) -> int: ...
    @property
    def byte_order(self) -> str: ...
    @property
    def minimum(self) -> float | None: ...
    @property
    def maximum(self) -> float | None: ...
    @property
    def comment(self) -> str | None: ...
    @property
    def choices(self) -> Mapping[int, object] | None: ...


def _signal(plan: SignalPlan, signal: _Stated, escs: Sequence[str]) -> SignalFacts:
    is_flag = (
        plan.length == 1
        and not plan.signed
        and plan.numbers is None
        and plan.factor == 1
        and plan.offset == 0
    )
    has_codes = plan.role is Role.SOURCE and not is_flag
    ends = sorted(float(raw * plan.factor + plan.offset) for raw in (plan.low, plan.high))
    if plan.is_float:
        ends = sorted(raw * float(plan.factor) + float(plan.offset) for raw in plan.limits)
    stated = (signal.minimum, signal.maximum)
    return SignalFacts(
        name=plan.name,
        start_bit=signal.start,
        length=plan.length,
        byte_order=signal.byte_order,
        signed=plan.signed,
        is_float=plan.is_float,
        unit=plan.unit,
        factor=_number(plan.factor),
        offset=_number(plan.offset),
        minimum=_finite(ends[0] if stated[0] is None else stated[0]),
        maximum=_finite(ends[1] if stated[1] is None else stated[1]),
        not_available=plan.not_available if has_codes else None,
        error=plan.error if has_codes else None,
        page=plan.page,
        role=plan.role.value,
        source=None if plan.source is None else plan.source.name,
        esc=None if plan.esc is None else escs[plan.esc],
        comment=_line(signal.comment),
        values=_values({int(number): str(text) for number, text in (signal.choices or {}).items()}),
        notes=tuple(f"{note[:1].upper()}{note[1:]}" for note in plan.notes),
    )


# --- sources


def _meanings() -> dict[str, str]:
    """Meaning of each source: of a flag that of the bit, else the comment of the shipped signal bound to it."""
    shown = layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))
    comments = {
        (m.name, s.name): _line(s.comment) for m in shown.database.messages for s in m.signals
    }
    found = {
        plan.source.name: comments[message.name, plan.name]
        for message in shown.layout.messages
        for plan in message.signals
        if plan.source is not None
    }
    return found | {
        bit.text: bit.meaning for names in (OperatingError, SelfTestError) for bit in names
    }


def _sources(
    dbc: DbcFacts | None, eds: Eds | None, meanings: Mapping[str, str]
) -> Iterator[SourceFacts]:
    signals: dict[str, list[str]] = {}
    for message in dbc.messages if dbc else ():
        for signal in message.signals:
            if signal.source is not None:
                signals.setdefault(signal.source, []).append(f"{message.name}.{signal.name}")
    objects: dict[str, list[str]] = {}
    names: dict[str, str] = {}
    bound = BINDINGS
    for entry in eds.entries if eds else ():
        if (entry.index, entry.sub) in bound:
            name = bound[entry.index, entry.sub].source.name
            objects.setdefault(name, []).append(f"{entry.index:04X}h:{entry.sub:02X}")
            names.setdefault(name, entry.name)
    listed = dict(VALUES)
    for binding in bound.values():
        listed.setdefault(binding.source.name, binding.source)
    for name, source in listed.items():
        in_signals, in_objects = tuple(signals.get(name, ())), tuple(objects.get(name, ()))
        meaning = meanings.get(name) or names.get(name) or name.replace("_", " ").capitalize()
        available = _AVAILABLE[source.group] + (", where supplied" if source.optional else "")
        texts = _values({int(number): text for number, text in source.names.items()})
        yield SourceFacts(
            name,
            source.unit,
            available,
            meaning,
            source.rolls,
            name in VALUES,
            texts,
            in_signals,
            in_objects,
        )


# --- CANopen


def _canopen(
    setup: CanopenSetup, escs: Sequence[EscSettings], meanings: Mapping[str, str]
) -> CanopenFacts:
    eds = setup.eds
    comments = _comments(eds)
    indices = {entry.index for entry in eds.entries}
    objects = []
    for index in sorted(indices):
        entries = [entry for entry in eds.entries if entry.index == index]
        notes = tuple(line for line in comments if index in _named(line))
        facts = tuple(_entry(entry, meanings) for entry in entries)
        objects.append(
            ObjectFacts(
                index, eds.object_names[index], _KINDS[entries[0].object_type], notes, facts
            )
        )
    return CanopenFacts(
        file=PurePath(eds.name).name,
        read_only=any(settings.read_only for settings in setup.settings),
        notes=tuple(line for line in comments if not _named(line) & indices),
        nodes=tuple(
            _node(node, esc) for node, esc in zip(setup.nodes(escs).nodes, escs, strict=True)
        ),
        objects=tuple(objects),
        emergencies=tuple(_emergencies(eds)),
    )


def _entry(entry: Entry, meanings: Mapping[str, str]) -> EntryFacts:
    bound = BINDINGS.get((entry.index, entry.sub))
    source = None if bound is None else bound.source
    number = codec(entry.data_type)
    return EntryFacts(
        sub=entry.sub,
        name=entry.name,
        type=DATA_TYPES[entry.data_type],
        bits=None
        if number is None
        else 1
        if DATA_TYPES[entry.data_type] == "BOOLEAN"
        else 8 * number.size,
        access=entry.access,
        readable=entry.access != "wo",
        writable="w" in entry.access,
        mappable=entry.mappable,
        default=_text(entry.default) if isinstance(entry.default, bytes) else entry.default,
        plus_node_id=entry.relative,
        low=entry.low,
        high=entry.high,
        unit="" if source is None else source.unit,
        resolution=None if bound is None else _number(1 / bound.steps),
        source=None if source is None else source.name,
        meaning="" if source is None else meanings.get(source.name, ""),
    )


def _comments(eds: Eds) -> list[str]:
    """The lines of [Comments]."""
    found: dict[int, str] = {}
    inside = False
    for line in eds.data.decode("latin-1").splitlines():
        text = line.strip()
        if text.startswith("["):
            inside = text.lower() == "[comments]"
        elif inside and (match := re.fullmatch(r"line(\d+)\s*=\s*(.*)", text, re.IGNORECASE)):
            found[int(match[1])] = match[2]
    return [found[number] for number in sorted(found) if found[number]]


def _named(line: str) -> set[int]:
    """Indices that a comment describes: those at its beginning, as ``2100h:5 and 2101h: ...``, else all in it."""
    head = _BEGINS_WITH.match(line)
    return {int(text, 16) for text in re.findall(r"\b([0-9A-F]{4})h\b", head[0] if head else line)}


def _node(node: Node, esc: EscSettings) -> NodeFacts:
    cob_ids = tuple(CobIdFacts(cob_id, use) for cob_id, use in sorted(dict(all_ids(node)).items()))
    pdos = tuple(
        PdoFacts(
            number=tpdo.number + 1,
            cob_id=tpdo.cob_id,
            transmission_type=tpdo.type,
            inhibit_ms=_number(Fraction(tpdo.inhibit_ns, MS)),
            event_ms=_number(Fraction(tpdo.event_ns, MS)),
            mapped=tuple(
                f"{e.index:04X}h:{e.sub:02X} {e.name}"
                for e in (m.variable.entry for m in tpdo.mapped)
            ),
        )
        for tpdo in node.tpdos
        if tpdo.valid and node.node_id != UNCONFIGURED
    )
    return NodeFacts(
        esc.name, None if node.node_id == UNCONFIGURED else node.node_id, cob_ids, pdos
    )


def _emergencies(eds: Eds) -> Iterator[EmergencyFacts]:
    """Emergencies of the ESC's bits that the EDS enables, of the gateway's faults, and of "no error"."""
    mask = Dictionary(eds).number(*_MASK)
    bits = {int(bit): bit for bit in OperatingError}
    for bit in range(32):
        if not mask >> bit & 1:
            continue
        code = code_of_bit(bit)
        named = bits.get(bit)
        if named is None:
            text = ErrorFacts(
                bit,
                f"bit{bit}",
                Severity.ERROR.value,
                "a bit that has no name yet",
                "Ask the maker of the ESC.",
            )
        else:
            text = _error(named)
        yield EmergencyFacts(
            code, bit, None, register_of(code), text.name, text.severity, text.meaning, text.remedy
        )
    for error in GatewayError:
        code, detail = error.value
        byte4 = None if error is GatewayError.HEARTBEAT_LOST else detail
        name, severity = error.name.lower(), Severity.ERROR.value
        yield EmergencyFacts(
            code, BY_GATEWAY, byte4, register_of(code), name, severity, error.meaning, error.remedy
        )
    status = Severity.STATUS.value
    yield EmergencyFacts(
        0, BY_GATEWAY, 0, 0, "no_error", status, "no error any more", "Nothing to do."
    )


# --- errors, states, devices


def _errors(names: type[ErrorBit]) -> tuple[ErrorFacts, ...]:
    return tuple(_error(bit) for bit in names)


def _error(bit: ErrorBit) -> ErrorFacts:
    return ErrorFacts(int(bit), bit.text, bit.severity.value, bit.meaning, bit.remedy)


def _states(texts: Mapping[Any, Text]) -> tuple[StateFacts, ...]:
    states: list[IntEnum] = list(texts)
    return tuple(
        StateFacts(int(s), pascal_case(s.name), texts[s].meaning, texts[s].remedy) for s in states
    )


def _devices() -> Iterator[DeviceFacts]:
    wire = rows(LiveData)
    for device in Device:
        missing = tuple(name for name, row in wire.items() if device in row.not_on)
        yield DeviceFacts(int(device), device.text, peak_current_of(device), missing)


def _values(texts: Mapping[int, str]) -> tuple[ValueFacts, ...]:
    return tuple(ValueFacts(number, texts[number]) for number in sorted(texts))


def _number(value: Fraction) -> int | float:
    return value.numerator if value.denominator == 1 else float(value)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _text(data: bytes) -> str:
    """Printable text unchanged, other bytes in hexadecimal."""
    return (
        data.decode("ascii")
        if data.isascii() and data.decode("ascii").isprintable()
        else data.hex(" ")
    )


def _line(text: object) -> str:
    """A comment as one line."""
    return " ".join(str(text or "").split())
