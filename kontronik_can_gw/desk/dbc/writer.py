"""Writes a DBC without loss, as text that every tool reads. Messages are written as sent.

cantools reads back the same database. Its own writer is not used, because it leaves out attributes
that equal their default, writes start values as floats, and does not escape the quotes in database
comments and text attributes.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.dbc.copies import Copy
from kontronik_can_gw.dbc.e2e_attributes import with_data_ids
from kontronik_can_gw.dbc.reader import NO_NODE

if TYPE_CHECKING:
    from cantools.database.can import Database, Signal

_LONG_NAMES = frozenset(
    {
        "SystemNodeLongSymbol",
        "SystemMessageLongSymbol",
        "SystemSignalLongSymbol",
        "SystemEnvVarLongSymbol",
    }
)
"""Attributes that are not written, because cantools has used them to replace the short names."""


@dataclass
class SignalRow:
    """A signal in the terms of a DBC. Numbers are in the units of the file."""

    name: str
    start: int
    """The start bit as a DBC counts bits."""
    length: int
    comment: str | None = None
    is_little_endian: bool = True
    is_signed: bool = False
    is_float: bool = False
    factor: float | Fraction = 1
    offset: float | Fraction = 0
    limits: tuple[float | Fraction, float | Fraction] = (0, 0)
    unit: str = ""
    receivers: Sequence[str] = ()
    multiplexing: str = ""
    """``M`` for a multiplexer, ``m1`` for a signal of page 1, ``m1M`` for both."""
    pages: str = ""
    """Its line of SG_MUL_VAL_, beginning with the multiplexer's name.

    Empty if ``multiplexing`` is sufficient.
    """
    texts: Mapping[int, object] = field(default_factory=dict)
    attributes: Mapping[str, object] = field(default_factory=dict)


@dataclass
class MessageRow:
    """A message in the terms of a DBC."""

    key: int
    """The id, with EXTENDED for 29 bits."""
    name: str
    length: int
    senders: Sequence[str]
    comment: str | None
    attributes: Mapping[str, object]
    signals: Sequence[SignalRow]
    groups: Sequence[str] = ()
    """Lines of SIG_GROUP_, beginning with the group's name."""


def copies_text(
    database: "Database",
    copies: Sequence[Copy] | None = None,
    version: str | None = None,
    data_ids: Mapping[int, Sequence[int]] = MappingProxyType({}),
) -> str:
    """Return a database as text.

    ``copies``: its messages as they are sent. None: the messages of the database unchanged.
    ``data_ids``: E2E data IDs with which messages are sent, by ``Copy.key``. They replace those of
    the attributes, because the copies of a message for several ESCs have data IDs of their own.
    """
    if copies is None:
        copies = [Copy(message) for message in database.messages]
    relations = [*_relations(database, copies)]
    messages = [_message(copy, data_ids.get(copy.key)) for copy in copies]
    return dbc_text(
        database,
        messages,
        version,
        relations,
    )


def dbc_text(
    database: "Database",
    messages: Sequence[MessageRow],
    version: str | None = None,
    relations: Sequence[str] = (),
) -> str:
    """Return the text of a DBC with ``messages`` and the lines BA_REL_ of ``relations``.

    All other parts are taken from ``database``. Sections have the usual order, signals the order of
    their bits, each entry is a line, and lines end with LF.
    """
    dbc: Any = database.dbc
    nodes = [node.name for node in database.nodes]
    version = (version or database.version) or ""
    sections = [
        [f'VERSION "{_escaped(version)}"'],
        ["NS_ :"],
        ["BS_:"],
        [" ".join(["BU_:", *nodes])],
        [f"VAL_TABLE_ {name} {_texts(table)} ;" for name, table in dbc.value_tables.items()],
    ]
    for message in messages:
        sender = message.senders[0] if message.senders else NO_NODE
        head = f"BO_ {message.key} {message.name}: {message.length} {sender}"
        sections.append([head, *map(_line, _sorted(message))])
    sections += [
        [
            f"BO_TX_BU_ {message.key} : {','.join(message.senders)};"
            for message in messages
            if len(message.senders) > 1
        ],
        list(_environment(dbc.environment_variables.values())),
        list(_comments(database, messages)),
        *_definitions(dbc),
        [*_attributes(database, messages), *relations],
        *_details(messages),
    ]
    texts = ["\n".join(section) for section in sections if section]
    return "\n\n".join(texts) + "\n"


