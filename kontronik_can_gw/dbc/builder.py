"""Makes messages and databases that come from no file, as cantools has them."""

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

from kontronik_can_gw.lean import without_asammdf

with without_asammdf():
    from cantools.database.can import Bus, Node
    from cantools.database.can import Database as Database
    from cantools.database.can import Message as Message
    from cantools.database.can import Signal as Signal
    from cantools.database.can.formats.dbc import (
        DbcAttribute,
        DbcAttributeDefinition,
        DbcSpecifics,
    )
    from cantools.database.conversion import BaseConversion

_SEND_TYPES = ["Cyclic", "Event", "OnChange", "CyclicAndEvent", "CyclicAndOnChange", "None"]
_MAX_MS = 65535
_ROWS: tuple[tuple[Any, ...], ...] = (
    ("LayoutVersion", "", "", "STRING"),
    ("BusType", "CAN", "", "STRING"),
    ("GenMsgCycleTime", 0, "BO_", "INT", 0, _MAX_MS),
    ("GenMsgSendType", "None", "BO_", "ENUM", None, None, _SEND_TYPES),
    ("GenMsgDelayTime", 0, "BO_", "INT", 0, _MAX_MS),
    ("GenSigStartValue", 0, "SG_", "FLOAT", -(1 << 31), (1 << 32) - 1),
)
_DEFINITIONS: OrderedDict[str, DbcAttributeDefinition[Any]] = OrderedDict(
    (str(row[0]), DbcAttributeDefinition(*row))  # name, default, kind, type, range, choices
    for row in _ROWS
)


def _specifics(**values: Any) -> DbcSpecifics:
    rows = ((name, DbcAttribute(value, _DEFINITIONS[name])) for name, value in values.items())
    return DbcSpecifics(attributes=OrderedDict(rows))


def signal(
    name: str,
    start: int,
    length: int,
    comment: str,
    *,
    is_signed: bool = False,
    is_float: bool = False,
    factor: Fraction = Fraction(1),
    unit: str = "",
    low: int = 0,
    high: int = 1,
    start_value: int = 0,
    choices: Mapping[int, str] | None = None,
    receivers: Sequence[str] = (),
) -> Signal:
    """A little-endian signal that is in every frame. ``low``, ``high`` and ``start_value`` are raw; a float has no limits."""
    table: Any = OrderedDict(choices) if choices else None
    return Signal(
        *(name, start, length, "little_endian", is_signed),
        conversion=BaseConversion.factory(number(factor), 0, table, is_float),
        minimum=None if is_float else number(low * factor),
        maximum=None if is_float else number(high * factor),
        unit=unit,
        dbc_specifics=_specifics(GenSigStartValue=start_value),
        comment=comment,
        receivers=list(receivers),
    )


def message(
    can_id: int,
    name: str,
    length: int,
    comment: str,
    sender: str,
    schedule: tuple[str, int, int],
    signals: Sequence[Signal],
) -> Message:
    """A message with an id of 11 bits. ``schedule``: send type, cycle and least distance in ms."""
    send_type, cycle, delay = schedule
    times = {"GenMsgCycleTime": cycle, "GenMsgSendType": send_type, "GenMsgDelayTime": delay}
    return Message(
        *(can_id, name, length, list(signals)),
        comment=comment,
        senders=[sender],
        dbc_specifics=_specifics(**times),
        strict=False,
        sort_signals=None,
    )


def database(
    nodes: Mapping[str, str], comment: str, layout_version: str, messages: Sequence[Message]
) -> Database:
    """A database of nodes by their names with comments."""
    specifics = _specifics(LayoutVersion=layout_version, BusType="CAN")
    specifics.attribute_definitions.update(_DEFINITIONS)
    return Database(
        list(messages),
        [Node(name, about) for name, about in nodes.items()],
        [Bus("", comment)],
        dbc_specifics=specifics,
        strict=False,
        sort_signals=None,
    )


def number(value: Fraction) -> int | float:
    """A number as DBC files have it: the nearest float where it is not whole."""
    return value.numerator if value.denominator == 1 else float(value)
