"""What a table has: its fields beside the time, and what is told of where it came from."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

from kontronik_can_gw.signals.unpacker import Column

TIME = "Time"
UTC = "Utc"
ID, MESSAGE = "Id", "Message"
_OWN = (TIME, UTC, ID, MESSAGE)


class Kind(Enum):
    """What a field's values are. All may be missing."""

    FLAG = "flag"
    WHOLE = "whole"
    FLOAT = "float"
    TEXT = "text"


@dataclass(frozen=True)
class Field:
    """A column of a table. ``texts``: raw number and text of each value that a text can have."""

    name: str
    unit: str
    kind: Kind
    message: str
    texts: tuple[tuple[int, str], ...] = ()

    @property
    def header(self) -> str:
        """Name with unit: ``BatteryVoltage [V]``."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def fields_of(columns: Sequence[Column]) -> list[Field]:
    """The fields of signals. A name that several of them have, or that a table itself uses, gets its message in front: ``Message.Name``."""
    counts = Counter(column.name for column in columns)
    fields = []
    for one in columns:
        kind = (
            Kind.TEXT
            if one.texts
            else Kind.FLAG
            if one.is_flag
            else Kind.WHOLE
            if one.is_whole
            else Kind.FLOAT
        )
        name = (
            one.name
            if counts[one.name] == 1 and one.name not in _OWN
            else f"{one.message}.{one.name}"
        )
        fields.append(Field(name, one.unit, kind, one.message, one.texts))
    return fields


def frame_fields(names: Collection[tuple[str, str]]) -> tuple[Field, Field]:
    """``Id`` and ``Message`` of a table of CAN frames. ``names``: each id and its message."""
    ids = tuple(enumerate(dict.fromkeys(name for name, _ in names)))
    messages = tuple(enumerate(dict.fromkeys(message for _, message in names)))
    return Field(ID, "", Kind.TEXT, "", ids), Field(MESSAGE, "", Kind.TEXT, "", messages)


@dataclass(frozen=True)
class Table:
    """The frame of a table. ``has_utc``: its rows have Unix times. ``by_frame``: its first fields are Id and Message."""

    fields: Sequence[Field]
    has_utc: bool
    by_frame: bool = False
    start_wall_ns: int | None = None
    """Unix time in ns of time 0."""
    provenance: Mapping[str, str] = field(default_factory=dict)

    def indices(self, message: str) -> list[int]:
        """The fields of one message."""
        return [index for index, one in enumerate(self.fields) if one.message == message]
