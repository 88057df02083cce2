"""Compiles one signal of a DBC: the meaning of its raw values, and its source."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import TYPE_CHECKING

from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.dbc import e2e_attributes, names, raw_values
from kontronik_can_gw.dbc.copies import Copy
from kontronik_can_gw.dbc.names import Binder
from kontronik_can_gw.dbc.raw_values import ValueTable, exact, raw_range
from kontronik_can_gw.dbc.reader import attribute, listed
from kontronik_can_gw.esc.values import Divisor, Group, Value
from kontronik_can_gw.signals import units
from kontronik_can_gw.signals.e2e import DataIdMode, Protection
from kontronik_can_gw.signals.packer import float_bits
from kontronik_can_gw.signals.plan import Role, SignalPlan

if TYPE_CHECKING:
    from cantools.database.can import Database, Signal


_NUMBERS_WITH_TEXTS = frozenset({"operating_state_raw", "device_raw"})
"""Numbers of states and devices, which a DBC may name."""


class UnfitSignal(Exception):
    """The reason why a signal cannot be sent. In an error it follows the signal's name."""


@dataclass
class Compilation:
    """A DBC, its settings, and the results of its compilation."""

    database: "Database"
    settings: DbcConfig
    binder: Binder
    is_fd_allowed: bool
    problems: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    """They begin with the name of the message, and get the file's name later."""
    units: set[str] = field(default_factory=set)
    """Unit texts of the gateway's signals."""
    send_types: set[str] = field(default_factory=set)
    """Texts of GenMsgSendType of the gateway's messages."""
    unbound: set[str] = field(default_factory=set)
    """Signals without a source."""
    protected: set[str] = field(default_factory=set)
    """Keys of [dbc.e2e] that apply to a message with a CRC."""


