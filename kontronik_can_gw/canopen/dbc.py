"""The CANopen side as a DBC: transmit PDOs as they are mapped now, heartbeats and emergencies, so that a plain logger reads them.

Nodes in, text out. Rules: those of the shipped DBC, but PDOs know no Error code: what cannot be shown is NotAvailable (all bits set,
signed: only the sign bit).
"""

import re
from collections.abc import Iterator, Mapping, Sequence

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
from kontronik_can_gw.dbc.reader import parse_database
from kontronik_can_gw.dbc.writer import MessageRow, SignalRow, dbc_text
from kontronik_can_gw.esc.decoder import EscProtocol
from kontronik_can_gw.esc.telemetry import EscSettings, LinkState
from kontronik_can_gw.signals.plan import SignalPlan
from kontronik_can_gw.status import UNCONFIGURED, NmtState
from kontronik_can_gw.times import MS

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
    "data_age": " 65534 means this age or more.",
    "info_age": " 65534 means this age or more.",
}
"""What a reader must know of a source beside its name and unit."""
_SYNTAX = str.maketrans('";\\', "',/")
_LAYOUT_VERSION = "1.0.0"
_HEAD = f"""\
VERSION ""
NS_ :
BS_:
BU_: KontronikGateway Logger
BO_ 0 None: 0 KontronikGateway
CM_ "%s";
CM_ BU_ KontronikGateway "Gateway that is a CANopen node for each KONTRONIK ESC.";
CM_ BU_ Logger "Any receiver: logger, display or controller.";
BA_DEF_ "LayoutVersion" STRING ;
BA_DEF_ "BusType" STRING ;
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ BO_ "GenMsgSendType" ENUM "Cyclic","Event","OnChange","CyclicAndEvent","CyclicAndOnChange","None";
BA_DEF_ BO_ "GenMsgDelayTime" INT 0 65535;
BA_DEF_ SG_ "GenSigStartValue" FLOAT -2147483648 4294967295;
BA_DEF_DEF_ "LayoutVersion" "";
BA_DEF_DEF_ "BusType" "CAN";
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "GenMsgSendType" "None";
BA_DEF_DEF_ "GenMsgDelayTime" 0;
BA_DEF_DEF_ "GenSigStartValue" 0;
BA_ "LayoutVersion" "{_LAYOUT_VERSION}";
BA_ "BusType" "CAN";
"""
"""All but the messages: a DBC has one, so that it can be read, which is not written."""


def pdo_text(nodes: Nodes, escs: Sequence[EscSettings]) -> str:
    """What the nodes send by themselves, as they are configured now, as DBC text; ``escs`` in their order.

    With several ESCs each name begins with that of its ESC. Nodes that wait for LSS have no frames; the file's comment names them.
    """
    names = Names(), Names()
    messages: list[MessageRow] = []
    for node, esc in zip(nodes.nodes, escs, strict=True):
        if node.node_id != UNCONFIGURED:
            prefix = esc_prefix(esc.name) if len(escs) > 1 else ""
            messages += [_with_names(message, prefix, *names) for message in _messages(node)]
    head = parse_database((_HEAD % _about(nodes, escs)).encode(), "PDOs")
    return dbc_text(head, messages)


def _with_names(message: MessageRow, prefix: str, messages: Names, signals: Names) -> MessageRow:
    message.name = messages.take(prefix or "Esc", message.name)
    for signal in message.signals:
        end = "Percent" if signal.unit == "%" else ""
        signal.name = signals.take(prefix, signal.name.removesuffix(end), end)
    return message


def waiting_for_lss(nodes: Nodes, escs: Sequence[EscSettings]) -> list[str]:
    """Names of the ESCs whose nodes have no node-ID, and so no frames."""
    pairs = zip(nodes.nodes, escs, strict=True)
    return [esc.name for node, esc in pairs if node.node_id == UNCONFIGURED]


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
        "NotAvailable. If a master changes the mapping of PDOs, write this file again."
    )
    return " ".join(parts)


# --- messages of a node


def _message(
    stem: str,
    cob_id: int,
    length: int,
    comment: str,
    schedule: tuple[str, int, int],
    signals: Sequence[SignalRow],
) -> MessageRow:
    """``schedule``: send type, cycle and least distance in ms."""
    kind, cycle, delay = schedule
    attributes: dict[str, object] = {
        "GenMsgCycleTime": cycle,
        "GenMsgSendType": kind,
        "GenMsgDelayTime": delay,
    }
    sender = ["KontronikGateway"]
    return MessageRow(cob_id, stem, length, sender, comment, attributes, signals)


def _signal(
    stem: str,
    start: int,
    length: int,
    comment: str,
    high: int = 1,
    texts: Mapping[int, str] | None = None,
    start_value: int = 0,
) -> SignalRow:
    """An unsigned signal; numbers are raw."""
    more = {"GenSigStartValue": start_value}
    row = SignalRow(stem, start, length, comment, receivers=["Logger"], attributes=more)
    row.limits, row.texts = (0, high), texts or {}
    return row


def _messages(node: Node) -> Iterator[MessageRow]:
    """PDOs by their number, heartbeat, emergency."""
    for tpdo in node.tpdos:
        if tpdo.valid and tpdo.mapped:
            yield _tpdo(tpdo, node)
    yield _heartbeat(node)
    if not node.emergencies.cob_id >> 31:
        yield _emergency(node)


