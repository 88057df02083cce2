"""A database that is made, not read from a file: rows with the names of cantools' objects, as far as ``writer.py`` reads them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Definition:
    """A BA_DEF_ line and its BA_DEF_DEF_ line."""

    name: str
    kind: str
    """``BO_``, ``SG_``, ``BU_``; empty for the database."""
    type_name: str
    default_value: str | int
    minimum: int | None = None
    maximum: int | None = None
    choices: Sequence[str] = ()


@dataclass(frozen=True)
class Attribute:
    """A BA_ line."""

    definition: Definition
    value: str | int

    @property
    def name(self) -> str:
        return self.definition.name


@dataclass(frozen=True)
class Specifics:
    """Attributes of a row; definitions of the database."""

    attributes: Mapping[str, Attribute] = field(default_factory=dict)
    attribute_definitions: Mapping[str, Definition] = field(default_factory=dict)
    relation_attribute_definitions: Mapping[str, Definition] = field(default_factory=dict)
    environment_variables: Mapping[str, Any] = field(default_factory=dict)
    value_tables: Mapping[str, Mapping[int, str]] = field(default_factory=dict)
    relation_attributes: None = None


@dataclass(frozen=True)
class Node:
    """A name of the BU_ line; also the bus, whose comment is that of the file."""

    name: str
    comment: str
    dbc: Specifics = Specifics()


@dataclass(frozen=True)
class Signal:
    """A SG_ line and what belongs to it. Limits are physical values; None: no limit."""

    name: str
    start: int
    length: int
    comment: str
    receivers: Sequence[str]
    is_signed: bool = False
    is_float: bool = False
    scale: float = 1
    offset: float = 0
    minimum: float | None = None
    maximum: float | None = None
    unit: str = ""
    choices: Mapping[int, str] = field(default_factory=dict)
    dbc: Specifics = Specifics()
    byte_order: str = "little_endian"
    is_multiplexer: bool = False
    multiplexer_ids: Sequence[int] | None = None
    multiplexer_signal: str | None = None


@dataclass(frozen=True)
class Message:
    """A BO_ line and what belongs to it."""

    frame_id: int
    name: str
    length: int
    comment: str
    senders: Sequence[str]
    signals: Sequence[Signal]
    dbc: Specifics = Specifics()
    is_extended_frame: bool = False
    signal_groups: Sequence[Any] | None = None


@dataclass(frozen=True)
class Rows:
    """A whole database."""

    nodes: Sequence[Node]
    buses: Sequence[Node]
    messages: Sequence[Message]
    dbc: Specifics
    version: str = ""


def specifics(definitions: Mapping[str, Definition], values: Mapping[str, str | int]) -> Specifics:
    """The attributes of a row, by their names."""
    return Specifics({name: Attribute(definitions[name], value) for name, value in values.items()})
