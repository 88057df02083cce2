"""Turns a description into a document of titles, lines and tables, which ``markdown`` renders. Pure."""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from kontronik_can_gw.desk.describe.facts import (
    BY_GATEWAY,
    CanopenFacts,
    DbcFacts,
    Description,
    EmergencyFacts,
    EntryFacts,
    ErrorFacts,
    MessageFacts,
    NodeFacts,
    ObjectFacts,
    SignalFacts,
    SourceFacts,
    StateFacts,
    ValueFacts,
)


class Code(str):
    """A text that is a name in a program or a file."""

    __slots__ = ()


@dataclass(frozen=True)
class Table:
    """Cells are plain text or Code; every row is as long as ``head``."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Section:
    """``level`` 2 or 3; ``anchor`` is unique in the document."""

    title: str
    level: int
    anchor: str
    blocks: tuple[str | Table, ...]


@dataclass(frozen=True)
class Document:
    """``lead``: lines before the first section."""

    title: str
    lead: tuple[str, ...]
    sections: tuple[Section, ...]


def document(facts: Description) -> Document:
    """The description as a document."""
    titled: list[tuple[str, int, list[str | Table]]] = []
    if facts.dbc is not None:
        titled += _messages(facts.dbc, several=len(facts.escs) > 1)
    titled += _faults(facts)
    if facts.canopen is not None:
        titled += _canopen(facts.canopen)
    titled.append(("Sources", 2, [_SOURCES, _sources(facts.sources)]))
    sections: list[Section] = []
    anchors: set[str] = set()
    for title, level, blocks in titled:
        sections.append(
            Section(
                title, level, _anchor(title, anchors), tuple(block for block in blocks if block)
            )
        )
    return Document(
        "What the gateway sends and what it means", tuple(_lead(facts)), tuple(sections)
    )


_SOURCES = (
    "What a signal of a DBC of your own can be bound to, by its name or under [dbc.bind]. Those without a signal name in this table are "
    "not sent by the DBC in use."
)


def _lead(facts: Description) -> Iterator[str]:
    yield f"Made by {facts.program} from the files in use, by: kontronik-can-gw describe."
    yield f"ESCs: {', '.join(facts.escs)}."
    yield (
        f"DBC: {facts.dbc.file}, messages of {facts.dbc.node}."
        if facts.dbc
        else "DBC: none, dbc.enabled is false."
    )
    yield (
        f"EDS: {facts.canopen.file}."
        if facts.canopen
        else "CANopen: none, canopen.enabled is false."
    )


def _anchor(title: str, taken: set[str]) -> str:
    """The anchor that GitHub makes from a heading."""
    plain = re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") or "section"
    anchor, number = plain, 0
    while anchor in taken:
        number += 1
        anchor = f"{plain}-{number}"
    taken.add(anchor)
    return anchor


# --- messages


def _messages(dbc: DbcFacts, several: bool) -> Iterator[tuple[str, int, list[str | Table]]]:
    rows = []
    for message in dbc.messages:
        rows.append(
            (
                Code(message.name),
                _id(message),
                str(message.length),
                _timing(message),
                message.comment,
            )
        )
    yield (
        "Messages",
        2,
        [dbc.comment, Table(("message", "id", "bytes", "sent", "meaning"), tuple(rows))],
    )
    for message in dbc.messages:
        text = f"{_id(message)}, {message.length} bytes{', CAN FD' if message.fd else ''}. Sent {_timing(message)}."
        yield (
            f"{message.name} {_id(message)}",
            3,
            [text, message.comment, _signals(message, several)],
        )


def _id(message: MessageFacts) -> str:
    return f"{message.id:08X}h" if message.extended else f"{message.id:03X}h"


def _timing(message: MessageFacts) -> str:
    words = {
        "event": "with each new value",
        "on change": "on change",
        "cyclic": f"every {_number(message.cycle_ms)} ms",
    }
    text = " and ".join(words[kind] for kind in message.send_type) or "never"
    return f"{text}, at least {_number(message.delay_ms)} ms apart" if message.delay_ms else text


def _signals(message: MessageFacts, several: bool) -> Table:
    head = (
        "signal",
        "bits",
        "unit",
        "resolution",
        "range",
        "not available, error",
        "shows",
        "meaning",
    )
    return Table(head, tuple(_signal(signal, several) for signal in message.signals))


def _signal(signal: SignalFacts, several: bool) -> tuple[str, ...]:
    kind = "float" if signal.is_float else "signed" if signal.signed else "unsigned"
    order = "" if signal.byte_order == "little_endian" else ", big-endian"
    bits = f"{signal.start_bit}+{signal.length} {kind}{order}"
    is_flag = signal.length == 1 and not signal.signed
    if is_flag:
        bits = str(signal.start_bit)
    if signal.page is not None:
        bits += f", page {signal.page}"
    steps = f"{_number(signal.factor)}" + (
        f", offset {_number(signal.offset)}" if signal.offset else ""
    )
    span = f"{_number(signal.minimum)} … {_number(signal.maximum)}"
    if is_flag and (signal.factor, signal.minimum, signal.maximum) == (1, 0, 1):
        steps, span = "", "0, 1"
    codes = ", ".join(
        f"{raw} ({raw & (1 << signal.length) - 1:X}h)"
        for raw in (signal.not_available, signal.error)
        if raw is not None
    )
    shows = signal.role if signal.source is None else signal.source
    if signal.source is not None and signal.esc is not None and several:
        shows = f"{signal.esc}.{signal.source}"
    named = [
        value for value in signal.values if value.value not in (signal.not_available, signal.error)
    ]
    meaning = " ".join(
        filter(None, (signal.comment, _named(named), *(f"{note}." for note in signal.notes)))
    )
    shown = shows if signal.source is None else Code(shows)
    return Code(signal.name), bits, signal.unit, steps, span, codes, shown, meaning


def _named(values: Sequence[ValueFacts]) -> str:
    text = ", ".join(f"{value.value} {value.name}" for value in values)
    return f"Values: {text}." if text else ""


# --- errors and states


def _faults(facts: Description) -> Iterator[tuple[str, int, list[str | Table]]]:
    live = "Bits of the error word that the ESC sends with each live frame."
    test = "Bits that the ESC sends about once a second, in its info frame. All of them mean that the self-test failed."
    yield "Operating errors", 2, [live, _errors(facts.operating_errors)]
    yield "Self-test errors", 2, [test, _errors(facts.selftest_errors)]
    sheet = "What the ESC is doing. Other numbers have no name; newer firmware may send them."
    yield "Operating states", 2, [sheet, _states(facts.operating_states)]
    rows = []
    for device in facts.devices:
        whose = "unknown" if device.peak_current is None else f"of the {device.peak_current}"
        missing = ", ".join(device.not_supplied) or "nothing"
        rows.append((str(device.value), Code(device.name), whose, missing))
    yield (
        "Devices",
        2,
        [Table(("number", "device", "peak current", "does not supply"), tuple(rows))],
    )
    yield (
        "Link states",
        2,
        ["The telemetry line between an ESC and the gateway.", _states(facts.link_states)],
    )
    yield "CAN states", 2, ["The gateway's CAN controller.", _states(facts.can_states)]
    yield "Gateway states", 2, [_states(facts.gateway_states)]
    found = tuple((Code(f.name), f.meaning, f.remedy) for f in facts.gateway_faults)
    where = "Reported as emergencies on CANopen nodes, in the log and by kontronik-can-gw status."
    yield (
        "Faults that the gateway finds",
        2,
        [where, Table(("fault", "meaning", "what to do"), found)],
    )


def _errors(errors: Iterable[ErrorFacts]) -> Table:
    rows = tuple((str(e.bit), Code(e.name), e.severity, e.meaning, e.remedy) for e in errors)
    return Table(("bit", "name", "class", "meaning", "what to do"), rows)


def _states(states: Iterable[StateFacts]) -> Table:
    rows = tuple((str(s.value), Code(s.name), s.meaning, s.remedy) for s in states)
    return Table(("number", "state", "meaning", "what to do"), rows)


# --- CANopen


def _canopen(facts: CanopenFacts) -> Iterator[tuple[str, int, list[str | Table]]]:
    yield "CANopen nodes", 2, ["One node for each ESC, all with the objects below."]
    for node in facts.nodes:
        title = (
            f"Node {node.node_id} ({node.esc})"
            if node.node_id is not None
            else f"Node of {node.esc}"
        )
        yield title, 3, list(_node(node))
    head = ("code", "byte 3", "byte 4", "name", "class", "meaning", "what to do")
    text = "Emergency messages: bytes 0 and 1 are the code, byte 2 is 1001h, byte 3 the bit of the ESC's error word, or FFh."
    yield "Emergencies", 2, [text, Table(head, tuple(map(_emergency, facts.emergencies)))]
    writes = (
        "Nothing can be written over the bus: canopen.read_only is true." if facts.read_only else ""
    )
    yield "CANopen objects", 2, [*facts.notes, writes]
    for item in facts.objects:
        yield f"{item.index:04X}h {item.name}", 3, [*item.notes, _object(item)]


def _node(node: NodeFacts) -> Iterator[str | Table]:
    if node.node_id is None:
        yield "It waits for a node-ID by LSS, so it has no COB-IDs yet."
    yield Table(("COB-ID", "used for"), tuple((f"{cob.id:03X}h", cob.use) for cob in node.cob_ids))
    pdos = tuple(
        (
            str(pdo.number),
            f"{pdo.cob_id:03X}h",
            str(pdo.transmission_type),
            _number(pdo.inhibit_ms),
            _number(pdo.event_ms),
            ", ".join(pdo.mapped),
        )
        for pdo in node.pdos
    )
    if pdos:
        yield Table(("TPDO", "COB-ID", "type", "inhibit time ms", "event timer ms", "mapped"), pdos)


def _emergency(e: EmergencyFacts) -> tuple[str, ...]:
    byte3 = "FFh" if e.byte3 == BY_GATEWAY else str(e.byte3)
    byte4 = "" if not e.byte4 else str(e.byte4)
    return f"{e.code:04X}h", byte3, byte4, Code(e.name), e.severity, e.meaning, e.remedy


def _object(item: ObjectFacts) -> Table:
    head = ("sub", "name", "type", "access", "PDO", "default", "limits", "unit", "shows", "meaning")
    return Table(head, tuple(_entry(entry) for entry in item.entries))


def _entry(e: EntryFacts) -> tuple[str, ...]:
    # a live value has no default of its own
    default = "" if e.default is None or e.source is not None else _hex(e.default)
    if e.plus_node_id:
        default = f"$NODEID + {default}"
    limits = "" if e.low is e.high is None else f"{_number(e.low)} … {_number(e.high)}"
    unit = e.unit
    if e.resolution not in (None, 1):
        unit = f"{_number(e.resolution)} {e.unit}".strip()
    shows = "" if e.source is None else Code(e.source)
    return (
        f"{e.sub:02X}",
        e.name,
        e.type,
        e.access,
        "yes" if e.mappable else "",
        default,
        limits,
        unit,
        shows,
        e.meaning,
    )


def _hex(value: float | str) -> str:
    return f"{value:X}h" if isinstance(value, int) and value > 0xFFFF else str(value)


# --- sources


def _sources(found: Iterable[SourceFacts]) -> Table:
    rows = []
    for source in found:
        if source.bindable:
            meaning = f"{source.meaning} Counter." if source.counter else source.meaning
            cells = (Code(source.name), source.unit, source.available, meaning)
            rows.append((*cells, ", ".join(source.signals), ", ".join(source.objects)))
    return Table(("source", "unit", "available", "meaning", "signals", "objects"), tuple(rows))


def _number(value: float | None) -> str:
    """A number in the usual notation; empty for None."""
    if value is None:
        return ""
    return str(value) if isinstance(value, int) else f"{value:.10g}"
