"""A database that is made, not read from a file: its rows have the names of cantools' objects, as far as ``writer.py`` reads them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, NamedTuple

_SEND_TYPES = ("Cyclic", "Event", "OnChange", "CyclicAndEvent", "CyclicAndOnChange", "None")
_MAX_MS = 65535


class Definition(NamedTuple):
    """An attribute: its BA_DEF_ and BA_DEF_DEF_ lines. ``kind``: ``BO_``, ``SG_``, empty for the database."""

    name: str
    kind: str
    type_name: str
    default_value: str | int
    minimum: int | None = None
    maximum: int | None = None
    choices: Sequence[str] = ()


_DEFINITIONS = {
    definition.name: definition
    for definition in (
        Definition("LayoutVersion", "", "STRING", ""),
        Definition("BusType", "", "STRING", "CAN"),
        Definition("GenMsgCycleTime", "BO_", "INT", 0, 0, _MAX_MS),
        Definition("GenMsgSendType", "BO_", "ENUM", "None", choices=_SEND_TYPES),
        Definition("GenMsgDelayTime", "BO_", "INT", 0, 0, _MAX_MS),
        Definition("GenSigStartValue", "SG_", "FLOAT", 0, -(1 << 31), (1 << 32) - 1),
    )
}


class Attribute(NamedTuple):
    """A BA_ line."""

    name: str
    value: str | int
    definition: Definition


@dataclass(frozen=True)
class Specifics:
    """The attributes of a row; definitions of the database."""

    attributes: Mapping[str, Attribute] = field(default_factory=dict)
    attribute_definitions: Mapping[str, Definition] = field(default_factory=dict)
    relation_attribute_definitions: Mapping[str, Definition] = field(default_factory=dict)
    environment_variables: Mapping[str, Any] = field(default_factory=dict)
    value_tables: Mapping[str, Mapping[int, str]] = field(default_factory=dict)
    relation_attributes: None = None


def _attributes(**values: str | int) -> dict[str, Attribute]:
    return {name: Attribute(name, value, _DEFINITIONS[name]) for name, value in values.items()}


class Node(NamedTuple):
    """A name of the BU_ line. Without a name: the bus, whose comment is that of the file."""

    name: str
    comment: str
    dbc: Specifics = Specifics()


@dataclass(frozen=True)
class Signal:
    """A little-endian signal that is in every frame. ``low``, ``high`` and ``start_value`` are raw; a float has no limits."""

    name: str
    start: int
    length: int
    comment: str
    is_signed: bool = False
    is_float: bool = False
    factor: Fraction = Fraction(1)
    unit: str = ""
    low: int = 0
    high: int = 1
    start_value: int = 0
    choices: Mapping[int, str] = field(default_factory=dict)
    receivers: Sequence[str] = ()
    byte_order: str = "little_endian"
    offset: int = 0
    is_multiplexer: bool = False
    multiplexer_ids: Sequence[int] = ()
    multiplexer_signal: str | None = None

    @property
    def scale(self) -> float:
        return number(self.factor)

    @property
    def minimum(self) -> float | None:
        return None if self.is_float else number(self.low * self.factor)

    @property
    def maximum(self) -> float | None:
        return None if self.is_float else number(self.high * self.factor)

    @property
    def dbc(self) -> Specifics:
        return Specifics(_attributes(GenSigStartValue=self.start_value))


class Message(NamedTuple):
    """A message with an id of 11 bits; times in ms."""

    frame_id: int
    name: str
    length: int
    comment: str
    senders: Sequence[str]
    send_type: str
    cycle: int
    delay: int
    signals: Sequence[Signal]
    is_extended_frame: bool = False
    signal_groups: Sequence[Any] = ()

    @property
    def dbc(self) -> Specifics:
        return Specifics(
            _attributes(
                GenMsgCycleTime=self.cycle,
                GenMsgSendType=self.send_type,
                GenMsgDelayTime=self.delay,
            )
        )


class Rows(NamedTuple):
    """A whole database."""

    nodes: Sequence[Node]
    comment: str
    layout_version: str
    messages: Sequence[Message]
    version: str = ""

    @property
    def buses(self) -> Sequence[Node]:
        return [Node("", self.comment)]

    @property
    def dbc(self) -> Specifics:
        own = _attributes(LayoutVersion=self.layout_version, BusType="CAN")
        return Specifics(own, _DEFINITIONS)


def number(value: Fraction) -> int | float:
    """A number as DBC files have it: the nearest float where it is not whole."""
    return value.numerator if value.denominator == 1 else float(value)
