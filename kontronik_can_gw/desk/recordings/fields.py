"""The columns of a table, the choice among them, and the table's metadata."""

import fnmatch
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

from kontronik_can_gw.desk.receiver.unpacker import Value
from kontronik_can_gw.errors import UserError, did_you_mean
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.values import VALUES, Divisor, Group, physical, steps, values_of_esc
from kontronik_can_gw.esc.values import Value as EscValue
from kontronik_can_gw.status import GatewayStatus

TIME = "Time"
UTC = "Utc"
TRUSTED = "UtcTrusted"
"""1 while the wall clock was synchronised, else 0. Missing if the recording has no state of it."""
_OWN = (TIME, UTC, TRUSTED)
Read = Callable[[Any, GatewayStatus, int], Value]
"""A function that returns a value at a time, or None if the value is not fresh.

Its arguments are the EscTelemetry (None for the gateway's own values), the GatewayStatus and the
time.
"""
LEFT_OUT = frozenset({"sent_frames"})
"""Values that need the CAN frames, which are not made for a table."""
_ESC_GROUPS = (Group.LIVE, Group.LINK, Group.INFO)
_GATEWAY_GROUPS = (Group.GATEWAY,)


class ColumnType(Enum):
    """The type of a field's values. Any value may be missing."""

    FLAG = "flag"
    WHOLE = "whole"
    FLOAT = "float"
    TEXT = "text"


@dataclass(frozen=True)
class TableColumn:
    """A column of a table. Its values are read from CAN frames or from the bytes of an ESC."""

    name: str
    unit: str
    kind: ColumnType
    message: str = ""
    """Name of the CAN message. Empty for values from bytes."""
    texts: tuple[tuple[int, str], ...] = ()
    """Number and text of each possible value of kind TEXT."""
    source: str = ""
    """The value's name in values.py."""
    esc: int | None = None
    """Index of the ESC. None for the gateway's own values."""
    signal: str = ""
    """Name of the signal in the DBC. Empty for values from bytes."""
    high: float = math.inf
    """The greatest value. A counter begins again after it."""
    value: EscValue | None = None
    """The definition of the value as its ESC supplies it. None for values from CAN frames."""
    period_ns: int | None = None
    """The longest time between two values in CAN frames. 0: one with each telemetry frame.

    None if unknown, and for values from bytes.
    """

    @property
    def header(self) -> str:
        """Name with unit: ``battery_voltage [V]``."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    @property
    def reader(self) -> Read:
        """The function that reads the value, or its text, from the state of an ESC."""
        value = self.value
        assert value is not None
        names = value.names
        is_whole = self.kind in (ColumnType.FLAG, ColumnType.WHOLE)

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
    """The description of a table."""

    fields: Sequence[TableColumn]
    has_utc: bool
    """True if the rows have Unix times."""
    has_trust: bool = False
    """True if the rows have the column TRUSTED."""
    origin_ns: int = 0
    """The recording's time at the table's time 0."""
    provenance: Mapping[str, str] = field(default_factory=dict)


def fields_of_values(escs: Sequence[EscSettings]) -> list[TableColumn]:
    """Return a field for each value of all ESCs, followed by those of the gateway.

    If there are several ESCs, their names precede the values' names: ``esc1.battery_voltage``.
    """
    found = []
    owners: list[tuple[int | None, str]] = [
        (index, f"{esc.name}." if len(escs) > 1 else "") for index, esc in enumerate(escs)
    ]
    for esc, prefix in (*owners, (None, "")):
        values = VALUES if esc is None else values_of_esc(escs[esc])
        for group in _GATEWAY_GROUPS if esc is None else _ESC_GROUPS:
            found += [
                _field(value, prefix, esc)
                for value in values.values()
                if value.group is group and value.supplied and value.name not in LEFT_OUT
            ]
    return found


def _field(value: EscValue, prefix: str, esc: int | None) -> TableColumn:
    high = math.inf if value.high is None else value.high / value.per_unit
    kind = ColumnType.FLOAT
    if value.names:
        kind = ColumnType.TEXT
    elif value.bit is not None:
        kind = ColumnType.FLAG
    elif value.per_unit == 1 and value.divisor is Divisor.ONE:
        kind = ColumnType.WHOLE
    return TableColumn(
        name=prefix + value.name,
        unit=value.unit,
        kind=kind,
        texts=tuple(sorted(value.names.items())),
        source=value.name,
        esc=esc,
        high=high,
        value=value,
    )


def distinct(fields: Sequence[TableColumn]) -> list[TableColumn]:
    """Return the fields with distinct names.

    If several fields have a name, or the table itself uses it, the message precedes it:
    ``Message.Name``. If a message has a value twice, the names of its signals are used.
    """
    counts = Counter(one.name for one in fields)
    within = Counter((one.message, one.name) for one in fields)

    def name_of(one: TableColumn) -> str:
        if within[one.message, one.name] > 1:
            return f"{one.message}.{one.signal or one.name}"
        if counts[one.name] > 1 or one.name in _OWN:
            return f"{one.message}.{one.name}"
        return one.name

    return [replace(one, name=name_of(one)) for one in fields]


def column_of(fields: Sequence[TableColumn], source: str, esc: int | None) -> int | None:
    """Return the index of the first field with a value of values.py. None if there is none."""
    for index, one in enumerate(fields):
        if one.source == source and one.esc == esc:
            return index
    return None


@dataclass(frozen=True)
class Choice:
    """The part of a recording that is wanted. Times are in ns since its start, both included."""

    columns: Sequence[int]
    start_ns: int | None = None
    end_ns: int | None = None

    @classmethod
    def of(cls, fields: Sequence[TableColumn], names: Sequence[str] = (), **times: Any) -> "Choice":
        """Choose the fields with one of these names, which may contain ``*`` and ``?``.

        Case, underscores, dots and a final ``Percent`` do not matter. The name of an ESC may be
        left out. In a CAN log, the name of a signal can be given, too. Raises UserError if a name
        matches no field. Without names, all fields are chosen.
        """
        if not names:
            return cls([*range(len(fields))], **times)
        chosen: dict[int, None] = {}
        problems = []
        known = [
            {_plain(one.name), _plain(one.name.rpartition(".")[2]), _plain(one.signal)} - {""}
            for one in fields
        ]
        """The names by which a user can choose each field."""
        for name in names:
            wanted = _plain(name)
            forms = {wanted, wanted.removesuffix("percent")} - {""}
            found = [
                index
                for index, possible in enumerate(known)
                if any(fnmatch.filter(possible, form) for form in forms)
            ]
            if not found:
                near = did_you_mean(name, [one.name for one in fields])
                problems.append(f"--signals {name}: no such signal.{near}")
            chosen |= dict.fromkeys(found)
        if problems:
            raise UserError(*problems)
        return cls([*chosen], **times)


def _plain(name: str) -> str:
    return name.lower().replace("_", "").replace(".", "")