class SignalCompiler:
    """Makes the plans of one signal. A signal has a plan for each of its groups."""

    def __init__(
        self,
        job: Compilation,
        copy: Copy,
        signal: "Signal",
        protection: Protection | None = None,
    ) -> None:
        self.job = job
        self.copy = copy
        self.signal = signal
        self.nibble: int | None = None
        """The bits of the data ID that the message contains, by the stated E2E protection."""
        if protection is not None and protection.profile.mode is DataIdMode.NIBBLE:
            self.nibble = protection.nibble
        self.table = ValueTable(signal)
        self.start = attribute(signal, "GenSigStartValue", job.database)
        self.is_start_set = signal.dbc is not None and "GenSigStartValue" in signal.dbc.attributes
        self.start_raw = None
        """Raw bits of the start value. None if the signal cannot contain it."""
        if isinstance(self.start, (int, float)):
            self.start_raw = raw_values.constant(signal, self.start, Fraction(1), Fraction(0))

    def plan(self, page: int | None) -> SignalPlan | None:
        """Return the plan on a group. None if it cannot be sent, with a line in the problems."""
        try:
            self._check()
            return self._with_source(self._without_source(page))
        except UnfitSignal as error:
            self.job.problems.append(f"{self._where}: {error}")
            return None

    @property
    def _where(self) -> str:
        return f"{self.copy.message.name}.{self.signal.name}"

    def _check(self) -> None:
        """Raise UnfitSignal for a length or a value table that cannot be sent."""
        signal = self.signal
        length = signal.length
        entries = self.table.entries
        if signal.is_float and length not in (32, 64):
            raise UnfitSignal(f"a float of {length} bits is not supported. Use 32 or 64 bits.")
        if signal.is_float:
            if any(float_bits(raw, length) is None for raw in entries):
                raise UnfitSignal(
                    f"its value table has numbers that a {length}-bit float cannot represent."
                )
            return
        low, high = raw_range(signal)
        outside = [f"{raw} {text!r}" for raw, text in entries.items() if not low <= raw <= high]
        if outside:
            raise UnfitSignal(
                f"cannot represent {', '.join(outside)} of its value table. "
                f"Its raw values are {low} to {high}. Correct the number, or remove the text."
            )

    def _scale(self) -> tuple[Fraction, Fraction, tuple[Fraction, Fraction] | None]:
        """Return factor, offset, and limits as raw values.

        Raises UnfitSignal for numbers that are not finite or too large.
        """
        signal = self.signal
        if signal.scale == 0:
            raise UnfitSignal("has factor 0, so all values would be equal. Correct it.")
        try:
            factor = exact(signal.scale)
            offset = exact(signal.offset)
            limits = raw_values.limits(signal, factor, offset)
            for raw in raw_range(signal):
                float(raw * factor + offset)
            for limit in limits or ():
                float(limit)
        except ValueError:
            raise UnfitSignal(
                "has a factor, offset or limit that is not a finite number. Correct it."
            ) from None
        except OverflowError:
            raise UnfitSignal(
                "has a factor, offset or limit that is too large. Correct it."
            ) from None
        return factor, offset, limits

    def _without_source(self, page: int | None) -> SignalPlan:
        """Return the plan of a constant 0."""
        signal = self.signal
        table = self.table
        factor, offset, limits = self._scale()
        first = signal.minimum or 0
        last = signal.maximum or 0
        if limits is not None and first > last:
            self.job.warnings.append(
                f"{self._where}: its minimum {first:g} is above its maximum {last:g}, so the two "
                "are exchanged. Correct the DBC."
            )
        low, high = raw_range(signal)
        if limits is not None:
            low = max(low, math.ceil(limits[0]))
            high = min(high, math.floor(limits[1]))
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
        """Return the raw value for "not available".

        It is given by the value table, otherwise by the start value, and otherwise by an end of the
        range.
        """
        if self.table.not_available is not None:
            return self.table.not_available
        # a default start value does not mean "not available", but a flag has no other code
        if self.start_raw is not None and (self.is_start_set or self.signal.length == 1):
            return self.start_raw
        low, high = raw_range(self.signal)
        return low if self.signal.is_signed else high

    def _float(self, plan: SignalPlan, limits: tuple[Fraction, Fraction] | None) -> SignalPlan:
        """Return the plan with the codes of the value table as bits of a float, or NaN."""
        table = self.table
        not_available = math.nan if table.not_available is None else table.not_available
        error = math.nan if table.error is None else table.error
        plan = replace(
            plan,
            not_available=float_bits(not_available, plan.length) or 0,
            error=float_bits(error, plan.length) or 0,
        )
        if limits is None:
            return plan
        low, high = limits
        return replace(plan, limits=(float(low), float(high)))

    def _unit(self) -> str:
        """Return the unit according to ``dbc.units``. Empty if there is none."""
        text = (self.signal.unit or "").strip()
        self.job.units.add(text)
        text = self.job.settings.units.get(text, text)
        return "" if units.says_nothing(text) else text

    def _with_source(self, plan: SignalPlan) -> SignalPlan:
        """Return the plan with the source of the signal's value."""
        if self.signal.is_multiplexer:
            return replace(plan, role=Role.MULTIPLEXER)
        bound = self.job.binder.bound(self.copy, self.signal.name)
        if isinstance(bound, (int, float)):
            constant = raw_values.constant(self.signal, bound, plan.factor, plan.offset)
            if constant is None:
                raise UnfitSignal(
                    f"cannot represent its constant {bound} exactly. Its values are "
                    f"{raw_values.text(plan.low * plan.factor + plan.offset)} to "
                    f"{raw_values.text(plan.high * plan.factor + plan.offset)} in steps of "
                    f"{raw_values.text(abs(plan.factor))}. Bind it to one of them."
                )
            return replace(plan, constant=constant)
        name = self.signal.name if bound is None else bound
        role = None
        if bound is None:
            role = e2e_attributes.role_of(self.signal, self.job.database)
        found = None if role else self.job.binder.by_name(name, self.copy.esc)
        if found is not None:
            return self._bound(plan, *found)
        if self.nibble is not None and names.is_data_id(name):
            return replace(plan, role=Role.DATA_ID, constant=self.nibble)
        role = role or names.protection(name)
        if role is Role.ALIVE:
            plan = _counted(plan, self.table)
            if plan.is_float or plan.low > 0 or plan.high < 2:
                raise UnfitSignal(
                    "an alive counter must be an integer of at least 2 bits with a minimum of 0. "
                    "Otherwise bind it to a constant."
                )
        if role is not None:
            return replace(plan, role=role)
        if bound is None and self.job.settings.unbound == "start_value":
            return replace(plan, constant=self._start_value(plan), is_unbound=True)
        raise UnfitSignal(self._without_meaning(name, bound is not None))

    def _without_meaning(self, name: str, is_bound: bool) -> str:
        """Return the reason for a signal whose name, or the name it is bound to, is unknown."""
        key = f"dbc.bind.{self.signal.name}"
        if is_bound:
            hints = self.job.binder.suggestions(name)
            return f'no such source (bound by dbc.bind to "{name}").{hints} Correct {key}.'
        self.job.unbound.add(self._where)
        if names.is_data_id(name) and self.signal.length == 4:
            return (
                "is the name of 4 bits of an E2E data ID, which only the profiles 1C and 11C send. "
                f'Name the profile: dbc.e2e.{self.copy.name} = "1C", or bind it to a constant: '
                f"{key} = 0."
            )
        role = names.likely_protection(name)
        if role is not None:
            noun = "checksum" if role is Role.CRC else "frame counter"
            return (
                f"no such source. If it is the message's {noun}, bind it: "
                f'{key} = "{names.BOUND[role]}".'
            )
        hints = self.job.binder.suggestions(name)
        return f"no such source.{hints} Bind it under [dbc.bind] or rename it."

    def _bound(
        self,
        plan: SignalPlan,
        value: Value,
        esc: int | None,
    ) -> SignalPlan:
        escs = self.job.binder.escs
        if esc is None and value.group is not Group.GATEWAY:
            examples = " or ".join(f"{e.name}.{value.name}" for e in escs[:2])
            raise UnfitSignal(
                f"does not name its ESC. Add a prefix or bind it, for example to {examples}."
            )
        plan = _bound_plan(plan, self.table, value, self._flag_on_loss())
        if value.unit and not plan.unit:
            self.job.warnings.append(f"{self._where}: has no unit, so {value.unit} is assumed.")
        self.job.warnings += self._unknown_texts(plan, value)
        return replace(plan, esc=esc)

    def _unknown_texts(self, plan: SignalPlan, value: Value) -> Iterator[str]:
        """Yield a warning if a number may be sent that has a text without a meaning here."""
        is_number = not plan.numbers and not value.names and value.bit is None
        if not is_number or value.name in _NUMBERS_WITH_TEXTS:
            return
        unknown = [
            f"{raw} {text!r}"
            for raw, text in self.table.texts.items()
            if plan.is_float or plan.low <= raw <= plan.high
        ]
        if unknown:
            yield (
                f"{self._where}: its value table has the texts {listed(unknown, 4)}, which have no "
                "meaning to the gateway, so a value may be sent with such a number. Exclude it by "
                "the limits, or call a code NotAvailable or Error."
            )

    def _start_value(self, plan: SignalPlan) -> int:
        """Return the raw bits of an unbound signal.

        They are its own start value, otherwise NotAvailable, and otherwise the default or 0.
        """
        if not self.is_start_set and self.table.not_available is not None:
            return plan.not_available
        if not self.start:
            return 0
        if self.start_raw is None:
            raise UnfitSignal(
                f"cannot represent its GenSigStartValue {self.start}. Bind it to a constant."
            )
        return self.start_raw

    def _flag_on_loss(self) -> int | None:
        """Return the value without telemetry, 0 or 1, of a flag that has no code for it.

        None: its own code or start value is used.
        """
        if self.table.not_available is not None:
            return None
        chosen = self.job.settings.flags_on_loss
        if chosen is not None:
            return chosen
        has_start_value = self.is_start_set and self.start_raw is not None
        return None if has_start_value else 0


