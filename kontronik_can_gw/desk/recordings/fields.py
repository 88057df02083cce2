"""What a table has: its fields beside the time, and what is known of where it came from."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

TIME = "Time"
UTC = "Utc"
_OWN = (TIME, UTC)


class Kind(Enum):
    """What a field's values are. All may be missing."""

    FLAG = "flag"
    WHOLE = "whole"
    FLOAT = "float"
    TEXT = "text"


@dataclass(frozen=True)
class Field:
    """A column of a table. ``texts``: number and text of each value that a text can have."""

    name: str
    unit: str
    kind: Kind
    message: str = ""
    """Of a value that came in a CAN frame."""
    texts: tuple[tuple[int, str], ...] = ()
    source: str = ""
    """A name of values.py."""
    esc: int | None = None
    """Index of the ESC; None for the gateway's own."""
    signal: str = ""
    """Name of the signal in the DBC, of a value that came in a CAN frame."""
    high: float = math.inf
    """The greatest value, at which a counter begins again."""

    @property
    def header(self) -> str:
        """Name with unit: ``battery_voltage [V]``."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def distinct(fields: Sequence[Field]) -> list[Field]:
    """The fields; names that several have, or that a table itself uses, with the message in front: ``Message.Name``.

    Where a message has a value twice, the names of its signals.
    """
    counts = Counter(one.name for one in fields)
    within = Counter((one.message, one.name) for one in fields)

    def name_of(one: Field) -> str:
        if within[one.message, one.name] > 1:
            return f"{one.message}.{one.signal or one.name}"
        return f"{one.message}.{one.name}" if counts[one.name] > 1 or one.name in _OWN else one.name

    return [replace(one, name=name_of(one)) for one in fields]


def column_of(fields: Sequence[Field], source: str, esc: int | None) -> int | None:
    """Index of the first field with a value of values.py; None where there is none."""
    places = (i for i, one in enumerate(fields) if (one.source, one.esc) == (source, esc))
    return next(places, None)


@dataclass(frozen=True)
class Table:
    """The frame of a table. ``has_utc``: its rows have Unix times. ``origin_ns``: the recording's time at the table's time 0."""

    fields: Sequence[Field]
    has_utc: bool
    origin_ns: int = 0
    provenance: Mapping[str, str] = field(default_factory=dict)
