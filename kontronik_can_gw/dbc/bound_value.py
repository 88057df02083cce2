"""A signal that shows a value: conversion between their units, names of states, what the signal cannot show."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from fractions import Fraction

from kontronik_can_gw.dbc import raw_values
from kontronik_can_gw.dbc.raw_values import ValueTable
from kontronik_can_gw.dbc.settings import UnfitSignal
from kontronik_can_gw.esc.values import Value
from kontronik_can_gw.signals import units
from kontronik_can_gw.signals.plan import Role, SignalPlan


def bound_plan(
    plan: SignalPlan, table: ValueTable, value: Value, on_loss: int | None
) -> SignalPlan:
    """The plan of a signal with the value as its source. UnfitSignal where it cannot show the value.

    ``on_loss``: what a flag holds without telemetry, 0 or 1; None: its code.
    """
    slope, intercept = _scale(plan, value)
    plan = replace(plan, role=Role.SOURCE, source=value, slope=slope, intercept=intercept)
    numbers = table.numbers(value)
    notes = [*_notes_on_names(value, numbers)]
    low, high = plan.low, plan.high
    if value.bit is not None and plan.length == 1:
        plan = _flag(plan, on_loss)
    if value.rolls:
        counts = slope == 1 and intercept == 0 and low == 0 and high >= 1
        if plan.is_float or not counts:
            raise UnfitSignal(
                f"{value.name} is a counter; it needs factor 1, offset 0 and a minimum of 0."
            )
        notes.append(f"starts again at 0 after {high}")
    has_no_code = not plan.is_float and table.not_available is None
    if has_no_code and low <= plan.not_available <= high:
        sent = raw_values.text(plan.not_available * plan.factor + plan.offset)
        notes.append(f"not available is sent as {sent}")
    return replace(plan, numbers=numbers or None, notes=tuple(notes))


def _scale(plan: SignalPlan, value: Value) -> tuple[Fraction, Fraction]:
    """Slope and intercept, from the value's steps to raw values."""
    converted = units.conversion(value.unit, plan.unit)
    if converted is None:
        can = ", ".join(units.texts_like(value.unit))
        raise UnfitSignal(
            f"{value.name} is in {value.unit or 'no unit'} and cannot be converted to "
            f"{plan.unit!r}. Possible: {can}; dbc.units says what other texts mean."
        )
    scale, shift = converted
    return scale / value.per_unit / plan.factor, (shift - plan.offset) / plan.factor


def _notes_on_names(value: Value, numbers: Mapping[int, int]) -> Iterator[str]:
    missing = [text for number, text in value.names.items() if number not in numbers]
    if value.names and not numbers:
        yield "the value table has no name of it: sent as the ESC's number"
    elif missing:
        yield f"sent as Error, not in the value table: {', '.join(missing)}"


def _flag(plan: SignalPlan, on_loss: int | None) -> SignalPlan:
    """The plan of a flag in one bit: both its raw values are values."""
    raws = [math.floor(value * plan.slope + plan.intercept + Fraction(1, 2)) for value in (0, 1)]
    if any(not plan.low <= raw <= plan.high and raw != plan.error for raw in raws):
        sign = " Make it unsigned." if plan.signed else ""
        raise UnfitSignal(f"cannot hold both values of a flag, 0 and 1.{sign}")
    if on_loss is None:
        return plan
    code = raws[on_loss]
    # an "Error" in the value table at 0 or 1 is a value, not a code
    return replace(plan, not_available=code, error=code, low=min(raws), high=max(raws))