def _bound_plan(
    plan: SignalPlan,
    table: ValueTable,
    value: Value,
    on_loss: int | None,
) -> SignalPlan:
    """Return the plan of a signal with ``value`` as its source.

    ``on_loss`` is the value of a flag without telemetry, 0 or 1, or None for its code. Raises
    UnfitSignal if the signal cannot show the value.
    """
    slope, intercept = _scale(plan, value)
    if value.rolls:
        plan = _counted(plan, table)
    plan = replace(
        plan,
        role=Role.SOURCE,
        source=value,
        slope=slope,
        intercept=intercept,
    )
    numbers = table.numbers(value)
    notes = [*_notes_on_names(value, numbers)]
    low = plan.low
    high = plan.high
    if value.bit is not None and plan.length == 1:
        plan = _flag(plan, on_loss)
    elif value.rolls:
        is_counter = slope == 1 and intercept == 0 and low == 0 and high >= 1
        if plan.is_float or not is_counter:
            raise UnfitSignal(
                f"{value.name} is a counter, which needs factor 1, offset 0 and a minimum of 0. "
                "Correct them."
            )
        notes.append(f"restarts at 0 after {high}")
    elif not plan.is_float and not numbers:
        _check_codes_of_number(plan, table)
        if abs(slope) > 1 and value.divisor is Divisor.ONE and value.bit is None:
            step = raw_values.text(abs(slope * plan.factor))
            notes.append(
                f"changes in steps of {step} {plan.unit}".rstrip() + ", as the value itself"
            )
    has_no_code = not plan.is_float and table.not_available is None
    if has_no_code and low <= plan.not_available <= high:
        sent = raw_values.text(plan.not_available * plan.factor + plan.offset)
        notes.append(f"not available is sent as {sent}")
    return replace(plan, numbers=numbers or None, notes=tuple(notes))


