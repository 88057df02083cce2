"""The columns of a table of telemetry: every value of values.py by its name and in its unit, of each ESC and of the gateway.

``sections`` divides chosen columns into neighbours that are read together: fields of a frame all at once, flags by
their word, the others one by one. A value that is not fresh is None.
"""

import math
import re
from collections.abc import Callable, Hashable, Sequence
from fractions import Fraction
from functools import cache
from itertools import groupby
from operator import attrgetter, getitem, itemgetter
from typing import Any, NamedTuple

from kontronik_can_gw.desk.recordings.fields import Field, Kind
from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry
from kontronik_can_gw.esc.values import GatewayStatus, Group, Source, sources
from kontronik_can_gw.signals.unpacker import Value

Steps = int | float | None
Values = tuple[Value, ...]
DECIMALS = 6
"""Of a quotient by pole pairs, gear, cells or hours."""
LEFT_OUT = frozenset({"sent_frames"})
"""What only the frames themselves tell: they are not made for a table."""
_MAX_KNOWN = 1 << 13
_ORDER = {Group.LIVE: 0, Group.LINK: 1, Group.INFO: 2, Group.GATEWAY: 3}
_DRIVE = EscSettings(pole_pairs=7, gear=Fraction(3))
"""A drive train of odd numbers: where it makes a difference, it is in a value."""
_WORD = re.compile(r"(?:live|info)\[(\d+)\]")
_OF_FRAME = re.compile(r"(?<![.\w])(live|info)\b")


@cache
def _listed() -> dict[str, Source]:
    found = [one for one in sources(_DRIVE).values() if one.name not in LEFT_OUT]
    return {one.name: one for one in sorted(found, key=lambda one: _ORDER[one.group])}


@cache
def _depends_on_drive(name: str) -> bool:
    """True where pole pairs or gear are in a value."""
    return _listed()[name].per_unit != sources(EscSettings())[name].per_unit


def fields_of_values(escs: Sequence[EscSettings]) -> list[Field]:
    """A field for each value, of all ESCs and then of the gateway; with several ESCs named ``esc1.battery_voltage``."""
    found = []
    for index, esc in enumerate(escs):
        prefix = f"{esc.name}." if len(escs) > 1 else ""
        listed = (one for one in _listed().values() if one.group is not Group.GATEWAY)
        found += [_field(one, prefix, index) for one in listed]
    listed = (one for one in _listed().values() if one.group is Group.GATEWAY)
    return found + [_field(one, "", None) for one in listed]


def _field(source: Source, prefix: str, esc: int | None) -> Field:
    texts = tuple(sorted(source.names.items()))
    name = prefix + source.name
    high = math.inf if source.high is None else float(source.high / source.per_unit)
    return Field(name, source.unit, _kind(source), "", texts, source.name, esc, high)


def _kind(source: Source) -> Kind:
    if source.names:
        return Kind.TEXT
    if source.bit is not None:
        return Kind.FLAG
    by_drive = _depends_on_drive(source.name)
    return Kind.WHOLE if source.per_unit == 1 and source.whole and not by_drive else Kind.FLOAT


# --- reading


@cache
def reader(name: str) -> Callable[[EscTelemetry, int], Steps]:
    """What gives a value of an ESC in steps at a time; None where it is not available."""
    source = _listed()[name]
    text, supplied = _OF_FRAME.sub(r"esc.\1", source.expression), []
    if source.group in (Group.LIVE, Group.INFO):
        supplied.append(f"esc.{source.group.value} is not None")
    if source.supplied is not None:
        supplied.append(_OF_FRAME.sub(r"esc.\1", source.supplied))
    if supplied:
        text = f"({text}) if {' and '.join(supplied)} else None"
    made: Callable[[EscTelemetry, int], Steps] = eval(f"lambda esc, now: {text}")  # noqa: S307  text of values.py
    return made


@cache
def gateway_reader(name: str) -> Callable[[GatewayStatus, int], int]:
    """What gives a value of the gateway in steps at a time."""
    text = f"lambda gateway, now: {_listed()[name].expression}"
    made: Callable[[GatewayStatus, int], int] = eval(text)  # noqa: S307  text of values.py
    return made


def _word(source: Source) -> int | None:
    """Where in its frame's fields a value or flag stands as it is; None for one that is derived."""
    found = _WORD.fullmatch(source.expression)
    if found is None or source.supplied is not None or _depends_on_drive(source.name):
        return None
    return int(found[1])


