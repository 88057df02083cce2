"""The CANopen side as a DBC: transmit PDOs as they are mapped now, heartbeats and emergencies, so that a plain logger reads them.

Nodes in, a database for ``dbc/writer.py`` out. Rules: those of the shipped DBC, but PDOs know no Error code: what cannot be shown is
NotAvailable (all bits set, signed: only the sign bit).
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from typing import Any

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
from kontronik_can_gw.dbc import builder
from kontronik_can_gw.dbc.builder import Database, Message, Signal, number
from kontronik_can_gw.dbc.names import esc_prefix
from kontronik_can_gw.esc.decoder import ErrorBit
from kontronik_can_gw.esc.telemetry import MS, EscSettings, LinkState
from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.node_state import UNCONFIGURED, NmtState
from kontronik_can_gw.signals.plan import SignalPlan

GATEWAY, LOGGER = "KontronikGateway", "Logger"
_MAX_START_VALUE_BITS = 32
"""That the range of GenSigStartValue holds."""
_ASCII_UNITS = {"°C": "degC", "µs": "us"}
_LINK_BITS, _REPLAY_BIT, _INFO_BIT = 6, 6, 7
"""Of the link status 2020h:1."""
_MIRRORS = 0x6000
"""From here on objects show what others show too, under names of CiA 402."""

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

LAYOUT_VERSION = "1.0.0"
_NODES = {
    GATEWAY: "Gateway that is a CANopen node for each KONTRONIK ESC. It sends every message of this file.",
    LOGGER: "Any receiver: logger, display or controller.",
}


def database(nodes: Nodes, escs: Sequence[EscSettings]) -> Database:
    """What the nodes send by themselves, as they are configured now; ``escs`` in their order.

    With several ESCs each name begins with that of its ESC. Nodes that wait for LSS have no frames; the database's comment names
    them.
    """
    message_names, signal_names = Names(), Names()
    messages: list[Message] = []
    for node, esc in zip(nodes.nodes, escs, strict=True):
        if node.node_id == UNCONFIGURED:
            continue
        prefix = esc_prefix(esc.name) if len(escs) > 1 else ""
        messages += _NodeMessages(node, prefix, message_names, signal_names).all()
    return builder.database(_NODES, _about(nodes, escs), LAYOUT_VERSION, messages)


def waiting_for_lss(nodes: Nodes, escs: Sequence[EscSettings]) -> list[str]:
    """Names of the ESCs whose nodes have no node-ID, and so no frames."""
    pairs = zip(nodes.nodes, escs, strict=True)
    return [esc.name for node, esc in pairs if node.node_id == UNCONFIGURED]


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


class _NodeMessages:
    """The messages of one node."""

    def __init__(self, node: Node, prefix: str, message_names: Names, signal_names: Names) -> None:
        self._node = node
        self._protocol = node.esc.protocol
        self._errors = self._protocol.errors.get("operating_errors", ())
        self._title = f"CANopen node {node.node_id}"
        self._prefix = prefix
        self._message_names = message_names
        self._signal_names = signal_names

    def all(self) -> Iterator[Message]:
        """PDOs by their number, heartbeat, emergency."""
        for tpdo in self._node.tpdos:
            if tpdo.valid and tpdo.mapped:
                yield self._tpdo(tpdo)
        yield self._heartbeat()
        cob_id = self._node.emergencies.cob_id
        if not cob_id >> 31:
            yield self._emergency(cob_id & 0x7FF)

    def _signal(
        self, stem: str, start: int, length: int, comment: str, end: str = "", **more: Any
    ) -> Signal:
        """``stem`` and ``end``: the name, see ``Names``; ``more``: as for ``builder.signal``."""
        name = self._signal_names.take(self._prefix, stem, end)
        return builder.signal(name, start, length, comment, receivers=(LOGGER,), **more)

    def _message(
        self,
        stem: str,
        cob_id: int,
        length: int,
        comment: str,
        schedule: tuple[str, int, int],
        signals: Sequence[Signal],
    ) -> Message:
        name = self._message_names.take(self._prefix or "Esc", stem)
        return builder.message(cob_id, name, length, comment, GATEWAY, schedule, signals)

    # --- heartbeat and emergency

    def _heartbeat(self) -> Message:
        period = self._node.dictionary.number(0x1017)
        about = f"NMT state of {self._title}. BootUp is sent once, after each start and reset."
        states = {state: pascal_case(state.name) for state in NmtState}
        states[NmtState.INITIALISING] = "BootUp"
        high = NmtState.PRE_OPERATIONAL
        signals = [self._signal("NodeState", 0, 8, about, high=high, choices=states)]
        off = "off (1017h is 0), only the boot-up message is sent"
        comment = f"Heartbeat of {self._title}, {f'every {period} ms' if period else off}."
        schedule = "Cyclic" if period else "Event", period, 0
        cob_id = HEARTBEAT + self._node.node_id
        return self._message("Heartbeat", cob_id, 1, comment, schedule, signals)

    def _emergency(self, cob_id: int) -> Message:
        names = emergency_names(self._errors)
        bits = {int(bit): pascal_case(bit.name) for bit in self._errors}
        sources = {bit: bits.get(bit, f"Bit{bit}") for bit in range(32)} | {0xFF: "Gateway"}
        register = "Error register 1001h at the time of the emergency"
        source = "Bit of the error word of the ESC that caused the emergency, or the gateway."
        word = (
            "Error word of the ESC. Of an emergency of the gateway its detail. For TelemetryFault 1 telemetry lost, 2 CRC errors, "
            "3 port gone, 4 other device than configured. For HeartbeatLost the node-ID."
        )
        signal = self._signal
        signals = [
            signal("EmergencyCode", 0, 16, "Emergency code.", high=max(names), choices=names)
        ]
        for what, mask in Register.__members__.items():
            name, bit = f"ErrorRegister{what.title()}", mask.bit_length() - 1
            signals.append(signal(name, 16 + bit, 1, f"{register}, {what.lower()} error."))
        signals += [
            signal("EmergencySource", 24, 8, source, high=0xFF, start_value=0xFF, choices=sources),
            signal("EmergencyWord", 32, 32, word, high=0xFFFFFFFF),
        ]
        delay = self._node.dictionary.number(0x1015) // 10
        comment = f"Emergencies of {self._title}, sent when an error comes, again after a reset or outage, NoError when all are gone."
        return self._message("Emergency", cob_id, 8, comment, ("Event", 0, delay), signals)

    # --- PDOs

    def _tpdo(self, tpdo: Tpdo) -> Message:
        plan = message_plan("", tpdo.cob_id, tpdo.mapped)
        signals: list[Signal] = []
        words: list[tuple[Variable, SignalPlan, Sequence[ErrorBit]]] = []
        state_name = ""
        for variable, place in zip(tpdo.mapped, plan.signals, strict=True):
            if bits := self._error_bits(variable, place):
                words.append((variable, place, bits))
                continue
            made = self._object(variable, place)
            if variable.bound is not None and variable.bound.source.name == "operating_state_raw":
                state_name = state_name or made[0].name
            signals += made
        for variable, place, bits in words:
            signals += self._flags(variable, place, bits, state_name)
        comment = f"TPDO {tpdo.number + 1} of {self._title}. {_when(tpdo)}"
        about = tpdo.cob_id, plan.length, comment, _schedule(tpdo)
        return self._message(f"Tpdo{tpdo.number + 1}", *about, signals)

    def _object(self, variable: Variable, place: SignalPlan) -> list[Signal]:
        """The signals of one mapped object that is no error word."""
        item, bound = variable.entry, variable.bound
        where = _where(item)
        length, signed, start = place.length, place.signed, place.pieces[0].at
        lowest = -(1 << length - 1) if signed else 0
        highest = lowest + (1 << length) - 1
        form: dict[str, Any] = {"is_signed": signed, "is_float": place.is_float}
        if bound is None:
            is_code = (item.index, item.sub, length, signed) == (at.ERROR_CODE, 0, 16, False)
            form |= {"choices": emergency_names(self._errors)} if is_code else {}
            return [
                self._signal(_stem(item), start, length, where, low=lowest, high=highest, **form)
            ]
        source = bound.source
        if source.name == "link_status" and not signed:
            return self._link(start, where)
        names, stem = self._table(source.name, source.names)
        if item.index >= _MIRRORS:
            stem = _stem(item)
        unit = _ASCII_UNITS.get(source.unit, source.unit)
        end = "Percent" if unit == "%" else ""
        comment = " ".join(filter(None, (where, _NOTES.get(source.name))))
        if source.rolls:
            comment += f" Starts again at 0 after {number(highest / bound.steps)}."
        else:
            not_available = lowest if signed else highest
            lowest, highest = (lowest + 1, highest) if signed else (lowest, highest - 1)
            names = {number: text for number, text in names.items() if lowest <= number <= highest}
            form["start_value"] = not_available if length <= _MAX_START_VALUE_BITS else 0
            form["choices"] = names | {not_available: "NotAvailable"}
        form |= {"low": lowest, "high": max(names, default=highest), "unit": unit}
        stem = stem.removesuffix(end)
        factor = 1 / bound.steps
        return [self._signal(stem, start, length, comment, end, factor=factor, **form)]

    def _link(self, start: int, where: str) -> list[Signal]:
        states = {int(state): pascal_case(state.name) for state in LinkState}
        state = f"{where} State of the telemetry line between ESC and gateway."
        replay = f"{where} The values come from a recording, not from an ESC."
        info = f"{where} The information of the ESC (its info frame) is fresh."
        signal = self._signal
        return [
            signal("LinkState", start, _LINK_BITS, state, high=max(states), choices=states),
            signal("Replay", start + _REPLAY_BIT, 1, replay),
            signal("InfoValid", start + _INFO_BIT, 1, info),
        ]

    def _flags(
        self, variable: Variable, place: SignalPlan, bits: Sequence[ErrorBit], state_name: str
    ) -> list[Signal]:
        then = f" and {state_name} is NotAvailable" if state_name else ""
        lost = f"While the word is not available all its bits are set{then}."
        where, start = _where(variable.entry), place.pieces[0].at
        return [
            self._signal(name, start + bit, 1, f"{where} Bit {int(bit)}, {bit.meaning}. {lost}")
            for bit, name in ((bit, pascal_case(bit.name)) for bit in bits)
            if bit < place.length
        ]

    def _error_bits(self, variable: Variable, place: SignalPlan) -> Sequence[ErrorBit]:
        """The bits of an error word that is shown unsigned; empty for every other object."""
        if variable.bound is None or place.signed:
            return ()
        return self._protocol.errors.get(variable.bound.source.name, ())

    def _table(self, name: str, names: Mapping[int, str]) -> tuple[dict[int, str], str]:
        """Value names and signal name of a source. An enumeration is closed: a number without a name gets one, because tools lose
        all names by one sample that has none."""
        if name == "operating_state_raw":
            texts = {number: state.text for number, state in self._protocol.states.items()}
            return _closed(texts, 0xFF, "State"), "OperatingState"
        if name == "device_raw":
            field = self._protocol.by_name.get(name)
            last = 0 if field is None else min(field.high, 0xFF)
            return _closed(self._protocol.devices, last, "Device"), "Device"
        return {int(number): pascal_case(text) for number, text in names.items()}, pascal_case(name)


def _closed(texts: Mapping[int, str], last: int, word: str) -> dict[int, str]:
    return {n: pascal_case(texts.get(n, f"{word}{n}")) for n in range(last + 1)}


def _where(item: Entry) -> str:
    """An object for a comment, without what a parser may take for syntax: its name comes from any EDS."""
    name = item.name.translate(str.maketrans('";\\', "',/"))
    return f"Object {item.place}, {name}."


def _stem(item: Entry) -> str:
    """A signal's name from an object's, which can be of any characters."""
    stem = pascal_case(item.name)
    return (
        stem if re.fullmatch("[A-Z].*[a-z].*", stem) else f"Object{item.index:04X}Sub{item.sub:02X}"
    )


def _schedule(tpdo: Tpdo) -> tuple[str, int, int]:
    """Send type, cycle and least distance in ms."""
    if tpdo.type not in EVENT_TYPES:
        return "None", 0, 0
    cause, cycle = "OnChange" if tpdo.on_change else "Event", tpdo.event_ns // MS
    return f"CyclicAnd{cause}" if cycle else cause, cycle, tpdo.inhibit_ns // MS


def _when(tpdo: Tpdo) -> str:
    """When a PDO is sent, in words."""
    if tpdo.type == 0:
        text = "Sent at a SYNC when there is news"
    elif tpdo.type not in EVENT_TYPES:
        text = f"Sent at every SYNC number {tpdo.type}"
    else:
        text = "Sent when its status changes" if tpdo.on_change else "Sent when its values are new"
        if tpdo.inhibit_ns:
            text += f", no closer than {number(Fraction(tpdo.inhibit_ns, MS))} ms"
        if tpdo.event_ns:
            text += f", at the latest after {tpdo.event_ns // MS} ms"
    sources = [variable.bound.source for variable in tpdo.mapped if variable.bound is not None]
    if any(source.group is Group.LIVE for source in sources):
        link = any(source.name == "link_status" for source in sources)
        text += f". {'Goes on' if link else 'Not sent'} while the telemetry is lost"
    return f"{text}."