def _counted(plan: SignalPlan, table: ValueTable) -> SignalPlan:
    """Return the plan of a counter, which restarts at 0 before the first code."""
    first = min((raw for raw in table.special if raw >= 0), default=plan.high + 1)
    return replace(plan, high=min(plan.high, first - 1))


def _check_codes_of_number(plan: SignalPlan, table: ValueTable) -> None:
    """Raise UnfitSignal if a value could be sent as a code of the value table.

    The codes in use are excluded from the values, wherever they are. Any others must be at an end.
    """
    for raw in table.special:
        if plan.low <= raw <= plan.high and raw not in (plan.not_available, plan.error):
            raise UnfitSignal(
                f"the value {raw} would be read as {table.entries[raw]!r} of its value table, "
                "which has a further code with this meaning. Remove one of them."
            )


def _scale(plan: SignalPlan, value: Value) -> tuple[Fraction, Fraction]:
    """Return slope and intercept of the conversion from the value's steps to raw values."""
    converted = units.conversion(value.unit, plan.unit)
    if converted is None:
        can = ", ".join(units.texts_like(value.unit))
        unit = f"is in {value.unit}" if value.unit else "has no unit"
        raise UnfitSignal(
            f"{value.name} {unit} and cannot be converted to {plan.unit!r}. "
            f"Possible units: {can}. For another spelling, set dbc.units."
        )
    scale, shift = converted
    slope = scale / value.per_unit / plan.factor
    intercept = (shift - plan.offset) / plan.factor
    return slope, intercept


def _notes_on_names(value: Value, numbers: Mapping[int, int]) -> Iterator[str]:
    missing = [text for number, text in value.names.items() if number not in numbers]
    if value.names and not numbers:
        yield "the value table has none of its names, so the ESC's number is sent"
    elif missing:
        yield f"sent as Error, because missing in the value table: {', '.join(missing)}"


def _flag(plan: SignalPlan, on_loss: int | None) -> SignalPlan:
    """Return the plan of a flag in one bit. Both raw values of the bit are values."""
    half = Fraction(1, 2)
    raws = []
    for value in (0, 1):
        raws.append(math.floor(value * plan.slope + plan.intercept + half))
    outside = [raw for raw in raws if not plan.low <= raw <= plan.high]
    if any(raw != plan.error for raw in outside):
        sign = " Make it unsigned." if plan.signed else ""
        raise UnfitSignal(f"cannot represent both values of a flag, 0 and 1.{sign}")
    if on_loss is None:
        return plan
    code = raws[on_loss]
    # an "Error" in the value table at 0 or 1 is a value, not a code
    return replace(
        plan,
        not_available=code,
        error=code,
        low=min(raws),
        high=max(raws),
    )