def _definitions(dbc: Any) -> tuple[list[str], list[str]]:
    """Return the sections with the definitions and the defaults of attributes."""
    definitions: list[str] = []
    defaults: list[str] = []
    kinds = (("", dbc.attribute_definitions), ("REL_", dbc.relation_attribute_definitions))
    for suffix, table in kinds:
        for definition in table.values():
            definitions.append(f"BA_DEF_{suffix} {_definition(definition)};")
            default = definition.default_value
            if default is not None:
                is_text = definition.type_name in ("STRING", "ENUM")
                shown = f'"{_escaped(str(default))}"' if is_text else _number(default)
                defaults.append(f'BA_DEF_DEF_{suffix} "{definition.name}" {shown};')
    return definitions, defaults


def _details(messages: Sequence[MessageRow]) -> tuple[list[str], ...]:
    """Return the sections with value tables, signal groups, float types and multiplexing."""
    tables: list[str] = []
    groups: list[str] = []
    types: list[str] = []
    pages: list[str] = []
    for message in messages:
        groups += [f"SIG_GROUP_ {message.key} {group};" for group in message.groups]
        for signal in _sorted(message):
            place = f"{message.key} {signal.name}"
            if signal.texts:
                tables.append(f"VAL_ {place} {_texts(signal.texts)} ;")
            if signal.is_float:
                number = 1 if signal.length == 32 else 2
                types.append(f"SIG_VALTYPE_ {place} : {number};")
            if signal.pages:
                pages.append(f"SG_MUL_VAL_ {place} {signal.pages};")
    return tables, groups, types, pages


# --- rows of a database


def _message(sent: Copy, data_ids: Sequence[int] | None = None) -> MessageRow:
    message = sent.message
    multiplexers = sum(signal.is_multiplexer for signal in message.signals)
    pages = [len(signal.multiplexer_ids or ()) for signal in message.signals]
    in_pages = max([multiplexers, *pages]) > 1
    signals = [_signal(signal, name, sent.prefix, in_pages) for signal, name in sent.signals()]
    groups = []
    for group in message.signal_groups or ():
        names = " ".join(sent.prefix + name for name in group.signal_names)
        groups.append(f"{group.name} {group.repetitions} : {names}")
    attributes = _own_attributes(message)
    if data_ids is not None:
        attributes = with_data_ids(attributes, data_ids)
        for row in signals:
            row.attributes = with_data_ids(row.attributes, data_ids)
    return MessageRow(
        key=sent.key,
        name=sent.name,
        length=message.length,
        senders=message.senders,
        comment=message.comment,
        attributes=attributes,
        signals=signals,
        groups=groups,
    )


def _signal(
    signal: "Signal",
    name: str,
    prefix: str,
    in_pages: bool,
) -> SignalRow:
    """Return the row of a signal.

    ``in_pages``: its message has several multiplexers, or several pages for a signal, and therefore
    needs SG_MUL_VAL_.
    """
    pages = signal.multiplexer_ids or ()
    multiplexing = f"m{pages[0]}" if pages else ""
    multiplexing += "M" * signal.is_multiplexer
    page_ranges = ""
    if in_pages and pages:
        ranges = ", ".join(f"{page}-{page}" for page in pages)
        page_ranges = f"{prefix}{signal.multiplexer_signal} {ranges}"
    return SignalRow(
        name=name,
        start=signal.start,
        length=signal.length,
        comment=signal.comment,
        is_little_endian=signal.byte_order == "little_endian",
        is_signed=signal.is_signed,
        is_float=signal.is_float,
        factor=signal.scale,
        offset=signal.offset,
        limits=(signal.minimum or 0, signal.maximum or 0),
        unit=signal.unit or "",
        receivers=signal.receivers,
        multiplexing=multiplexing,
        pages=page_ranges,
        texts=signal.choices or {},
        attributes=_own_attributes(signal),
    )


def _own_attributes(thing: Any) -> Mapping[str, object]:
    attributes = thing.dbc.attributes.values() if thing.dbc else ()
    return {a.name: a.value for a in attributes if a.name not in _LONG_NAMES}


# --- lines


def _sorted(message: MessageRow) -> list[SignalRow]:
    return sorted(message.signals, key=lambda signal: signal.start)


def _escaped(text: str) -> str:
    return text.replace('"', '\\"')


def _number(value: Any) -> str:
    """Return a number as text. A fraction that is not whole becomes the nearest float."""
    if isinstance(value, Fraction):
        value = value.numerator if value.denominator == 1 else float(value)
    if isinstance(value, float) and value.is_integer() and abs(value) < 1 << 63:
        value = int(value)
    return str(value)


def _texts(table: Any) -> str:
    return " ".join(f'{number} "{_escaped(str(text))}"' for number, text in sorted(table.items()))


