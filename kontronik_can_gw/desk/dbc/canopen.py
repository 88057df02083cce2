"""The DBC of CANopen nodes: their present TPDOs, heartbeats and emergencies.

A plain logger can read the frames with it. The rules are those of the shipped DBC, except that PDOs
have no Error code: a value that cannot be shown is NotAvailable (all bits set, signed: only the
sign bit set).
"""

from collections.abc import Iterator, Sequence

from kontronik_can_gw.canopen.bound_values import message_plan
from kontronik_can_gw.canopen.cob_ids import HEARTBEAT
from kontronik_can_gw.canopen.emergency_codes import Register
from kontronik_can_gw.canopen.node import Node
from kontronik_can_gw.canopen.nodes import Nodes
from kontronik_can_gw.canopen.pdo import EVENT_TYPES, Tpdo
from kontronik_can_gw.dbc.names import esc_prefix
from kontronik_can_gw.dbc.reader import parse_database
from kontronik_can_gw.desk.dbc.canopen_names import Names, emergency_names, pascal_case
from kontronik_can_gw.desk.dbc.canopen_signals import signals_of, unsigned_signal
from kontronik_can_gw.desk.dbc.writer import MessageRow, SignalRow, dbc_text
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.status import UNCONFIGURED, NmtState
from kontronik_can_gw.times import MS

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
"""The DBC without its messages.

Message 0 only makes this text readable as a DBC. It is not written.
"""


def pdo_text(nodes: Nodes, escs: Sequence[EscSettings]) -> str:
    """Return the DBC of the nodes as they are configured now. ``escs`` are in their order.

    With several ESCs, each name begins with the name of its ESC. Nodes that wait for LSS send no
    frames, and are listed in the comment of the file.
    """
    message_names = Names()
    signal_names = Names()
    messages: list[MessageRow] = []
    for node, esc in zip(nodes.nodes, escs, strict=True):
        if node.node_id == UNCONFIGURED:
            continue
        prefix = esc_prefix(esc.name) if len(escs) > 1 else ""
        for message in _messages(node):
            _make_names_unique(
                message,
                prefix,
                message_names,
                signal_names,
            )
            messages.append(message)
    head_text = _HEAD % _about(nodes, escs)
    head = parse_database(head_text.encode(), "PDOs")
    return dbc_text(head, messages)


def _make_names_unique(
    message: MessageRow,
    prefix: str,
    message_names: Names,
    signal_names: Names,
) -> None:
    """Set names that begin with ``prefix`` and are unique in the file."""
    message.name = message_names.make_unique(prefix or "Esc", message.name)
    for signal in message.signals:
        end = "Percent" if signal.unit == "%" else ""
        stem = signal.name.removesuffix(end)
        signal.name = signal_names.make_unique(prefix, stem, end)


def waiting_for_lss(nodes: Nodes, escs: Sequence[EscSettings]) -> list[str]:
    """Return the names of the ESCs whose nodes have no node-ID, and so send no frames."""
    pairs = zip(nodes.nodes, escs, strict=True)
    return [esc.name for node, esc in pairs if node.node_id == UNCONFIGURED]


def _about(nodes: Nodes, escs: Sequence[EscSettings]) -> str:
    """Return the comment of the file."""
    described = [
        f"node {node.node_id} ({esc.name})"
        for node, esc in zip(nodes.nodes, escs, strict=True)
        if node.node_id != UNCONFIGURED
    ]
    waiting = waiting_for_lss(nodes, escs)
    parts = [f"KONTRONIK ESC telemetry as CANopen PDOs, layout version {_LAYOUT_VERSION}."]
    if described:
        parts.append(f"Active transmit PDOs, heartbeat and emergencies of {', '.join(described)}.")
    if waiting:
        parts.append(f"No frames yet, because LSS must assign a node-ID: {', '.join(waiting)}.")
    parts.append(
        "PDOs are sent while a node is Operational. "
        "All bits set (signed: only the sign bit set) means NotAvailable. "
        "If a master changes the PDO mapping, generate this file again."
    )
    return " ".join(parts)


# --- messages of a node


def _message(
    stem: str,
    cob_id: int,
    length: int,
    comment: str,
    send_type: str,
    signals: Sequence[SignalRow],
    cycle_ms: int = 0,
    delay_ms: int = 0,
) -> MessageRow:
    attributes: dict[str, object] = {
        "GenMsgCycleTime": cycle_ms,
        "GenMsgSendType": send_type,
        "GenMsgDelayTime": delay_ms,
    }
    return MessageRow(
        cob_id,
        stem,
        length,
        ["KontronikGateway"],
        comment,
        attributes,
        signals,
    )


