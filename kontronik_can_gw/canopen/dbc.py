"""The CANopen side as a DBC: transmit PDOs as they are mapped now, heartbeats and emergencies, so that a plain logger reads them.

Nodes in, cantools database out. Rules of the file: those of the shipped DBC, but PDOs know no Error code: what cannot be shown is
NotAvailable (all bits set, signed: only the sign bit).
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import TYPE_CHECKING

from kontronik_can_gw.canopen import emergency_codes
from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.bound_values import Mapped, message_plan
from kontronik_can_gw.canopen.cob_ids import HEARTBEAT
from kontronik_can_gw.canopen.eds import Entry
from kontronik_can_gw.canopen.emergency_codes import GatewayError, code_of_bit
from kontronik_can_gw.canopen.lss import UNCONFIGURED
from kontronik_can_gw.canopen.nmt import NmtState
from kontronik_can_gw.canopen.node import Node
from kontronik_can_gw.canopen.nodes import Nodes
from kontronik_can_gw.canopen.pdo import Tpdo
from kontronik_can_gw.canopen.pdo_parameters import EVENT_TYPES
from kontronik_can_gw.dbc.expand import esc_prefix
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.kontronik.states import (
    Device,
    ErrorBit,
    OperatingError,
    OperatingState,
    SelfTestError,
)
from kontronik_can_gw.esc.telemetry import MS, EscSettings, LinkState
from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.lean import without_asammdf
from kontronik_can_gw.signals.plan import SignalPlan

if TYPE_CHECKING:
    from cantools.database.can import Database

LAYOUT_VERSION = "1.0.0"
_GATEWAY, _LOGGER = "KontronikGateway", "Logger"
_LONGEST_NAME = 32
_LONGEST_START_VALUE = 32
"""Bits that the range of GenSigStartValue holds."""
_SEND_TYPES = ("Cyclic", "Event", "OnChange", "CyclicAndEvent", "CyclicAndOnChange", "None")
_ASCII_UNITS = {"°C": "degC", "µs": "us"}
_LINK_BITS, _REPLAY_BIT, _INFO_BIT = 6, 6, 7
"""Of the link status 2020h:1."""
_MIRRORS = 0x6000
"""From here on objects show what others show too, under names of CiA 402."""

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
BA_ "LayoutVersion" "{LAYOUT_VERSION}";
BA_ "BusType" "CAN";"""

_NOTES = {
    "battery_current": "Negative while energy is fed back.",
    "peak_current": "A held maximum that does not fall back when the motor stops.",
    "bec_current": "Not supplied by a JIVEPro.",
    "max_bec_current": "Not supplied by a JIVEPro.",
    "throttle": "Zero and below brakes.",
    "operating_state_raw": "A state that has no name in the telemetry sheet is called State with its number.",
    "device_raw": "A device that has no name in the telemetry sheet is called Device with its number.",
    "firmware": "Main version times 256, and the sub version.",
    "data_age": "65534 stands for that or more, NotAvailable: none has come yet.",
    "info_age": "65534 stands for that or more, NotAvailable: none has come yet.",
}
"""What a reader must know of a source beside its name and unit."""


