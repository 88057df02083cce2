"""Writes a database as DBC text that every tool reads, without loss: cantools reads back the same database. Messages are written as sent.

cantools' own writer leaves out attributes that equal their default, rewrites start values as floats, and does not escape the quotes
of database comments and text attributes.
"""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.dbc.copies import Copy

if TYPE_CHECKING:
    from cantools.database.can import Database, Signal

_LONG_NAMES = frozenset(
    {f"System{kind}LongSymbol" for kind in ("Node", "Message", "Signal", "EnvVar")}
)
"""Attributes not written: cantools has already replaced the short names by these long ones."""


def dbc_text(
    database: "Database", copies: Sequence[Copy] | None = None, version: str | None = None
) -> str:
    """The DBC text: sections in the usual order, signals in bit order, one line for each entry, LF line ends.

    ``copies``: its messages as they are sent; None: as they stand.
    """
    dbc: Any = database.dbc
    sent = [Copy(message) for message in database.messages] if copies is None else copies
    signals = [(c.key, s, name) for c in sent for s, name in _sorted(c)]
    definitions = [("", d) for d in dbc.attribute_definitions.values()]
    definitions += [("REL_", d) for d in dbc.relation_attribute_definitions.values()]
    sections = (
        [f'VERSION "{_escaped((version or database.version) or "")}"'],
        ["NS_ :"],
        ["BS_:"],
        [" ".join(["BU_:", *(node.name for node in database.nodes)])],
        [f"VAL_TABLE_ {name} {_texts(table)} ;" for name, table in dbc.value_tables.items()],
        *([_head(c), *(_signal(s, name) for s, name in _sorted(c))] for c in sent),
        [
            f"BO_TX_BU_ {c.key} : {','.join(c.message.senders)};"
            for c in sent
            if len(c.message.senders) > 1
        ],
        [*_environment(dbc.environment_variables.values())],
        [*_comments(database, sent)],
        [f"BA_DEF_{rel} {_definition(d)};" for rel, d in definitions],
        [
            f'BA_DEF_DEF_{rel} "{d.name}" {_default(d)};'
            for rel, d in definitions
            if d.default_value is not None
        ],
        [*_attributes(database, sent), *_relations(dbc.relation_attributes, sent)],
        [f"VAL_ {key} {name} {_texts(s.choices)} ;" for key, s, name in signals if s.choices],
        [
            f"SIG_GROUP_ {c.key} {group.name} {group.repetitions} : "
            f"{' '.join(c.prefix + name for name in group.signal_names)};"
            for c in sent
            for group in c.message.signal_groups or ()
        ],
        [
            f"SIG_VALTYPE_ {key} {name} : {1 if s.length == 32 else 2};"
            for key, s, name in signals
            if s.is_float
        ],
        [line for c in sent for line in _multiplexing(c)],
    )
    return "\n\n".join("\n".join(section) for section in sections if section) + "\n"


def _sorted(sent: Copy) -> list[tuple["Signal", str]]:
    """Signals with their names on the bus."""
    return sorted(sent.signals(), key=lambda pair: pair[0].start)


def _escaped(text: str) -> str:
    return text.replace('"', '\\"')


def _number(value: Any) -> str:
    if isinstance(value, float) and value.is_integer() and abs(value) < 1 << 63:
        value = int(value)
    return str(value)


def _texts(table: Any) -> str:
    return " ".join(f'{number} "{_escaped(str(text))}"' for number, text in sorted(table.items()))


def _head(sent: Copy) -> str:
    senders = sent.message.senders
    return f"BO_ {sent.key} {sent.name}: {sent.message.length} {senders[0] if senders else 'Vector__XXX'}"


def _signal(signal: "Signal", name: str) -> str:
    mux = f" m{signal.multiplexer_ids[0]}" if signal.multiplexer_ids else ""
    if signal.is_multiplexer:
        mux = f"{mux}M" if mux else " M"
    order, sign = int(signal.byte_order == "little_endian"), "-" if signal.is_signed else "+"
    limits = "|".join(_number(end or 0) for end in (signal.minimum, signal.maximum))
    return (
        f" SG_ {name}{mux} : {signal.start}|{signal.length}@{order}{sign} "
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


def _owners(database: "Database", sent: Sequence[Copy]) -> Iterator[tuple[str, Any]]:
    """Owners of comments and attributes, by their names in DBC files."""
    for node in database.nodes:
        yield f"BU_ {node.name} ", node
    for each in sent:
        yield f"BO_ {each.key} ", each.message
        yield from ((f"SG_ {each.key} {name} ", signal) for signal, name in _sorted(each))
    dbc: Any = database.dbc
    for variable in dbc.environment_variables.values():
        yield f"EV_ {variable.name} ", variable


def _comments(database: "Database", sent: Sequence[Copy]) -> Iterator[str]:
    for owner, thing in (*(("", bus) for bus in database.buses), *_owners(database, sent)):
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


def _attributes(database: "Database", sent: Sequence[Copy]) -> Iterator[str]:
    order = {"": 0, "BU_": 1, "BO_": 2, "SG_": 3, "EV_": 4}
    owners = sorted([("", database), *_owners(database, sent)], key=lambda pair: order[pair[0][:3]])
    for owner, thing in owners:
        for attribute in thing.dbc.attributes.values() if thing.dbc else ():
            if attribute.name not in _LONG_NAMES:
                yield f'BA_ "{attribute.name}" {owner}{_value(attribute)};'


def _relations(relations: Any, sent: Sequence[Copy]) -> Iterator[str]:
    if relations is None:
        return
    found: list[tuple[str, Any]] = []
    copies: dict[int, list[Copy]] = {}
    for each in sent:
        copies.setdefault(Copy(each.message).key, []).append(each)
    for number, by_signal in relations.node_signal_relations.items():
        found += [
            (f"BU_SG_REL_ {node} SG_ {each.key} {each.prefix + signal}", attributes)
            for each in copies.get(number, ())
            for signal, by_node in by_signal.items()
            for node, attributes in by_node.items()
        ]
    for number, by_node in relations.node_message_relations.items():
        found += [
            (f"BU_BO_REL_ {node} {each.key}", attributes)
            for each in copies.get(number, ())
            for node, attributes in by_node.items()
        ]
    for owner, attributes in found:
        yield from (f'BA_REL_ "{a.name}" {owner} {_value(a)};' for a in attributes.values())


def _multiplexing(sent: Copy) -> Iterator[str]:
    """SG_MUL_VAL_, only for messages that need it: several multiplexers or several values for a signal."""
    signals = sent.message.signals
    several = sum(signal.is_multiplexer for signal in signals) > 1
    if several or any(len(signal.multiplexer_ids or ()) > 1 for signal in signals):
        for signal, name in _sorted(sent):
            if signal.multiplexer_ids:
                ranges = ", ".join(f"{n}-{n}" for n in signal.multiplexer_ids)
                selector = f"{sent.prefix}{signal.multiplexer_signal}"
                yield f"SG_MUL_VAL_ {sent.key} {name} {selector} {ranges};"