def _messages(node: Node) -> Iterator[MessageRow]:
    """Yield the PDOs in the order of their numbers, the heartbeat and the emergency."""
    for tpdo in node.tpdos:
        if tpdo.is_valid and tpdo.mapped:
            yield _tpdo(tpdo, node)
    yield _heartbeat(node)
    if not node.emergencies.cob_id >> 31:
        yield _emergency(node)


def _heartbeat(node: Node) -> MessageRow:
    period_ms = node.dictionary.number(0x1017)
    states = {int(state): pascal_case(state.name) for state in NmtState}
    states[NmtState.INITIALISING] = "BootUp"
    about_state = (
        f"NMT state of CANopen node {node.node_id}. "
        "BootUp is sent once, after each start and reset."
    )
    state = unsigned_signal(
        "NodeState",
        start=0,
        length=8,
        comment=about_state,
        high=NmtState.PRE_OPERATIONAL,
        texts=states,
    )
    when = "off (1017h is 0), only the boot-up message is sent"
    if period_ms:
        when = f"every {period_ms} ms"
    return _message(
        "Heartbeat",
        cob_id=HEARTBEAT + node.node_id,
        length=1,
        comment=f"Heartbeat of CANopen node {node.node_id}, {when}.",
        send_type="Cyclic" if period_ms else "Event",
        signals=[state],
        cycle_ms=period_ms,
    )


def _emergency(node: Node) -> MessageRow:
    errors = node.esc.protocol.errors.get("operating_errors", ())
    codes = emergency_names(errors)
    bit_names = {int(bit): pascal_case(bit.name) for bit in errors}
    sources = {bit: bit_names.get(bit, f"Bit{bit}") for bit in range(32)}
    sources[0xFF] = "Gateway"
    code = unsigned_signal(
        "EmergencyCode",
        start=0,
        length=16,
        comment="Emergency code.",
        high=max(codes),
        texts=codes,
    )
    source = unsigned_signal(
        "EmergencySource",
        start=24,
        length=8,
        comment="Bit of the error word of the ESC that caused the emergency, or the gateway.",
        high=0xFF,
        start_value=0xFF,
        texts=sources,
    )
    about_word = (
        "Error word of the ESC, or the detail of an emergency of the gateway. "
        "TelemetryFault: 1 telemetry lost, 2 CRC errors, 3 port gone, "
        "4 not the configured device. HeartbeatLost: the node-ID."
    )
    word = unsigned_signal(
        "EmergencyWord",
        start=32,
        length=32,
        comment=about_word,
        high=0xFFFFFFFF,
    )
    register = [
        unsigned_signal(
            f"ErrorRegister{name.title()}",
            start=15 + mask.bit_length(),
            length=1,
            comment=f"Error register 1001h, {name.lower()} error.",
        )
        for name, mask in Register.__members__.items()
    ]
    about = (
        f"Emergencies of CANopen node {node.node_id}, "
        "sent when an error begins. NoError is sent when all errors have ended."
    )
    return _message(
        "Emergency",
        cob_id=node.emergencies.cob_id & 0x7FF,
        length=8,
        comment=about,
        send_type="Event",
        signals=[code, *register, source, word],
        delay_ms=node.dictionary.number(0x1015) // 10,
    )


def _tpdo(tpdo: Tpdo, node: Node) -> MessageRow:
    plan = message_plan("", tpdo.cob_id, tpdo.mapped)
    signals: list[SignalRow] = []
    for variable, place in zip(tpdo.mapped, plan.signals, strict=True):
        signals += signals_of(variable, place, node.esc.protocol)
    number = tpdo.number + 1
    comment = f"TPDO {number} of CANopen node {node.node_id}."
    send_type = "None"
    cycle_ms = 0
    delay_ms = 0
    if tpdo.type in EVENT_TYPES:
        cycle_ms = tpdo.event_ns // MS
        delay_ms = tpdo.inhibit_ns // MS
        send_type = "OnChange" if tpdo.is_sent_on_change else "Event"
        if cycle_ms:
            send_type = f"CyclicAnd{send_type}"
    else:
        which = f"every SYNC number {tpdo.type}" if tpdo.type else "the next SYNC after a change"
        comment += f" Sent at {which}."
    return _message(
        f"Tpdo{number}",
        cob_id=tpdo.cob_id,
        length=plan.length,
        comment=comment,
        send_type=send_type,
        signals=signals,
        cycle_ms=cycle_ms,
        delay_ms=delay_ms,
    )
