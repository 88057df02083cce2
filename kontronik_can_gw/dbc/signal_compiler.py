"""Compiles one signal of a DBC: what its raw values mean, and what fills it."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import TYPE_CHECKING

from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.dbc import names, raw_values
from kontronik_can_gw.dbc.copies import Copy
from kontronik_can_gw.dbc.names import Binder
from kontronik_can_gw.dbc.raw_values import ValueTable, exact, raw_range
from kontronik_can_gw.dbc.reader import attribute
from kontronik_can_gw.esc.values import Group, Value
from kontronik_can_gw.signals import units
from kontronik_can_gw.signals.packer import float_bits
from kontronik_can_gw.signals.plan import Role, SignalPlan

if TYPE_CHECKING:
    from cantools.database.can import Database, Signal


class UnfitSignal(Exception):
    """Why a signal cannot be sent, as it follows the signal's place in an error."""


@dataclass
class Compilation:
    """A DBC and how it is used, and what is found while it is compiled."""

    database: "Database"
    file: str
    settings: DbcConfig
    binder: Binder
    fd_allowed: bool
    problems: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    units: set[str] = field(default_factory=set)
    """Unit texts of our signals."""
    send_types: set[str] = field(default_factory=set)
    unbound: set[str] = field(default_factory=set)
    """Signals without a source."""