@dataclass(frozen=True)
class _Signal:
    """One SG_ line. ``low``, ``high`` and ``start_value`` are raw."""

    name: str
    start: int
    length: int
    comment: str
    signed: bool = False
    is_float: bool = False
    factor: Fraction = Fraction(1)
    unit: str = ""
    low: int = 0
    high: int = 1
    start_value: int = 0
    names: Mapping[int, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Message:
    """One BO_ line and its attributes; times in ms."""

    cob_id: int
    name: str
    length: int
    comment: str
    send_type: str
    cycle: int
    delay: int
    signals: Sequence[_Signal]


class _Names:
    """Names that are unique over the file, also where case is ignored, and no longer than tools take."""

    def __init__(self) -> None:
        self._taken: set[str] = set()

    def take(self, prefix: str, stem: str, end: str = "") -> str:
        """``prefix`` + ``stem`` + ``end``. The stem is cut to fit, and gets a number where the name is taken."""
        number = 1
        while True:
            tail = f"{number if number > 1 else ''}{end}"
            name = prefix + stem[: _LONGEST_NAME - len(prefix) - len(tail)] + tail
            if name.lower() not in self._taken:
                self._taken.add(name.lower())
                return name
            number += 1


def database(nodes: Nodes, escs: Sequence[EscSettings]) -> "Database":
    """What the nodes send by themselves, as they are configured now; ``escs`` in their order.

    With several ESCs each name begins with that of its ESC. Nodes that wait for LSS have no frames; the database's comment names
    them. UserError for a COB-ID that is used twice.
    """
    with without_asammdf():
        import cantools.database

    message_names, signal_names = _Names(), _Names()
    messages: list[_Message] = []
    for node, esc in zip(nodes.nodes, escs, strict=True):
        if node.node_id == UNCONFIGURED:
            continue
        prefix = esc_prefix(esc.name) if len(escs) > 1 else ""
        messages += _NodeMessages(node, prefix, message_names, signal_names).all()
    _check_ids(messages)
    text = "\n".join(_lines(messages, _about(nodes, escs)))
    found = cantools.database.load_string(text, database_format="dbc", strict=True)
    assert isinstance(found, cantools.database.Database)
    return found


def waiting_for_lss(nodes: Nodes, escs: Sequence[EscSettings]) -> list[str]:
    """Names of the ESCs whose nodes have no node-ID, and so no frames."""
    return [
        esc.name
        for node, esc in zip(nodes.nodes, escs, strict=True)
        if node.node_id == UNCONFIGURED
    ]


def pascal_case(text: str) -> str:
    """A name in any spelling as DBC files have it: ``bec_voltage``, ``BEC voltage`` and ``BecVoltage`` become ``BecVoltage``."""
    words = (
        re.sub("[A-Z]+(?=[A-Z][a-z]|[^a-z]*$)", _capitalized, word)
        for word in re.split("[^A-Za-z0-9]+", text)
    )
    return "".join(word[:1].upper() + word[1:] for word in words)


def emergency_names() -> dict[int, str]:
    """Every emergency code a node can send, with its name; 0 is NoError."""
    named = {int(bit): pascal_case(bit.name) for bit in OperatingError}
    found = {0: "NoError"} | {code_of_bit(bit): named.get(bit, f"Bit{bit}") for bit in range(32)}
    found |= {error.value[0]: pascal_case(error.name) for error in GatewayError}
    found[GatewayError.TELEMETRY_LOST.value[0]] = (
        "TelemetryFault"  # several findings share this code
    )
    return found


class _NodeMessages:
    """The messages of one node."""

    def __init__(
        self, node: Node, prefix: str, message_names: _Names, signal_names: _Names
    ) -> None:
        self._node = node
        self._who = f"CANopen node {node.node_id}"
        self._message_prefix = prefix or "Esc"
        self._prefix = prefix
        self._message_names = message_names
        self._signal_names = signal_names

    def all(self) -> Iterator[_Message]:
        """PDOs by their number, heartbeat, emergency."""
        for tpdo in self._node.tpdos:
            if tpdo.valid and tpdo.mapped:
                yield self._tpdo(tpdo)
        yield self._heartbeat()
        cob_id = self._node.emergencies.cob_id
        if not cob_id >> 31:
            yield self._emergency(cob_id & 0x7FF)

    def _name(self, stem: str, end: str = "") -> str:
        return self._signal_names.take(self._prefix, stem, end)

    # --- heartbeat and emergency

    def _heartbeat(self) -> _Message:
        period = self._node.dictionary.number(0x1017)
        state = _Signal(
            self._name("NodeState"),
            0,
            8,
            f"NMT state of {self._who}. BootUp is sent once, after each start and reset.",
            high=NmtState.PRE_OPERATIONAL,
            names={
                NmtState.INITIALISING: "BootUp",
                NmtState.STOPPED: "Stopped",
                NmtState.OPERATIONAL: "Operational",
                NmtState.PRE_OPERATIONAL: "PreOperational",
            },
        )
        told = (
            f"every {period} ms" if period else "off (1017h is 0), only the boot-up message is sent"
        )
        name = self._message_names.take(self._message_prefix, "Heartbeat")
        cob_id = HEARTBEAT + self._node.node_id
        comment = f"Heartbeat of {self._who}, {told}."
        return _Message(
            cob_id, name, 1, comment, "Cyclic" if period else "Event", period, 0, [state]
        )

    def _emergency(self, cob_id: int) -> _Message:
        bits = {int(bit): pascal_case(bit.name) for bit in OperatingError}
        sources = {bit: bits.get(bit, f"Bit{bit}") for bit in range(32)} | {0xFF: "Gateway"}
        signals = [
            _Signal(
                self._name("EmergencyCode"),
                0,
                16,
                "Emergency code.",
                high=max(emergency_names()),
                names=emergency_names(),
            ),
            *(
                _Signal(
                    self._name("ErrorRegister", what),
                    16 + mask.bit_length() - 1,
                    1,
                    f"Error register 1001h at the time of the emergency, {what.lower()} error.",
                )
                for mask, what in _REGISTER.items()
            ),
            _Signal(
                self._name("EmergencySource"),
                24,
                8,
                "Bit of the error word of the ESC that caused the emergency, or the gateway.",
                high=0xFF,
                start_value=0xFF,
                names=sources,
            ),
            _Signal(
                self._name("EmergencyWord"),
                32,
                32,
                "Error word of the ESC. Of an emergency of the gateway its detail. For TelemetryFault 1 telemetry lost, 2 CRC errors, "
                "3 port gone, 4 other device than configured. For HeartbeatLost the node-ID.",
                high=0xFFFFFFFF,
            ),
        ]
        delay = self._node.dictionary.number(0x1015) // 10
        name = self._message_names.take(self._message_prefix, "Emergency")
        comment = f"Emergencies of {self._who}, sent when an error comes, again after a reset or outage, NoError when all are gone."
        return _Message(cob_id, name, 8, comment, "Event", 0, delay, signals)

    # --- PDOs

    def _tpdo(self, tpdo: Tpdo) -> _Message:
        plan = message_plan("", tpdo.cob_id, tpdo.mapped)
        signals: list[_Signal] = []
        words: list[tuple[Mapped, SignalPlan, type[ErrorBit]]] = []
        state_name = ""
        for entry, place in zip(tpdo.mapped, plan.signals, strict=True):
            if bits := _error_bits(entry, place):
                words.append((entry, place, bits))
                continue
            made = self._object(entry, place)
            if entry.bound is not None and entry.bound.source.name == "operating_state_raw":
                state_name = state_name or made[0].name
            signals += made
        for entry, place, bits in words:
            signals += self._flags(entry, place, bits, state_name)
        name = self._message_names.take(self._message_prefix, f"Tpdo{tpdo.number + 1}")
        comment = f"TPDO {tpdo.number + 1} of {self._who}. {_when(tpdo)}"
        return _Message(tpdo.cob_id, name, plan.length, comment, *_schedule(tpdo), signals)

    def _object(self, entry: Mapped, place: SignalPlan) -> list[_Signal]:
        """The signals of one mapped object that is no error word."""
        item, bound = entry.variable.entry, entry.bound
        where = _where(item)
        own_stem = _stem(item)
        length, signed = place.length, place.signed
        start = place.pieces[0].at
        lowest, highest = (
            (-(1 << length - 1), (1 << length - 1) - 1) if signed else (0, (1 << length) - 1)
        )
        plain = _Signal("", start, length, where, signed, place.is_float, low=lowest, high=highest)
        if bound is None:
            is_code = (item.index, item.sub, length, signed) == (at.ERROR_CODE, 0, 16, False)
            names = emergency_names() if is_code else {}
            return [replace(plain, name=self._name(own_stem), names=names)]
        source = bound.source
        if source.name == "link_status" and not signed:
            return self._link(start, where)
        names, stem = _table(source.name, source.names)
        if item.index >= _MIRRORS:
            stem = own_stem
        unit = _ASCII_UNITS.get(source.unit, source.unit)
        end = "Percent" if unit == "%" else ""
        comment = " ".join(filter(None, (where, _NOTES.get(source.name))))
        scaled = replace(
            plain, name=self._name(stem.removesuffix(end), end), factor=1 / bound.steps, unit=unit
        )
        if source.rolls:
            return [
                replace(
                    scaled,
                    comment=f"{comment} Starts again at 0 after {_number(highest / bound.steps)}.",
                )
            ]
        not_available = lowest if signed else highest
        lowest, highest = (lowest + 1, highest) if signed else (lowest, highest - 1)
        names = {number: text for number, text in names.items() if lowest <= number <= highest}
        return [
            replace(
                scaled,
                comment=comment,
                low=lowest,
                high=max(names) if names else highest,
                start_value=not_available if length <= _LONGEST_START_VALUE else 0,
                names=names | {not_available: "NotAvailable"},
            )
        ]

    def _link(self, start: int, where: str) -> list[_Signal]:
        states = {int(state): pascal_case(state.name) for state in LinkState}
        told = "State of the telemetry line between ESC and gateway."
        replay = "The values come from a recording, not from an ESC."
        info = "The information of the ESC (its info frame) is fresh."
        return [
            _Signal(
                self._name("LinkState"),
                start,
                _LINK_BITS,
                f"{where} {told}",
                high=max(states),
                names=states,
            ),
            _Signal(self._name("Replay"), start + _REPLAY_BIT, 1, f"{where} {replay}"),
            _Signal(self._name("InfoValid"), start + _INFO_BIT, 1, f"{where} {info}"),
        ]

    def _flags(
        self, entry: Mapped, place: SignalPlan, bits: type[ErrorBit], state_name: str
    ) -> list[_Signal]:
        then = f" and {state_name} is NotAvailable" if state_name else ""
        lost = f"While the word is not available all its bits are set{then}."
        where = _where(entry.variable.entry)
        return [
            _Signal(
                self._name(pascal_case(bit.name)),
                place.pieces[0].at + bit,
                1,
                f"{where} Bit {int(bit)}, {bit.meaning}. {lost}",
            )
            for bit in bits
            if bit < place.length
        ]


_REGISTER = {
    emergency_codes.GENERIC: "Generic",
    emergency_codes.CURRENT: "Current",
    emergency_codes.VOLTAGE: "Voltage",
    emergency_codes.TEMPERATURE: "Temperature",
    emergency_codes.COMMUNICATION: "Communication",
    emergency_codes.MANUFACTURER: "Manufacturer",
}


def _capitalized(match: re.Match[str]) -> str:
    return match[0].capitalize()


def _where(item: Entry) -> str:
    return f"Object {item.index:04X}h:{item.sub:02X}, {item.name}."


def _stem(item: Entry) -> str:
    """A signal's name from an object's, which can be of any characters."""
    stem = pascal_case(item.name)
    return (
        stem if re.fullmatch("[A-Z].*[a-z].*", stem) else f"Object{item.index:04X}Sub{item.sub:02X}"
    )


def _error_bits(entry: Mapped, place: SignalPlan) -> type[ErrorBit] | None:
    """The bits of an error word that is shown unsigned; None for every other object."""
    words: dict[str, type[ErrorBit]] = {
        "operating_errors": OperatingError,
        "selftest_errors": SelfTestError,
    }
    return None if entry.bound is None or place.signed else words.get(entry.bound.source.name)


def _table(name: str, names: Mapping[int, str]) -> tuple[dict[int, str], str]:
    """Value names and signal name of a source. An enumeration is closed: a number without a name gets one, because tools lose all
    names by one sample that has none."""
    if name == "operating_state_raw":
        known = {int(state): pascal_case(state.text) for state in OperatingState}
        return {
            number: known.get(number, f"State{number}") for number in range(0x100)
        }, "OperatingState"
    if name == "device_raw":
        known = {int(device): pascal_case(device.text) for device in Device}
        return {number: known.get(number, f"Device{number}") for number in range(0x40)}, "Device"
    return {int(number): pascal_case(text) for number, text in names.items()}, pascal_case(name)


def _schedule(tpdo: Tpdo) -> tuple[str, int, int]:
    """Send type, cycle and least distance in ms."""
    if tpdo.type not in EVENT_TYPES:
        return "None", 0, 0
    delay = tpdo.inhibit_ns // MS
    if tpdo.event_ns:
        return (
            "CyclicAndOnChange" if tpdo.on_change else "CyclicAndEvent",
            tpdo.event_ns // MS,
            delay,
        )
    return "OnChange" if tpdo.on_change else "Event", 0, delay


def _when(tpdo: Tpdo) -> str:
    """When a PDO is sent, in words."""
    if tpdo.type not in EVENT_TYPES:
        text = (
            "Sent at a SYNC when there is news"
            if tpdo.type == 0
            else f"Sent at every SYNC number {tpdo.type}"
        )
    else:
        text = "Sent when its status changes" if tpdo.on_change else "Sent when its values are new"
        if tpdo.inhibit_ns:
            text += f", no closer than {_number(Fraction(tpdo.inhibit_ns, MS))} ms"
        if tpdo.event_ns:
            text += f", at the latest after {tpdo.event_ns // MS} ms"
    live = any(
        entry.bound is not None and entry.bound.source.group is Group.LIVE for entry in tpdo.mapped
    )
    link = any(
        entry.bound is not None and entry.bound.source.name == "link_status"
        for entry in tpdo.mapped
    )
    if live:
        text += (
            ". Goes on while the telemetry is lost"
            if link
            else ". Not sent while the telemetry is lost"
        )
    return f"{text}."


def _check_ids(messages: Sequence[_Message]) -> None:
    seen: dict[int, str] = {}
    for message in messages:
        if message.cob_id in seen:
            raise UserError(
                f"{message.name} and {seen[message.cob_id]} have the same COB-ID {message.cob_id:03X}h. "
                "Give one of them another (180xh:1, 1014h)."
            )
        seen[message.cob_id] = message.name


def _about(nodes: Nodes, escs: Sequence[EscSettings]) -> str:
    """The comment of the database."""
    who = [
        f"node {node.node_id} ({esc.name})"
        for node, esc in zip(nodes.nodes, escs, strict=True)
        if node.node_id != UNCONFIGURED
    ]
    parts = [f"KONTRONIK ESC telemetry as CANopen PDOs, layout version {LAYOUT_VERSION}."]
    if who:
        parts.append(f"Active transmit PDOs, heartbeat and emergencies of {', '.join(who)}.")
    if waiting := waiting_for_lss(nodes, escs):
        parts.append(f"Waiting for a node-ID by LSS, so without frames: {', '.join(waiting)}.")
    parts.append(
        "PDOs are sent while a node is Operational. All bits set (signed: only the sign bit set) means NotAvailable. "
        "A master that maps PDOs in another way makes another file necessary."
    )
    return " ".join(parts)


def _lines(messages: Sequence[_Message], about: str) -> Iterator[str]:
    yield f'VERSION ""\nNS_ :\nBS_:\nBU_: {_GATEWAY} {_LOGGER}'
    for message in messages:
        yield f"BO_ {message.cob_id} {message.name}: {message.length} {_GATEWAY}"
        yield from map(_signal_line, message.signals)
    pairs = [(message, signal) for message in messages for signal in message.signals]
    yield f'CM_ "{_plain(about)}";'
    yield f'CM_ BU_ {_GATEWAY} "Gateway that is a CANopen node for each KONTRONIK ESC. It sends every message of this file.";'
    yield f'CM_ BU_ {_LOGGER} "Any receiver: logger, display or controller.";'
    yield from (f'CM_ BO_ {message.cob_id} "{_plain(message.comment)}";' for message in messages)
    yield from (
        f'CM_ SG_ {message.cob_id} {signal.name} "{_plain(signal.comment)}";'
        for message, signal in pairs
    )
    yield _DEFINITIONS
    attributes: tuple[tuple[str, Callable[[_Message], int]], ...] = (
        ("GenMsgCycleTime", lambda message: message.cycle),
        ("GenMsgSendType", lambda message: _SEND_TYPES.index(message.send_type)),
        ("GenMsgDelayTime", lambda message: message.delay),
    )
    for message in messages:
        yield from (
            f'BA_ "{name}" BO_ {message.cob_id} {value(message)};' for name, value in attributes
        )
    for message, signal in pairs:
        yield f'BA_ "GenSigStartValue" SG_ {message.cob_id} {signal.name} {signal.start_value};'
    for message, signal in pairs:
        if signal.names:
            texts = " ".join(f'{number} "{text}"' for number, text in sorted(signal.names.items()))
            yield f"VAL_ {message.cob_id} {signal.name} {texts} ;"
    for message, signal in pairs:
        if signal.is_float:
            yield f"SIG_VALTYPE_ {message.cob_id} {signal.name} : {1 if signal.length == 32 else 2};"
    yield ""


def _signal_line(signal: _Signal) -> str:
    low, high = (0, 0) if signal.is_float else (signal.low, signal.high)  # [0|0]: no limits
    limits = f"{_number(low * signal.factor)}|{_number(high * signal.factor)}"
    return (
        f" SG_ {signal.name} : {signal.start}|{signal.length}@1{'-' if signal.signed else '+'} "
        f'({_number(signal.factor)},0) [{limits}] "{signal.unit}" {_LOGGER}'
    )


def _number(value: Fraction) -> str:
    return str(value.numerator) if value.denominator == 1 else repr(float(value))


def _plain(text: str) -> str:
    """A comment without what a parser may take for syntax: names of objects come from any EDS."""
    return text.translate(str.maketrans('";\\', "',/"))
