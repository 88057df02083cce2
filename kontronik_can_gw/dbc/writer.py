"""Writes a database as DBC text that every tool reads, without loss: cantools reads back the same database.

cantools' own writer leaves out attributes that equal their default, rewrites start values as floats, and does not escape the quotes
of database comments and text attributes.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cantools.database.can import Database, Message, Signal

_LONG_NAMES = frozenset(
    {f"System{kind}LongSymbol" for kind in ("Node", "Message", "Signal", "EnvVar")}
)
"""Attributes not written: cantools has already replaced the short names by these long ones."""


def dbc_text(database: "Database") -> str:
    """The DBC text: sections in the usual order, signals in bit order, one line for each entry, LF line ends."""
    dbc: Any = database.dbc
    definitions = [("", d) for d in dbc.attribute_definitions.values()]
    definitions += [("REL_", d) for d in dbc.relation_attribute_definitions.values()]
    sections = (
        [f'VERSION "{_escaped(database.version or "")}"'],
        ["NS_ :"],
        ["BS_:"],
        [" ".join(["BU_:", *(node.name for node in database.nodes)])],
        [f"VAL_TABLE_ {name} {_texts(table)} ;" for name, table in dbc.value_tables.items()],
        *([_head(m), *(_signal(s) for s in _sorted(m))] for m in database.messages),
        [
            f"BO_TX_BU_ {frame_id(m)} : {','.join(m.senders)};"
            for m in database.messages
            if len(m.senders) > 1
        ],
        [*_environment(dbc.environment_variables.values())],
        [*_comments(database)],
        [f"BA_DEF_{rel} {_definition(d)};" for rel, d in definitions],
        [
            f'BA_DEF_DEF_{rel} "{d.name}" {_default(d)};'
            for rel, d in definitions
            if d.default_value is not None
        ],
        [*_attributes(database), *_relations(dbc.relation_attributes)],
        [
            f"VAL_ {frame_id(m)} {s.name} {_texts(s.choices)} ;"
            for m, s in _pairs(database)
            if s.choices
        ],
        [
            f"SIG_GROUP_ {frame_id(m)} {group.name} {group.repetitions} : {' '.join(group.signal_names)};"
            for m in database.messages
            for group in m.signal_groups or ()
        ],
        [
            f"SIG_VALTYPE_ {frame_id(m)} {s.name} : {1 if s.length == 32 else 2};"
            for m, s in _pairs(database)
            if s.is_float
        ],
        [*_multiplexing(database)],
    )
    return "\n\n".join("\n".join(section) for section in sections if section) + "\n"


def frame_id(message: "Message") -> int:
    """The id as DBC files write it: bit 31 for 29 bits."""
    return message.frame_id | (0x80000000 if message.is_extended_frame else 0)


def _sorted(message: "Message") -> list["Signal"]:
    return sorted(message.signals, key=lambda signal: signal.start)


def _pairs(database: "Database") -> Iterator[tuple["Message", "Signal"]]:
    return ((message, signal) for message in database.messages for signal in _sorted(message))


def _escaped(text: str) -> str:
    return text.replace('"', '\\"')


def _number(value: Any) -> str:
    if isinstance(value, float) and value.is_integer() and abs(value) < 1 << 63:
        value = int(value)
    return str(value)


def _texts(table: Any) -> str:
    return " ".join(f'{number} "{_escaped(str(text))}"' for number, text in sorted(table.items()))


def _head(message: "Message") -> str:
    sender = message.senders[0] if message.senders else "Vector__XXX"
    return f"BO_ {frame_id(message)} {message.name}: {message.length} {sender}"


def _signal(signal: "Signal") -> str:
    mux = f" m{signal.multiplexer_ids[0]}" if signal.multiplexer_ids else ""
    if signal.is_multiplexer:
        mux = f"{mux}M" if mux else " M"
    order, sign = int(signal.byte_order == "little_endian"), "-" if signal.is_signed else "+"
    limits = "|".join(_number(end or 0) for end in (signal.minimum, signal.maximum))
    return (
        f" SG_ {signal.name}{mux} : {signal.start}|{signal.length}@{order}{sign} "
        f'({_number(signal.scale)},{_number(signal.offset)}) [{limits}] "{_escaped(signal.unit or "")}" '
        f"{','.join(signal.receivers) or 'Vector__XXX'}"
    )


def _environment(variables: Any) -> Iterator[str]:
    for v in variables:
        yield (
            f'EV_ {v.name}: {v.env_type} [{_number(v.minimum)}|{_number(v.maximum)}] "{_escaped(v.unit)}" '
            f"{_number(v.initial_value)} {v.env_id} {v.access_type} {','.join(v.access_nodes)};"
        )
    for v in variables:
        if v.data_size is not None:
            yield f"ENVVAR_DATA_ {v.name}: {v.data_size};"


def _owners(database: "Database") -> Iterator[tuple[str, Any]]:
    """Owners of comments and attributes, by their names in DBC files."""
    for node in database.nodes:
        yield f"BU_ {node.name} ", node
    for message in database.messages:
        yield f"BO_ {frame_id(message)} ", message
        for signal in _sorted(message):
            yield f"SG_ {frame_id(message)} {signal.name} ", signal
    dbc: Any = database.dbc
    for variable in dbc.environment_variables.values():
        yield f"EV_ {variable.name} ", variable


def _comments(database: "Database") -> Iterator[str]:
    for owner, thing in (*(("", bus) for bus in database.buses), *_owners(database)):
        if thing.comment is not None:
            yield f'CM_ {owner}"{_escaped(thing.comment)}";'


def _definition(definition: Any) -> str:
    kind, name = definition.kind or "", definition.type_name
    values, ends = "", (definition.minimum, definition.maximum)
    if name == "ENUM":
        values = ",".join(f'"{_escaped(choice)}"' for choice in definition.choices)
    elif name != "STRING" and None not in ends:
        values = " ".join(map(_number, ends))
    return f'{kind} "{definition.name}" {name} {values}'.lstrip()


def _default(definition: Any) -> str:
    value = definition.default_value
    is_text = definition.type_name in ("STRING", "ENUM")
    return f'"{_escaped(str(value))}"' if is_text else _number(value)


def _value(attribute: Any) -> str:
    value, definition = attribute.value, attribute.definition
    if definition.type_name == "STRING":
        return f'"{_escaped(value)}"'
    if definition.type_name == "ENUM" and value in (definition.choices or ()):
        return str(definition.choices.index(value))
    return _number(value)


def _attributes(database: "Database") -> Iterator[str]:
    order = {"": 0, "BU_": 1, "BO_": 2, "SG_": 3, "EV_": 4}
    owners = sorted([("", database), *_owners(database)], key=lambda pair: order[pair[0][:3]])
    for owner, thing in owners:
        for attribute in thing.dbc.attributes.values() if thing.dbc else ():
            if attribute.name not in _LONG_NAMES:
                yield f'BA_ "{attribute.name}" {owner}{_value(attribute)};'


def _relations(relations: Any) -> Iterator[str]:
    if relations is None:
        return
    owners = [
        (f"BU_SG_REL_ {node} SG_ {number} {signal}", found)
        for number, by_signal in relations.node_signal_relations.items()
        for signal, by_node in by_signal.items()
        for node, found in by_node.items()
    ]
    owners += [
        (f"BU_BO_REL_ {node} {number}", found)
        for number, by_node in relations.node_message_relations.items()
        for node, found in by_node.items()
    ]
    for owner, found in owners:
        yield from (f'BA_REL_ "{a.name}" {owner} {_value(a)};' for a in found.values())


def _multiplexing(database: "Database") -> Iterator[str]:
    """SG_MUL_VAL_, only for messages that need it: several multiplexers or several values for a signal."""
    for message in database.messages:
        several = sum(signal.is_multiplexer for signal in message.signals) > 1
        if several or any(len(signal.multiplexer_ids or ()) > 1 for signal in message.signals):
            for signal in _sorted(message):
                if signal.multiplexer_ids:
                    ranges = ", ".join(f"{n}-{n}" for n in signal.multiplexer_ids)
                    yield f"SG_MUL_VAL_ {frame_id(message)} {signal.name} {signal.multiplexer_signal} {ranges};"