class SignalCompiler:
    """Makes the plans of one signal, one for each page it is on."""

    def __init__(self, job: Compilation, copy: Copy, signal: "Signal") -> None:
        self.job = job
        self.copy = copy
        self.signal = signal
        self.table = ValueTable(signal)
        self.start = attribute(signal, "GenSigStartValue", job.database)
        self.start_is_set = signal.dbc is not None and "GenSigStartValue" in signal.dbc.attributes
        self.start_raw = None
        """Raw bits of the start value; None for one that the signal cannot hold."""
        if isinstance(self.start, (int, float)):
            self.start_raw = raw_values.constant(signal, self.start, Fraction(1), Fraction(0))

    def plan(self, page: int | None) -> SignalPlan | None:
        """The plan on a page; None, with a line in the problems, where the signal cannot be sent."""
        try:
            self._check()
            return self._filled(self._unfilled(page))
        except UnfitSignal as error:
            self.job.problems.append(f"{self._where}: {error}")
            return None

    @property
    def _where(self) -> str:
        return f"{self.job.file}: {self.copy.message.name}.{self.signal.name}"

    def _check(self) -> None:
        """UnfitSignal for a length or a value table that cannot be sent."""
        signal, length, entries = self.signal, self.signal.length, self.table.entries
        if signal.is_float and length not in (32, 64):
            raise UnfitSignal(f"a float of {length} bits cannot be sent; 32 and 64 can.")
        if signal.is_float:
            if any(float_bits(raw, length) is None for raw in entries):
                raise UnfitSignal(
                    f"has a value table with numbers that no {length}-bit float holds."
                )
            return
        low, high = raw_range(signal)
        if wide := [f"{raw} {text!r}" for raw, text in entries.items() if not low <= raw <= high]:
            raise UnfitSignal(
                f"cannot hold {', '.join(wide)} of its value table; its values are {low} to {high}."
            )

    def _scale(self) -> tuple[Fraction, Fraction, tuple[Fraction, Fraction] | None]:
        """Factor, offset, and limits as raw values. UnfitSignal for numbers that nothing can be computed with."""
        signal = self.signal
        if signal.scale == 0:
            raise UnfitSignal("has factor 0.")
        try:
            factor, offset = exact(signal.scale), exact(signal.offset)
            limits = raw_values.limits(signal, factor, offset)
            for end in (*(raw * factor + offset for raw in raw_range(signal)), *(limits or ())):
                float(end)
        except ValueError:
            raise UnfitSignal("has a factor, offset or limit that is no finite number.") from None
        except OverflowError:
            raise UnfitSignal("has a factor, offset or limit that is too large.") from None
        return factor, offset, limits

    def _unfilled(self, page: int | None) -> SignalPlan:
        """The plan as a constant 0."""
        signal, table = self.signal, self.table
        factor, offset, limits = self._scale()
        low, high = raw_range(signal)
        if limits is not None:
            low, high = max(low, math.ceil(limits[0])), min(high, math.floor(limits[1]))
        while high in table.special:
            high -= 1
        while low in table.special:
            low += 1
        not_available = self._not_available()
        plan = SignalPlan(
            name=self.copy.prefix + signal.name,
            unit=self._unit(),
            role=Role.CONSTANT,
            length=signal.length,
            signed=signal.is_signed,
            is_float=signal.is_float,
            pieces=raw_values.pieces(signal.start, signal.length, signal.byte_order),
            low=low,
            high=high,
            not_available=not_available,
            error=not_available if table.error is None else table.error,
            page=page,
            factor=factor,
            offset=offset,
            texts=table.texts,
        )
        return self._float(plan, limits) if signal.is_float else plan

    def _not_available(self) -> int:
        """The raw value for "not available": by the value table, else the start value, else an end of the range."""
        if self.table.not_available is not None:
            return self.table.not_available
        # a start value that is a mere default does not mean "not available"; a flag has nothing better
        if self.start_raw is not None and (self.start_is_set or self.signal.length == 1):
            return self.start_raw
        low, high = raw_range(self.signal)
        return low if self.signal.is_signed else high

    def _float(self, plan: SignalPlan, limits: tuple[Fraction, Fraction] | None) -> SignalPlan:
        """The plan with the codes as bits of a float: from the value table, else NaN."""
        not_available, error = (
            float_bits(math.nan if raw is None else raw, plan.length) or 0
            for raw in (self.table.not_available, self.table.error)
        )
        plan = replace(plan, not_available=not_available, error=error)
        if limits is None:
            return plan
        return replace(plan, limits=(float(limits[0]), float(limits[1])))

    def _unit(self) -> str:
        """The unit after ``dbc.units``; empty where none is given."""
        text = (self.signal.unit or "").strip()
        self.job.units.add(text)
        text = self.job.settings.units.get(text, text)
        return "" if units.says_nothing(text) else text

    def _filled(self, plan: SignalPlan) -> SignalPlan:
        """The plan with what fills the signal."""
        if self.signal.is_multiplexer:
            return replace(plan, role=Role.MULTIPLEXER)
        bound = self.job.binder.bound(self.copy, self.signal.name)
        if isinstance(bound, (int, float)):
            constant = raw_values.constant(self.signal, bound, plan.factor, plan.offset)
            if constant is None:
                raise UnfitSignal(f"the constant {bound} bound to it cannot be sent exactly.")
            return replace(plan, constant=constant)
        name = self.signal.name if bound is None else bound
        if (found := self.job.binder.by_name(name, self.copy.esc)) is not None:
            return self._bound(plan, *found)
        if (role := names.protection(name)) is not None:
            if role is Role.ALIVE and (plan.is_float or plan.low > 0 or plan.high < 2):
                raise UnfitSignal(
                    "an alive counter needs a whole number of 2 bits or more that begins at 0. Or bind it to a constant."
                )
            return replace(plan, role=role)
        if bound is None and self.job.settings.unbound == "start_value":
            return replace(plan, constant=self._start_value(plan), unbound=True)
        if bound is None:
            self.job.unbound.add(self._where)
        via = "" if bound is None else f" (bound by dbc.bind to {bound!r})"
        hints = self.job.binder.suggestions(name)
        raise UnfitSignal(f"no such source{via}.{hints} Bind it under [dbc.bind] or rename it.")

    def _bound(self, plan: SignalPlan, value: Value, esc: int | None) -> SignalPlan:
        escs = self.job.binder.escs
        if esc is None and value.group is not Group.GATEWAY:
            examples = " or ".join(f"{e.name}.{value.name}" for e in escs[:2])
            raise UnfitSignal(f"does not say of which ESC. Prefix it or bind it: {examples}.")
        plan = _bound_plan(plan, self.table, value, self._flag_on_loss())
        if value.unit and not plan.unit:
            self.job.warnings.append(f"{self._where}: has no unit; {value.unit} is taken.")
        return replace(plan, esc=esc)

    def _start_value(self, plan: SignalPlan) -> int:
        """The raw bits of an unbound signal: its own start value, else NotAvailable, else the default or 0."""
        if not self.start_is_set and self.table.not_available is not None:
            return plan.not_available
        if not self.start:
            return 0
        if self.start_raw is None:
            raise UnfitSignal(
                f"its GenSigStartValue {self.start} is none of its raw values. Bind it to a constant."
            )
        return self.start_raw

    def _flag_on_loss(self) -> int | None:
        """Value without telemetry, 0 or 1, of a flag that has no code for it; None: its own code or start value."""
        if self.table.not_available is not None:
            return None
        chosen = self.job.settings.flags_on_loss
        own = self.start_is_set and self.start_raw is not None
        return None if chosen is None and own else chosen or 0


def _bound_plan(
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
