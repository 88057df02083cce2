"""The CANopen side as a DBC: transmit PDOs as they are mapped now, heartbeats and emergencies, so that a plain logger reads them.

Nodes in, text out. Rules: those of the shipped DBC, but PDOs know no Error code: what cannot be shown is NotAvailable (all bits set,
signed: only the sign bit).
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.bound_values import message_plan
from kontronik_can_gw.canopen.cob_ids import HEARTBEAT
from kontronik_can_gw.canopen.dbc_names import Names, emergency_names, pascal_case
from kontronik_can_gw.canopen.dictionary import Variable
from kontronik_can_gw.canopen.eds import Entry
from kontronik_can_gw.canopen.emergency_codes import Register
from kontronik_can_gw.canopen.node import Node
from kontronik_can_gw.canopen.nodes import Nodes
from kontronik_can_gw.canopen.pdo import EVENT_TYPES, Tpdo
from kontronik_can_gw.dbc.names import esc_prefix
from kontronik_can_gw.esc.decoder import EscProtocol
from kontronik_can_gw.esc.telemetry import MS, EscSettings, LinkState
from kontronik_can_gw.node_state import UNCONFIGURED, NmtState
from kontronik_can_gw.signals.plan import SignalPlan

_MAX_START_VALUE_BITS = 32
"""That the range of GenSigStartValue holds."""
_ASCII_UNITS = {"°C": "degC", "µs": "us"}
_LINK_BITS, _REPLAY_BIT, _INFO_BIT = 6, 6, 7
"""Of the link status 2020h:1."""
_MIRRORS = 0x6000
"""From here on objects show what others show too, under names of CiA 402."""
_NOTES = {
    "peak_current": " A held maximum that does not fall back when the motor stops.",
    "bec_current": " Not supplied by a JIVEPro.",
    "firmware": " Main version times 256, and the sub version.",
    "data_age": " 65534 stands for that or more.",
    "info_age": " 65534 stands for that or more.",
}
"""What a reader must know of a source beside its name and unit."""
_SYNTAX = str.maketrans('";\\', "',/")
_SEND_TYPES = ("Cyclic", "Event", "OnChange", "CyclicAndEvent", "CyclicAndOnChange", "None")
_LAYOUT_VERSION = "1.0.0"
_HEAD = 'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: KontronikGateway Logger'
_ABOUT_NODES = """CM_ BU_ KontronikGateway "Gateway that is a CANopen node for each KONTRONIK ESC.";
CM_ BU_ Logger "Any receiver: logger, display or controller.";"""
_DEFINITIONS = f"""\
BA_DEF_ "LayoutVersion" STRING ;
BA_DEF_ "BusType" STRING ;
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ BO_ "GenMsgSendType" ENUM {",".join(f'"{name}"' for name in _SEND_TYPES)};
BA_DEF_ BO_ "GenMsgDelayTime" INT 0 65535;
BA_DEF_ SG_ "GenSigStartValue" FLOAT -2147483648 4294967295;

BA_DEF_DEF_ "LayoutVersion" "";
BA_DEF_DEF_ "BusType" "CAN";
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "GenMsgSendType" "None";
BA_DEF_DEF_ "GenMsgDelayTime" 0;
BA_DEF_DEF_ "GenSigStartValue" 0;