def _heartbeat(node: Node) -> MessageRow:
    period = node.dictionary.number(0x1017)
    states = {int(state): pascal_case(state.name) for state in NmtState}
    states[NmtState.INITIALISING] = "BootUp"
    about = f"NMT state of CANopen node {node.node_id}. BootUp is sent once, after each start and reset."
    signal = _signal("NodeState", 0, 8, about, NmtState.PRE_OPERATIONAL, states)
    off = "off (1017h is 0), only the boot-up message is sent"
    about = f"Heartbeat of CANopen node {node.node_id}, {f'every {period} ms' if period else off}."
    schedule = "Cyclic" if period else "Event", period, 0
    return _message("Heartbeat", HEARTBEAT + node.node_id, 1, about, schedule, [signal])


def _emergency(node: Node) -> MessageRow:
    errors = node.esc.protocol.errors.get("operating_errors", ())
    names = emergency_names(errors)
    bits = {int(bit): pascal_case(bit.name) for bit in errors}
    sources = {bit: bits.get(bit, f"Bit{bit}") for bit in range(32)} | {0xFF: "Gateway"}
    source = "Bit of the error word of the ESC that caused the emergency, or the gateway."
    word = (
        "Error word of the ESC, or the detail of an emergency of the gateway. TelemetryFault: 1 telemetry lost, 2 CRC errors, "
        "3 port gone, 4 other device than configured. HeartbeatLost: the node-ID."
    )
    signals = [_signal("EmergencyCode", 0, 16, "Emergency code.", high=max(names), texts=names)]
    for what, mask in Register.__members__.items():
        name, place = f"ErrorRegister{what.title()}", 15 + mask.bit_length()
        signals.append(_signal(name, place, 1, f"Error register 1001h, {what.lower()} error."))
    more = _signal("EmergencySource", 24, 8, source, high=0xFF, start_value=0xFF, texts=sources)
    signals += [more, _signal("EmergencyWord", 32, 32, word, high=0xFFFFFFFF)]
    about = f"Emergencies of CANopen node {node.node_id}, sent when an error comes, NoError when all are gone."
    schedule = "Event", 0, node.dictionary.number(0x1015) // 10
    return _message("Emergency", node.emergencies.cob_id & 0x7FF, 8, about, schedule, signals)


def _tpdo(tpdo: Tpdo, node: Node) -> MessageRow:
    plan = message_plan("", tpdo.cob_id, tpdo.mapped)
    signals: list[SignalRow] = []
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
    return _message(f"Tpdo{number}", tpdo.cob_id, plan.length, comment, schedule, signals)


def _object(variable: Variable, place: SignalPlan, protocol: EscProtocol) -> list[SignalRow]:
    """The signals of one mapped object: several of an error word and of the link status."""
    item, bound = variable.entry, variable.bound
    # a name comes from any EDS: without what a parser may take for syntax
    comment = f"Object {item.place}, {item.name.translate(_SYNTAX)}."
    length, start = place.length, place.pieces[0].at
    signal = SignalRow(_stem(item), start, length, comment, receivers=["Logger"])
    signal.is_signed, signal.is_float = place.signed, place.is_float
    low = -(1 << length - 1) if place.signed else 0
    high, first = low + (1 << length) - 1, 0
    if bound is None:
        if (item.index, item.sub, length, place.signed) == (at.ERROR_CODE, 0, 16, False):
            signal.texts = emergency_names(protocol.errors.get("operating_errors", ()))
    else:
        source = bound.source
        if not place.signed and (bits := protocol.errors.get(source.name)):
            named = ((int(bit), bit) for bit in bits if bit < length)
            return [
                _signal(pascal_case(bit.name), start + n, 1, f"{comment} Bit {n}, {bit.meaning}.")
                for n, bit in named
            ]
        if source.name == "link_status" and not place.signed:
            return _link(start, comment)
        names, stem = _named(source.name, source.names, protocol)
        signal.unit = _ASCII_UNITS.get(source.unit, source.unit)
        signal.name = signal.name if item.index >= _MIRRORS else stem
        signal.factor = 1 / bound.steps
        signal.comment = comment + _NOTES.get(source.name, "")
        if not source.rolls:
            none = low if place.signed else high
            low, high = (low + 1, high) if place.signed else (low, high - 1)
            names = {raw: text for raw, text in names.items() if low <= raw <= high}
            first = none if length <= _MAX_START_VALUE_BITS else 0
            signal.texts = names | {none: "NotAvailable"}
        high = max(names, default=high)
    if not place.is_float:
        signal.limits = low * signal.factor, high * signal.factor
    signal.attributes = {"GenSigStartValue": first}
    return [signal]


def _link(start: int, where: str) -> list[SignalRow]:
    states = {int(state): pascal_case(state.name) for state in LinkState}
    state = f"{where} State of the telemetry line between ESC and gateway."
    replay = f"{where} The values come from a recording, not from an ESC."
    info = f"{where} The information of the ESC (its info frame) is fresh."
    return [
        _signal("LinkState", start, _LINK_BITS, state, high=max(states), texts=states),
        _signal("Replay", start + _REPLAY_BIT, 1, replay),
        _signal("InfoValid", start + _INFO_BIT, 1, info),
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