class Known(dict[Any, Any]):
    """Results of a function by argument; it is emptied when it is full."""

    def __init__(self, make: Callable[[Any], Any]) -> None:
        self._make = make

    def __missing__(self, key: Any) -> Any:
        if len(self) >= _MAX_KNOWN:
            self.clear()
        made = self[key] = self._make(key)
        return made


def _scaling(source: Source) -> Callable[[Any], Value] | None:
    """From steps to the value in its unit, or its text; None where the value is the steps."""
    if source.names:
        return source.names.get
    if _kind(source) is Kind.WHOLE or source.bit is not None:
        return None
    top, bottom = source.per_unit.denominator, source.per_unit.numerator
    if 10**DECIMALS % bottom == 0 and source.whole:
        return lambda steps: steps * top / bottom
    return lambda steps: round(steps * top / bottom, DECIMALS)


class Section(NamedTuple):
    """Neighbouring columns that are read together.

    ``group``: what they change with; ``esc``: whose they are, None for the gateway. ``read`` is given an EscTelemetry, or
    the GatewayStatus, and the time.
    """

    group: Group
    esc: int | None
    nothing: Values
    read: Callable[[Any, int], Values]


def _words(names: Sequence[str], attribute: str) -> Callable[[Any, int], Values]:
    """What gives values that stand in a frame's fields as they are."""
    words = [_word(_listed()[name]) for name in names]
    take = itemgetter(*words, words[0])  # one more: of a single word it would be no tuple
    scales = [Known(_scaling(_listed()[name]) or int) for name in names]
    nothing: Values = (None,) * len(names)
    data_of = attrgetter(attribute)

    def read(esc: EscTelemetry, _: int) -> Values:
        data = data_of(esc)
        return nothing if data is None else tuple(map(getitem, scales, take(data)))

    return read


def _flags(names: Sequence[str], attribute: str) -> Callable[[Any, int], Values]:
    """What gives the bits of one word of a frame."""
    word = _word(_listed()[names[0]])
    assert word is not None
    bits = [_listed()[name].bit or 0 for name in names]
    known = Known(lambda found: tuple([found >> bit & 1 for bit in bits]))
    nothing: Values = (None,) * len(names)
    data_of = attrgetter(attribute)

    def read(esc: EscTelemetry, _: int) -> Values:
        data = data_of(esc)
        return nothing if data is None else known[data[word]]

    return read


def _derived(names: Sequence[str]) -> Callable[[Any, int], Values]:
    """What gives values of an ESC that are computed, by its pole pairs and gear as they are then."""
    known: EscSettings | None = None
    readers: list[tuple[Callable[[EscTelemetry, int], Steps], Callable[[Any], Value] | None]] = []

    def read(esc: EscTelemetry, now: int) -> Values:
        nonlocal known, readers
        if esc.settings is not known:
            known = esc.settings
            listed = sources(known)
            readers = [(reader(name), _scaling(listed[name])) for name in names]
        values: list[Value] = []
        for read, scale in readers:
            steps = read(esc, now)
            values.append(steps if steps is None or scale is None else scale(steps))
        return tuple(values)

    return read


def _of_gateway(names: Sequence[str]) -> Callable[[Any, int], Values]:
    readers = [(gateway_reader(name), _scaling(_listed()[name]) or int) for name in names]
    return lambda status, now: tuple([scale(read(status, now)) for read, scale in readers])


def sections(fields: Sequence[Field], chosen: Sequence[int]) -> list[Section]:
    """The sections of chosen fields, in their order."""
    found = []
    for _, neighbours in groupby((fields[index] for index in chosen), _together):
        together = list(neighbours)
        names = [one.source for one in together]
        source, esc = _listed()[names[0]], together[0].esc
        if esc is None:
            read = _of_gateway(names)
        elif _word(source) is None:
            read = _derived(names)
        else:
            make = _words if source.bit is None else _flags
            read = make(names, source.group.value)
        found.append(Section(source.group, esc, (None,) * len(names), read))
    return found


def _together(field: Field) -> Hashable:
    """The same for columns that are read together."""
    source = _listed()[field.source]
    word = _word(source)
    return field.esc, source.group, None if word is None else word if source.bit is not None else -1
