"""What a table has: its fields beside the time, those that are wanted, and what is known of where it came from."""

import fnmatch
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from enum import Enum
from typing import Any

from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.values import VALUES, Divisor, Group, physical, steps, values_of_esc
from kontronik_can_gw.esc.values import Value as EscValue
from kontronik_can_gw.signals.unpacker import Value
from kontronik_can_gw.status import GatewayStatus

TIME = "Time"
UTC = "Utc"
_OWN = (TIME, UTC)
Read = Callable[[Any, GatewayStatus, int], Value]
"""Gives a value of an EscTelemetry (None for one of the gateway), or of the GatewayStatus, at a time; None where it is not fresh."""
LEFT_OUT = frozenset({"sent_frames"})
"""Only the frames themselves show it: they are not made for a table."""
_ORDER = (Group.LIVE, Group.LINK, Group.INFO, Group.GATEWAY)


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
    value: EscValue | None = None
    """As its ESC supplies it, of a value that came of its bytes."""
    period_ns: int | None = None
    """Of a value that came in a CAN frame: the longest time between two of them, 0 for one with each telemetry frame."""

    @property
    def header(self) -> str:
        """Name with unit: ``battery_voltage [V]``."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    @property
    def reader(self) -> Read:
        """Gives the value, or its text."""
        value = self.value
        assert value is not None
        names, is_whole = value.names, self.kind in (Kind.FLAG, Kind.WHOLE)

        def read(esc: Any, status: GatewayStatus, now: int) -> Value:
            found = steps(value, esc, status, now)
            if found is None:
                return None
            if names:
                return names.get(found)
            return int(found) if is_whole else physical(value, esc, found)

        return read


@dataclass(frozen=True)
class Table:
    """The frame of a table. ``has_utc``: its rows have Unix times. ``origin_ns``: the recording's time at the table's time 0."""

    fields: Sequence[Field]
    has_utc: bool
    origin_ns: int = 0
    provenance: Mapping[str, str] = field(default_factory=dict)


def fields_of_values(escs: Sequence[EscSettings]) -> list[Field]:
    """A field for each value, of all ESCs and then of the gateway; with several ESCs named ``esc1.battery_voltage``."""
    found = []
    for index, esc in [*enumerate(escs), (None, None)]:
        prefix = f"{esc.name}." if esc is not None and len(escs) > 1 else ""
        every = (VALUES if esc is None else values_of_esc(esc)).values()
        for group in _ORDER:
            found += [
                _field(value, prefix, index)
                for value in every
                if value.group is group
                and (group is Group.GATEWAY) is (esc is None)
                and value.supplied
                and value.name not in LEFT_OUT
            ]
    return found


def _field(value: EscValue, prefix: str, esc: int | None) -> Field:
    texts = tuple(sorted(value.names.items()))
    high = math.inf if value.high is None else value.high / value.per_unit
    kind = Kind.FLOAT
    if value.names:
        kind = Kind.TEXT
    elif value.bit is not None:
        kind = Kind.FLAG
    elif value.per_unit == 1 and value.divisor is Divisor.ONE:
        kind = Kind.WHOLE
    name = prefix + value.name
    return Field(name, value.unit, kind, "", texts, value.name, esc, high=high, value=value)


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
class Choice:
    """What of a recording is wanted. Times in ns since its start, ``end_ns`` included."""

    columns: Sequence[int]
    start_ns: int | None = None
    end_ns: int | None = None

    @classmethod
    def of(cls, fields: Sequence[Field], names: Sequence[str] = (), **times: Any) -> "Choice":
        """The fields with one of these names (with * and ?). UserError for a name that fits none.

        Case, underscores and dots do not matter, nor ``Percent`` at the end. With several ESCs a name may be that of a value alone; of
        a CAN log it may be the signal's.
        """
        chosen: dict[int, None] = {} if names else dict.fromkeys(range(len(fields)))
        problems = []
        known = [
            {_plain(one.name), _plain(one.name.rpartition(".")[2]), _plain(one.signal)} - {""}
            for one in fields
        ]
        for name in names:
            wanted = _plain(name)
            forms = {wanted, wanted.removesuffix("percent")} - {""}
            found = [
                index
                for index, called in enumerate(known)
                if any(fnmatch.filter(called, form) for form in forms)
            ]
            if not found:
                shown = {_plain(one.name): one.name for one in reversed(fields)}
                close = get_close_matches(wanted, shown, 1, 0.5)
                more = f" Did you mean {shown[close[0]]}?" if close else ""
                problems.append(f"--signals {name}: no such signal.{more}")
            chosen |= dict.fromkeys(found)
        if problems:
            raise UserError(*problems)
        return cls([*chosen], **times)


def _plain(name: str) -> str:
    return name.lower().replace("_", "").replace(".", "")
