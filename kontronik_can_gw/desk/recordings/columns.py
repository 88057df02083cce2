"""The columns of a table of telemetry: every value of values.py by its name and in its unit, of each ESC and of the gateway.

``sections`` divides chosen columns into neighbours that are read together: fields of a frame all at once, flags by
their word, the others one by one. A value that is not fresh is None.
"""

import math
from collections.abc import Callable, Hashable, Sequence
from itertools import groupby
from operator import attrgetter, getitem, itemgetter
from typing import Any, NamedTuple

from kontronik_can_gw.desk.recordings.fields import Field, Kind
from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry
from kontronik_can_gw.esc.values import VALUES, Divisor, Group, physical, steps, values_of_esc
from kontronik_can_gw.esc.values import Kind as How
from kontronik_can_gw.esc.values import Value as EscValue
from kontronik_can_gw.gateway_status import GatewayStatus
from kontronik_can_gw.signals.unpacker import Value

Values = tuple[Value, ...]
Read = Callable[[Any, int], Values]
"""Gives the values of neighbouring columns; is given an EscTelemetry, or the GatewayStatus, and the time."""
LEFT_OUT = frozenset({"sent_frames"})
"""Only the frames themselves show it: they are not made for a table."""
_MAX_KNOWN = 1 << 13
_ORDER = (Group.LIVE, Group.LINK, Group.INFO, Group.GATEWAY)


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


def values_of_fields(
    fields: Sequence[Field], escs: Sequence[EscSettings]
) -> list[tuple[Field, EscValue]]:
    """Each field with its value, as its ESC supplies it."""
    tables = [values_of_esc(esc) for esc in escs]
    return [
        (field, (VALUES if field.esc is None else tables[field.esc])[field.source])
        for field in fields
    ]


def _field(value: EscValue, prefix: str, esc: int | None) -> Field:
    texts = tuple(sorted(value.names.items()))
    high = math.inf if value.high is None else value.high / value.per_unit
    name = prefix + value.name
    kind = Kind.FLOAT
    if value.names:
        kind = Kind.TEXT
    elif value.bit is not None:
        kind = Kind.FLAG
    elif value.per_unit == 1 and value.divisor is Divisor.ONE:
        kind = Kind.WHOLE
    return Field(name, value.unit, kind, "", texts, value.name, esc, high=high)


# --- reading


def _word(value: EscValue) -> int | None:
    """Where in its frame's fields a value or flag stands as it is; None for one that is derived."""
    if value.not_on or value.divisor is not Divisor.ONE or value.read is not None:
        return None
    return value.words[0] if value.kind is How.WIRE or value.bit is not None else None


class Known(dict[Any, Any]):
    """Results of a function by argument; it is emptied when it is full."""

    def __init__(self, make: Callable[[Any], Any]) -> None:
        self._make = make

    def __missing__(self, key: Any) -> Any:
        if len(self) >= _MAX_KNOWN:
            self.clear()
        made = self[key] = self._make(key)
        return made


def _scaling(value: EscValue) -> Callable[[Any], Value]:
    """From steps to the value in its unit, or its text; of values without a divisor."""
    if value.names:
        return value.names.get
    per_unit = value.per_unit
    return int if per_unit == 1 else lambda steps: steps / per_unit


class Section(NamedTuple):
    """Neighbouring columns that are read together. ``group``: what they change with; ``esc``: whose they are, None for the gateway."""

    group: Group
    esc: int | None
    nothing: Values
    read: Read
    ages: bool = False
    """It changes with time alone."""


def _words(values: Sequence[EscValue], attribute: str) -> Read:
    """What gives values that stand in a frame's fields as they are."""
    words = [_word(value) for value in values]
    take = itemgetter(*words, words[0])  # one more: of a single word it would be no tuple
    scales = [Known(_scaling(value)) for value in values]
    nothing: Values = (None,) * len(values)
    data_of = attrgetter(attribute)

    def read(esc: EscTelemetry, _: int) -> Values:
        data = data_of(esc)
        return nothing if data is None else tuple(map(getitem, scales, take(data)))

    return read


def _flags(values: Sequence[EscValue], attribute: str) -> Read:
    """What gives the bits of one word of a frame."""
    word = values[0].words[0]
    bits = [value.bit or 0 for value in values]
    known = Known(lambda found: tuple([found >> bit & 1 for bit in bits]))
    nothing: Values = (None,) * len(values)
    data_of = attrgetter(attribute)

    def read(esc: EscTelemetry, _: int) -> Values:
        data = data_of(esc)
        return nothing if data is None else known[data[word]]

    return read


def _derived(listed: Sequence[EscValue]) -> Read:
    """What gives values of an ESC that are computed, by its pole pairs and gear as they are then."""
    gateway = GatewayStatus()

    def read(esc: EscTelemetry, now: int) -> Values:
        values: list[Value] = []
        for value in listed:
            found = steps(value, esc, gateway, now)
            if value.names:
                values.append(None if found is None else value.names.get(found))
            else:
                values.append(physical(value, esc, found))
        return tuple(values)

    return read


def _of_gateway(values: Sequence[EscValue]) -> Read:
    readers: list[tuple[Any, Callable[[Any], Value]]] = [
        (value.read, _scaling(value)) for value in values
    ]
    return lambda status, now: tuple([scale(read(None, status, now)) for read, scale in readers])


def sections(
    fields: Sequence[Field], chosen: Sequence[int], escs: Sequence[EscSettings]
) -> list[Section]:
    """The sections of chosen fields, in their order."""
    value_of = {id(field): value for field, value in values_of_fields(fields, escs)}

    def together(field: Field) -> Hashable:
        """The same for columns that are read together."""
        value = value_of[id(field)]
        word = _word(value)
        way = None if word is None else word if value.bit is not None else -1
        return field.esc, value.group, way, value.kind is How.AGE

    found = []
    for _, neighbours in groupby((fields[index] for index in chosen), together):
        of_section = list(neighbours)
        values = [value_of[id(field)] for field in of_section]
        value, esc = values[0], of_section[0].esc
        if esc is None:
            read = _of_gateway(values)
        elif _word(value) is None:
            read = _derived(values)
        else:
            read = (_words if value.bit is None else _flags)(values, value.group.value)
        ages = value.kind is How.AGE
        found.append(Section(value.group, esc, (None,) * len(values), read, ages))
    return found