BA_ "LayoutVersion" "{_LAYOUT_VERSION}";
BA_ "BusType" "CAN";"""


@dataclass
class _Signal:
    """A little-endian signal. ``stem`` and ``end``: its name, see ``Names``; numbers are raw; a float has no limits."""

    stem: str
    start: int
    length: int
    comment: str
    end: str = ""
    signed: bool = False
    is_float: bool = False
    factor: Fraction = Fraction(1)
    unit: str = ""
    low: int = 0
    high: int = 1
    start_value: int = 0
    texts: Mapping[int, str] = field(default_factory=dict)
    name: str = ""

    @property
    def line(self) -> str:
        ends = (0, 0) if self.is_float else (self.low * self.factor, self.high * self.factor)
        low, high, factor = map(_number, (*ends, self.factor))
        place = f"{self.start}|{self.length}@1{'-' if self.signed else '+'}"
        return f' SG_ {self.name} : {place} ({factor},0) [{low}|{high}] "{self.unit}" Logger'


@dataclass
class _Message:
    """``schedule``: send type, cycle and least distance in ms."""

    stem: str
    cob_id: int
    length: int
    comment: str
    schedule: tuple[str, int, int]
    signals: list[_Signal]
    name: str = ""


def dbc_text(nodes: Nodes, escs: Sequence[EscSettings]) -> str:
    """What the nodes send by themselves, as they are configured now; ``escs`` in their order.

    With several ESCs each name begins with that of its ESC. Nodes that wait for LSS have no frames; the file's comment names them.
    """
    names = Names(), Names()
    messages: list[_Message] = []
    for node, esc in zip(nodes.nodes, escs, strict=True):
        if node.node_id != UNCONFIGURED:
            prefix = esc_prefix(esc.name) if len(escs) > 1 else ""
            messages += [_with_names(message, prefix, *names) for message in _messages(node)]
    frames: list[str] = []
    comments: list[str] = []
    attributes: list[str] = []
    starts: list[str] = []
    tables: list[str] = []
    floats: list[str] = []
    for m in messages:
        kind, cycle, delay = m.schedule
        frames.append(f"\nBO_ {m.cob_id} {m.name}: {m.length} KontronikGateway")
        comments.append(f'CM_ BO_ {m.cob_id} "{m.comment}";')
        attributes.append(f'BA_ "GenMsgCycleTime" BO_ {m.cob_id} {cycle};')
        attributes.append(f'BA_ "GenMsgSendType" BO_ {m.cob_id} {_SEND_TYPES.index(kind)};')
        attributes.append(f'BA_ "GenMsgDelayTime" BO_ {m.cob_id} {delay};')
        for s in sorted(m.signals, key=lambda signal: signal.start):
            place = f"{m.cob_id} {s.name}"
            frames.append(s.line)
            comments.append(f'CM_ SG_ {place} "{s.comment}";')
            starts.append(f'BA_ "GenSigStartValue" SG_ {place} {s.start_value};')
            if s.texts:
                texts = " ".join(f'{raw} "{text}"' for raw, text in sorted(s.texts.items()))
                tables.append(f"VAL_ {place} {texts} ;")
            if s.is_float:
                floats.append(f"SIG_VALTYPE_ {place} : {1 if s.length == 32 else 2};")
    begin = [_HEAD, *frames, "", f'CM_ "{_about(nodes, escs)}";', _ABOUT_NODES, *comments, ""]
    end = [_DEFINITIONS, *attributes, *starts, "", *tables, *([""] if floats else []), *floats]
    return "\n".join([*begin, *end, ""])


def _with_names(message: "_Message", prefix: str, messages: Names, signals: Names) -> "_Message":
    message.name = messages.take(prefix or "Esc", message.stem)
    for signal in message.signals:
        signal.name = signals.take(prefix, signal.stem, signal.end)
    return message


def waiting_for_lss(nodes: Nodes, escs: Sequence[EscSettings]) -> list[str]:
    """Names of the ESCs whose nodes have no node-ID, and so no frames."""
    pairs = zip(nodes.nodes, escs, strict=True)
    return [esc.name for node, esc in pairs if node.node_id == UNCONFIGURED]


def _number(value: int | Fraction) -> int | float:
    """A number as DBC files have it: the nearest float where it is not whole."""
    return value.numerator if value.denominator == 1 else float(value)


def _about(nodes: Nodes, escs: Sequence[EscSettings]) -> str:
    """The comment of the file."""
    pairs = zip(nodes.nodes, escs, strict=True)
    who = [f"node {n.node_id} ({esc.name})" for n, esc in pairs if n.node_id != UNCONFIGURED]
    parts = [f"KONTRONIK ESC telemetry as CANopen PDOs, layout version {_LAYOUT_VERSION}."]
    if who:
        parts.append(f"Active transmit PDOs, heartbeat and emergencies of {', '.join(who)}.")
    if waiting := waiting_for_lss(nodes, escs):
        parts.append(f"Waiting for a node-ID by LSS, so without frames: {', '.join(waiting)}.")
    parts.append(
        "PDOs are sent while a node is Operational. All bits set (signed: only the sign bit set) means "
        "NotAvailable. A master that maps PDOs in another way makes another file necessary."
    )
    return " ".join(parts)


# --- messages of a node


def _messages(node: Node) -> Iterator[_Message]:
    """PDOs by their number, heartbeat, emergency."""
    for tpdo in node.tpdos:
        if tpdo.valid and tpdo.mapped:
            yield _tpdo(tpdo, node)
    yield _heartbeat(node)
    if not node.emergencies.cob_id >> 31:
        yield _emergency(node)


def _heartbeat(node: Node) -> _Message:
    period = node.dictionary.number(0x1017)
    states = {int(state): pascal_case(state.name) for state in NmtState}
    states[NmtState.INITIALISING] = "BootUp"
    about = f"NMT state of CANopen node {node.node_id}. BootUp is sent once, after each start and reset."
    signal = _Signal("NodeState", 0, 8, about, high=NmtState.PRE_OPERATIONAL, texts=states)
    off = "off (1017h is 0), only the boot-up message is sent"
    about = f"Heartbeat of CANopen node {node.node_id}, {f'every {period} ms' if period else off}."
    schedule = "Cyclic" if period else "Event", period, 0
    return _Message("Heartbeat", HEARTBEAT + node.node_id, 1, about, schedule, [signal])


def _emergency(node: Node) -> _Message:
    errors = node.esc.protocol.errors.get("operating_errors", ())
    names = emergency_names(errors)
    bits = {int(bit): pascal_case(bit.name) for bit in errors}
    sources = {bit: bits.get(bit, f"Bit{bit}") for bit in range(32)} | {0xFF: "Gateway"}
    source = "Bit of the error word of the ESC that caused the emergency, or the gateway."
    word = (
        "Error word of the ESC. Of an emergency of the gateway its detail. For TelemetryFault 1 telemetry lost, 2 CRC errors, "
        "3 port gone, 4 other device than configured. For HeartbeatLost the node-ID."
    )
    signals = [_Signal("EmergencyCode", 0, 16, "Emergency code.", high=max(names), texts=names)]
    for what, mask in Register.__members__.items():
        name, place = f"ErrorRegister{what.title()}", 15 + mask.bit_length()
        signals.append(_Signal(name, place, 1, f"Error register 1001h, {what.lower()} error."))
    more = _Signal("EmergencySource", 24, 8, source, high=0xFF, start_value=0xFF, texts=sources)
    signals += [more, _Signal("EmergencyWord", 32, 32, word, high=0xFFFFFFFF)]
    about = f"Emergencies of CANopen node {node.node_id}, sent when an error comes, NoError when all are gone."
    schedule = "Event", 0, node.dictionary.number(0x1015) // 10
    return _Message("Emergency", node.emergencies.cob_id & 0x7FF, 8, about, schedule, signals)


def _tpdo(tpdo: Tpdo, node: Node) -> _Message:
    plan = message_plan("", tpdo.cob_id, tpdo.mapped)
    signals: list[_Signal] = []
    for variable, place in zip(tpdo.mapped, plan.signals, strict=True):
        signals += _object(variable, place, node.esc.protocol)
    number, cycle, delay = tpdo.number + 1, tpdo.event_ns // MS, tpdo.inhibit_ns // MS
    comment = f"TPDO {number} of CANopen node {node.node_id}."
    if tpdo.type in EVENT_TYPES:
        cause = "OnChange" if tpdo.on_change else "Event"
        schedule = (f"CyclicAnd{cause}" if cycle else cause, cycle, delay)
    else:
        schedule = ("None", 0, 0)
        which = f"every SYNC number {tpdo.type}" if tpdo.type else "a SYNC when there is news"
        comment += f" Sent at {which}."
    return _Message(f"Tpdo{number}", tpdo.cob_id, plan.length, comment, schedule, signals)


def _object(variable: Variable, place: SignalPlan, protocol: EscProtocol) -> list[_Signal]:
    """The signals of one mapped object: several of an error word and of the link status."""
    item, bound = variable.entry, variable.bound
    # a name comes from any EDS: without what a parser may take for syntax
    comment = f"Object {item.place}, {item.name.translate(_SYNTAX)}."
    length, start = place.length, place.pieces[0].at
    signal = _Signal(_stem(item), start, length, comment, "", place.signed, place.is_float)
    signal.low = low = -(1 << length - 1) if place.signed else 0
    signal.high = high = low + (1 << length) - 1
    if bound is None:
        if (item.index, item.sub, length, place.signed) == (at.ERROR_CODE, 0, 16, False):
            signal.texts = emergency_names(protocol.errors.get("operating_errors", ()))
        return [signal]
    source = bound.source
    if not place.signed and (bits := protocol.errors.get(source.name)):
        named = ((int(bit), bit) for bit in bits if bit < length)
        return [
            _Signal(pascal_case(bit.name), start + n, 1, f"{comment} Bit {n}, {bit.meaning}.")
            for n, bit in named
        ]
    if source.name == "link_status" and not place.signed:
        return _link(start, comment)
    names, stem = _named(source.name, source.names, protocol)
    signal.unit = _ASCII_UNITS.get(source.unit, source.unit)
    signal.end = "Percent" if signal.unit == "%" else ""
    signal.stem = (signal.stem if item.index >= _MIRRORS else stem).removesuffix(signal.end)
    signal.factor = 1 / bound.steps
    signal.comment += _NOTES.get(source.name, "")
    if not source.rolls:
        none = low if place.signed else high
        low, high = (low + 1, high) if place.signed else (low, high - 1)
        names = {raw: text for raw, text in names.items() if low <= raw <= high}
        signal.start_value = none if length <= _MAX_START_VALUE_BITS else 0
        signal.texts = names | {none: "NotAvailable"}
    signal.low, signal.high = low, max(names, default=high)
    return [signal]


def _link(start: int, where: str) -> list[_Signal]:
    states = {int(state): pascal_case(state.name) for state in LinkState}
    state = f"{where} State of the telemetry line between ESC and gateway."
    replay = f"{where} The values come from a recording, not from an ESC."
    info = f"{where} The information of the ESC (its info frame) is fresh."
    return [
        _Signal("LinkState", start, _LINK_BITS, state, high=max(states), texts=states),
        _Signal("Replay", start + _REPLAY_BIT, 1, replay),
        _Signal("InfoValid", start + _INFO_BIT, 1, info),
    ]


def _named(
    name: str, names: Mapping[int, str], protocol: EscProtocol
) -> tuple[dict[int, str], str]:
    """Value names and signal name of a source. An enumeration is closed: a number without a name gets one, because tools lose
    all names by one sample that has none."""
    if name == "operating_state_raw":
        texts = {number: state.text for number, state in protocol.states.items()}
        return _closed(texts, 0xFF, "State"), "OperatingState"
    if name == "device_raw":
        wire = protocol.by_name.get(name)
        return _closed(
            protocol.devices, 0 if wire is None else min(wire.high, 0xFF), "Device"
        ), "Device"
    return {int(number): pascal_case(text) for number, text in names.items()}, pascal_case(name)


def _closed(texts: Mapping[int, str], last: int, word: str) -> dict[int, str]:
    return {n: pascal_case(texts.get(n, f"{word}{n}")) for n in range(last + 1)}


def _stem(item: Entry) -> str:
    """A signal's name from an object's, which can be of any characters."""
    stem = pascal_case(item.name)
    is_name = re.fullmatch("[A-Z].*[a-z].*", stem)
    return stem if is_name else f"Object{item.index:04X}Sub{item.sub:02X}"
