"""Writes a DBC of the CANopen nodes, with which a logger can decode their frames.

It contains the transmit PDOs with their present mapping, heartbeats and emergencies. It follows the
rules of the shipped DBC, except that PDOs have no code for Error. A value that cannot be shown is
NotAvailable (all bits set, or only the sign bit for signed types).
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
from kontronik_can_gw.canopen.objects import Bound
from kontronik_can_gw.canopen.pdo import EVENT_TYPES, Tpdo
from kontronik_can_gw.dbc.names import esc_prefix
from kontronik_can_gw.dbc.reader import parse_database
from kontronik_can_gw.dbc.writer import MessageRow, SignalRow, dbc_text
from kontronik_can_gw.esc.decoder import ErrorBit, EscProtocol
from kontronik_can_gw.esc.telemetry import EscSettings, LinkState
from kontronik_can_gw.signals.plan import SignalPlan
from kontronik_can_gw.status import UNCONFIGURED, NmtState
from kontronik_can_gw.times import MS

_MAX_START_VALUE_BITS = 32
"""Maximum length of a signal whose start value fits the range of GenSigStartValue."""
_ASCII_UNITS = {"°C": "degC", "µs": "us"}
# Bits of the link status 2020h:01
_LINK_BITS = 6
_REPLAY_BIT = 6
_INFO_BIT = 7
_MIRRORS = 0x6000
"""Objects from this index have the values of other objects, under names of CiA 402."""
_NOTES = {
    "peak_current": " A held maximum that does not fall back when the motor stops.",
    "bec_current": " Not supplied by a JIVEPro.",
    "firmware": " Main version times 256, and the sub version.",
    "data_age": " 65534 means this age or more.",
    "info_age": " 65534 means this age or more.",
}
"""Notes on a source for the comment of its signal."""
_SYNTAX = str.maketrans('";\\', "',/")
_LAYOUT_VERSION = "1.0.0"
_SEND_TYPES = '"Cyclic","Event","OnChange","CyclicAndEvent","CyclicAndOnChange","None"'
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
BA_DEF_ BO_ "GenMsgSendType" ENUM {_SEND_TYPES};
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
"""The DBC without its messages. The message in it is not written. It only makes the text valid."""


def pdo_text(nodes: Nodes, escs: Sequence[EscSettings]) -> str:
    """Return the messages that the nodes send on their own, as DBC text.

    ``escs`` has the order of the nodes. With several ESCs, each name has its ESC's name as prefix.
    Nodes that wait for LSS have no messages, but the comment of the file names them.
    """
    message_names = Names()
    signal_names = Names()
    messages: list[MessageRow] = []
    for node, esc in zip(nodes.nodes, escs, strict=True):
        if node.node_id == UNCONFIGURED:
            continue
        prefix = esc_prefix(esc.name) if len(escs) > 1 else ""
        for message in _messages(node):
            messages.append(_with_names(message, prefix, message_names, signal_names))
    head = parse_database((_HEAD % _about(nodes, escs)).encode(), "PDOs")
    return dbc_text(head, messages)


def _with_names(message: MessageRow, prefix: str, messages: Names, signals: Names) -> MessageRow:
    message.name = messages.take(prefix or "Esc", message.name)
    for signal in message.signals:
        end = "Percent" if signal.unit == "%" else ""
        signal.name = signals.take(prefix, signal.name.removesuffix(end), end)
    return message


def waiting_for_lss(nodes: Nodes, escs: Sequence[EscSettings]) -> list[str]:
    """Return the names of the ESCs whose nodes have no node-ID, and therefore no frames."""
    pairs = zip(nodes.nodes, escs, strict=True)
    return [esc.name for node, esc in pairs if node.node_id == UNCONFIGURED]


def _about(nodes: Nodes, escs: Sequence[EscSettings]) -> str:
    """Return the comment of the file."""
    active = []
    for node, esc in zip(nodes.nodes, escs, strict=True):
        if node.node_id != UNCONFIGURED:
            active.append(f"node {node.node_id} ({esc.name})")
    waiting = waiting_for_lss(nodes, escs)
    parts = [f"KONTRONIK ESC telemetry as CANopen PDOs, layout version {_LAYOUT_VERSION}."]
    if active:
        parts.append(f"Active transmit PDOs, heartbeat and emergencies of {', '.join(active)}.")
    if waiting:
        parts.append(f"Waiting for a node-ID by LSS, so without frames: {', '.join(waiting)}.")
    parts.append(
        "PDOs are sent while a node is Operational. "
        "All bits set (signed: only the sign bit set) means NotAvailable. "
        "If a master changes the mapping of PDOs, write this file again."
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
    """Return a message. ``schedule`` is send type, cycle and minimum distance in ms."""
    send_type, cycle_ms, delay_ms = schedule
    attributes: dict[str, object] = {
        "GenMsgCycleTime": cycle_ms,
        "GenMsgSendType": send_type,
        "GenMsgDelayTime": delay_ms,
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
    """Return an unsigned signal. ``high`` and ``start_value`` are raw numbers."""
    attributes = {"GenSigStartValue": start_value}
    row = SignalRow(stem, start, length, comment, receivers=["Logger"], attributes=attributes)
    row.limits = (0, high)
    row.texts = texts or {}
    return row


def _messages(node: Node) -> Iterator[MessageRow]:
    """Yield the messages of a node: PDOs by their number, heartbeat, emergency."""
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
    about = (
        f"NMT state of CANopen node {node.node_id}. "
        "BootUp is sent once, after each start and reset."
    )
    signal = _signal("NodeState", 0, 8, about, NmtState.PRE_OPERATIONAL, states)
    when = "off (1017h is 0), only the boot-up message is sent"
    if period:
        when = f"every {period} ms"
    about = f"Heartbeat of CANopen node {node.node_id}, {when}."
    schedule = ("Cyclic" if period else "Event", period, 0)
    return _message("Heartbeat", HEARTBEAT + node.node_id, 1, about, schedule, [signal])


def _emergency(node: Node) -> MessageRow:
    errors = node.esc.protocol.errors.get("operating_errors", ())
    names = emergency_names(errors)
    bits = {int(bit): pascal_case(bit.name) for bit in errors}
    sources = {bit: bits.get(bit, f"Bit{bit}") for bit in range(32)} | {0xFF: "Gateway"}
    source = "Bit of the error word of the ESC that caused the emergency, or the gateway."
    word = (
        "Error word of the ESC, or the detail of an emergency of the gateway. "
        "TelemetryFault: 1 telemetry lost, 2 CRC errors, "
        "3 port gone, 4 other device than configured. HeartbeatLost: the node-ID."
    )
    signals = [_signal("EmergencyCode", 0, 16, "Emergency code.", high=max(names), texts=names)]
    for register_name, mask in Register.__members__.items():
        name = f"ErrorRegister{register_name.title()}"
        start = 15 + mask.bit_length()
        about = f"Error register 1001h, {register_name.lower()} error."
        signals.append(_signal(name, start, 1, about))
    signals.append(
        _signal("EmergencySource", 24, 8, source, high=0xFF, start_value=0xFF, texts=sources)
    )
    signals.append(_signal("EmergencyWord", 32, 32, word, high=0xFFFFFFFF))
    about = (
        f"Emergencies of CANopen node {node.node_id}, sent when an error comes, "
        "NoError when all are gone."
    )
    schedule = ("Event", 0, node.dictionary.number(0x1015) // 10)
    return _message("Emergency", node.emergencies.cob_id & 0x7FF, 8, about, schedule, signals)


def _tpdo(tpdo: Tpdo, node: Node) -> MessageRow:
    plan = message_plan("", tpdo.cob_id, tpdo.mapped)
    signals: list[SignalRow] = []
    for variable, place in zip(tpdo.mapped, plan.signals, strict=True):
        signals += _object(variable, place, node.esc.protocol)
    number = tpdo.number + 1
    cycle_ms = tpdo.event_ns // MS
    delay_ms = tpdo.inhibit_ns // MS
    comment = f"TPDO {number} of CANopen node {node.node_id}."
    if tpdo.type in EVENT_TYPES:
        send_type = "OnChange" if tpdo.on_change else "Event"
        if cycle_ms:
            send_type = f"CyclicAnd{send_type}"
        schedule = (send_type, cycle_ms, delay_ms)
    else:
        schedule = ("None", 0, 0)
        which = f"every SYNC number {tpdo.type}" if tpdo.type else "a SYNC when there is news"
        comment += f" Sent at {which}."
    return _message(f"Tpdo{number}", tpdo.cob_id, plan.length, comment, schedule, signals)


def _object(variable: Variable, place: SignalPlan, protocol: EscProtocol) -> list[SignalRow]:
    """Return the signals of one mapped object.

    An error word has a signal for each bit, and the link status has three signals.
    """
    item = variable.entry
    bound = variable.bound
    # The name is from any EDS, so characters that a parser may take for syntax are replaced.
    comment = f"Object {item.place}, {item.name.translate(_SYNTAX)}."
    start = place.pieces[0].at
    if bound is not None and not place.signed:
        bits = protocol.errors.get(bound.source.name)
        if bits:
            return _error_bits(bits, start, place.length, comment)
        if bound.source.name == "link_status":
            return _link(start, comment)
    signal = SignalRow(_stem(item), start, place.length, comment, receivers=["Logger"])
    signal.is_signed = place.signed
    signal.is_float = place.is_float
    if bound is None:
        low, high = _range_of(place)
        start_value = 0
        if (item.index, item.sub, place.length, place.signed) == (at.ERROR_CODE, 0, 16, False):
            signal.texts = emergency_names(protocol.errors.get("operating_errors", ()))
    else:
        low, high, start_value = _describe(signal, item, bound, place, protocol)
    if not place.is_float:
        signal.limits = (low * signal.factor, high * signal.factor)
    signal.attributes = {"GenSigStartValue": start_value}
    return [signal]


def _range_of(place: SignalPlan) -> tuple[int, int]:
    """Return the smallest and greatest raw number."""
    low = -(1 << place.length - 1) if place.signed else 0
    return low, low + (1 << place.length) - 1


def _describe(
    signal: SignalRow, item: Entry, bound: Bound, place: SignalPlan, protocol: EscProtocol
) -> tuple[int, int, int]:
    """Set name, unit, factor and texts of a signal that shows a value.

    Returns the limits of its raw number, and its start value.
    """
    source = bound.source
    names, stem = _named(source.name, source.names, protocol)
    signal.unit = _ASCII_UNITS.get(source.unit, source.unit)
    if item.index < _MIRRORS:
        signal.name = stem
    signal.factor = 1 / bound.steps
    signal.comment = (signal.comment or "") + _NOTES.get(source.name, "")
    low, high = _range_of(place)
    start_value = 0
    if not source.rolls:
        if place.signed:
            not_available = low
            low += 1
        else:
            not_available = high
            high -= 1
        names = {raw: text for raw, text in names.items() if low <= raw <= high}
        if place.length <= _MAX_START_VALUE_BITS:
            start_value = not_available
        signal.texts = names | {not_available: "NotAvailable"}
    return low, max(names, default=high), start_value


def _error_bits(bits: Sequence[ErrorBit], start: int, length: int, comment: str) -> list[SignalRow]:
    signals = []
    for bit in bits:
        if bit < length:
            number = int(bit)
            about = f"{comment} Bit {number}, {bit.meaning}."
            signals.append(_signal(pascal_case(bit.name), start + number, 1, about))
    return signals


def _link(start: int, comment: str) -> list[SignalRow]:
    states = {int(state): pascal_case(state.name) for state in LinkState}
    state = f"{comment} State of the telemetry line between ESC and gateway."
    replay = f"{comment} The values come from a recording, not from an ESC."
    info = f"{comment} The information of the ESC (its info frame) is fresh."
    return [
        _signal("LinkState", start, _LINK_BITS, state, high=max(states), texts=states),
        _signal("Replay", start + _REPLAY_BIT, 1, replay),
        _signal("InfoValid", start + _INFO_BIT, 1, info),
    ]


def _named(
    name: str, names: Mapping[int, str], protocol: EscProtocol
) -> tuple[dict[int, str], str]:
    """Return the names of the numbers, and the signal name, of a source.

    In an enumeration every number has a name, because tools drop all names of a signal if a sample
    has a number without a name.
    """
    if name == "operating_state_raw":
        texts = {number: state.text for number, state in protocol.states.items()}
        return _named_numbers(texts, 0xFF, "State"), "OperatingState"
    if name == "device_raw":
        wire = protocol.by_name.get(name)
        last = 0 if wire is None else min(wire.high, 0xFF)
        return _named_numbers(protocol.devices, last, "Device"), "Device"
    return {int(number): pascal_case(text) for number, text in names.items()}, pascal_case(name)


def _named_numbers(texts: Mapping[int, str], last: int, word: str) -> dict[int, str]:
    """Return a name for every number from 0 to ``last``."""
    found = {}
    for number in range(last + 1):
        found[number] = pascal_case(texts.get(number, f"{word}{number}"))
    return found


def _stem(item: Entry) -> str:
    """Return the name of a signal for an object, whose name may have any characters."""
    stem = pascal_case(item.name)
    is_name = re.fullmatch("[A-Z].*[a-z].*", stem)
    return stem if is_name else f"Object{item.index:04X}Sub{item.sub:02X}"