def _line(signal: SignalRow) -> str:
    name = signal.name
    if signal.multiplexing:
        name += f" {signal.multiplexing}"
    byte_order = "1" if signal.is_little_endian else "0"
    sign = "-" if signal.is_signed else "+"
    place = f"{signal.start}|{signal.length}@{byte_order}{sign}"
    scale = f"({_number(signal.factor)},{_number(signal.offset)})"
    limits = "|".join(map(_number, signal.limits))
    receivers = ",".join(signal.receivers) or NO_NODE
    unit = _escaped(signal.unit)
    return f' SG_ {name} : {place} {scale} [{limits}] "{unit}" {receivers}'


def _environment(variables: Any) -> Iterator[str]:
    for variable in variables:
        limits = f"[{_number(variable.minimum)}|{_number(variable.maximum)}]"
        unit = _escaped(variable.unit)
        initial = _number(variable.initial_value)
        nodes = ",".join(variable.access_nodes)
        yield (
            f'EV_ {variable.name}: {variable.env_type} {limits} "{unit}" '
            f"{initial} {variable.env_id} {variable.access_type} {nodes};"
        )
    for variable in variables:
        if variable.data_size is not None:
            yield f"ENVVAR_DATA_ {variable.name}: {variable.data_size};"


def _comments(database: "Database", messages: Sequence[MessageRow]) -> Iterator[str]:
    dbc: Any = database.dbc
    found = [("", bus.comment) for bus in database.buses]
    found += [(f"BU_ {node.name} ", node.comment) for node in database.nodes]
    for message in messages:
        found.append((f"BO_ {message.key} ", message.comment))
        for signal in _sorted(message):
            found.append((f"SG_ {message.key} {signal.name} ", signal.comment))
    for variable in dbc.environment_variables.values():
        found.append((f"EV_ {variable.name} ", variable.comment))
    for owner, text in found:
        if text is not None:
            yield f'CM_ {owner}"{_escaped(text)}";'


def _definition(definition: Any) -> str:
    kind = definition.kind or ""
    name = definition.type_name
    limits = (definition.minimum, definition.maximum)
    values = ""
    if name == "ENUM":
        values = ",".join(f'"{_escaped(choice)}"' for choice in definition.choices)
    elif name != "STRING" and None not in limits:
        values = " ".join(map(_number, limits))
    return f'{kind} "{definition.name}" {name} {values}'.lstrip()


def _value(value: Any, definition: Any) -> str:
    if definition.type_name == "STRING":
        return f'"{_escaped(value)}"'
    if definition.type_name == "ENUM" and value in (definition.choices or ()):
        return str(definition.choices.index(value))
    return _number(value)


def _attributes(database: "Database", messages: Sequence[MessageRow]) -> Iterator[str]:
    dbc: Any = database.dbc
    owners = [("", _own_attributes(database))]
    owners += [(f"BU_ {node.name} ", _own_attributes(node)) for node in database.nodes]
    owners += [(f"BO_ {message.key} ", message.attributes) for message in messages]
    for message in messages:
        for signal in _sorted(message):
            owners.append((f"SG_ {message.key} {signal.name} ", signal.attributes))
    for variable in dbc.environment_variables.values():
        owners.append((f"EV_ {variable.name} ", _own_attributes(variable)))
    for owner, attributes in owners:
        for name, value in attributes.items():
            text = _value(value, dbc.attribute_definitions[name])
            yield f'BA_ "{name}" {owner}{text};'


def _relations(database: "Database", sent: Sequence[Copy]) -> Iterator[str]:
    dbc: Any = database.dbc
    relations = dbc.relation_attributes
    if relations is None:
        return
    copies: dict[int, list[Copy]] = {}
    for each in sent:
        copies.setdefault(Copy(each.message).key, []).append(each)
    for number, by_signal in relations.node_signal_relations.items():
        for each in copies.get(number, ()):
            for signal, by_node in by_signal.items():
                target = f"SG_ {each.key} {each.prefix + signal}"
                for node, attributes in by_node.items():
                    yield from _relation(f"BU_SG_REL_ {node} {target}", attributes)
    for number, by_node in relations.node_message_relations.items():
        for each in copies.get(number, ()):
            for node, attributes in by_node.items():
                yield from _relation(f"BU_BO_REL_ {node} {each.key}", attributes)


def _relation(owner: str, attributes: Mapping[str, Any]) -> Iterator[str]:
    for attribute in attributes.values():
        value = _value(attribute.value, attribute.definition)
        yield f'BA_REL_ "{attribute.name}" {owner} {value};'
