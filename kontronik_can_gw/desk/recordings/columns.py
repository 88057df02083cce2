"""The columns of a table of telemetry: every value of values.py by its name and in its unit, of each ESC and of the gateway.

A value that is not fresh is None.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

from kontronik_can_gw.desk.recordings.fields import Field, Kind
from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry
from kontronik_can_gw.esc.values import VALUES, Divisor, Group, physical, steps, values_of_esc
from kontronik_can_gw.esc.values import Value as EscValue
from kontronik_can_gw.gateway_status import GatewayStatus
from kontronik_can_gw.signals.unpacker import Value

Values = tuple[Value, ...]
Read = Callable[[Any, GatewayStatus, int], Value]
"""Gives a value of an EscTelemetry (None for one of the gateway), or of the GatewayStatus, at a time."""
LEFT_OUT = frozenset({"sent_frames"})
"""Only the frames themselves show it: they are not made for a table."""
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


def reader_of(value: EscValue) -> Read:
    """Gives a value, or its text."""
    names = value.names
    is_whole = value.per_unit == 1 and value.divisor is Divisor.ONE

    def read(esc: EscTelemetry, status: GatewayStatus, now: int) -> Value:
        found = steps(value, esc, status, now)
        if found is None:
            return None
        if names:
            return names.get(found)
        return int(found) if is_whole else physical(value, esc, found)

    return read
