"""Compares the rule of a signal with its plan for all values, devices and settings, with z3.

All formulas are linear. A value that pole pairs, gear or cells divide is a real number between the
bounds that the largest and smallest divisor allow, so one formula covers all settings. A formula
without a solution is a proof. A solution of this wider formula need not be a counter-example, so
the search continues with one setting after the other.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import z3  # type: ignore[import-untyped]
from specification import TYPE_RANGES
from specification.quantities import Divisor, Presence, Read
from specification.rule import Rule, Shape

from dbc_proof.planned import INT64_END, LARGEST, Planned

TIMEOUT_MS = 10_000
"""Time for one formula. z3 needs some milliseconds for almost all of them."""
_DEVICES = 64
_BYTE = 8
_MOST_CELLS = 255
_ANY = 1 << 48
_FURTHER_GEARS = (
    Fraction(1),
    Fraction(3, 2),
    Fraction(490_909, 50_000),
    Fraction(1, 1000),
    Fraction(1000),
)


@dataclass(frozen=True)
class Settings:
    """The settings of an ESC that divide values."""

    poles: int = 1
    gear: Fraction = Fraction(1)
    cells: int = 1

    def ratio(self, divisor: Divisor) -> Fraction:
        """Return the number that divides the steps."""
        by = {
            Divisor.ONE: Fraction(1),
            Divisor.POLES: Fraction(self.poles),
            Divisor.OUTPUT: self.poles * self.gear,
            Divisor.CELLS: Fraction(self.cells),
        }
        return by[divisor]


@dataclass(frozen=True)
class CounterExample:
    """A state in which the plan does not send the value that the DBC defines."""

    steps: int
    available: bool
    """True if the value is available, as the DBC defines it."""
    device: int | None
    """The known device, if the value depends on it."""
    settings: Settings
    got: int
    want: int


@dataclass(frozen=True)
class Verdict:
    """The result for one signal. A proof if both are empty."""

    counter_example: CounterExample | None = None
    reason: str = ""
    """The reason why nothing is proven and nothing is refuted."""


def compare(expected: Rule, planned: Planned, settings: Settings) -> Verdict:
    """Prove that a plan sends the bits that its DBC defines, or find a counter-example.

    ``settings`` are tried first for a counter-example. The rule has a quantity, and no floats. Both
    are about the same ESC. No product of the plan leaves 64 bits, which ``products`` shows.
    """
    if planned.scale is not None and planned.scale.div <= 0:
        return Verdict(reason="the plan divides by a number that is not positive")
    if planned.is_of_settings:
        found = _World(expected, planned, settings).solve()
        return Verdict(reason=found) if isinstance(found, str) else Verdict(found)
    same_divisor = expected.quantity is not None and expected.quantity.divisor is planned.divisor
    if same_divisor:
        found = _World(expected, planned, None).solve()
        if isinstance(found, str):
            return Verdict(reason=found)
        if found is None:
            return Verdict()
        if planned.divisor is Divisor.ONE:
            return Verdict(found)
    gave_up = ""
    for each in _all_settings(settings, planned, expected):
        found = _World(expected, planned, each).solve()
        if isinstance(found, CounterExample):
            return Verdict(found)
        gave_up = gave_up or found or ""
    if same_divisor and planned.divisor is Divisor.CELLS:
        return Verdict(reason=gave_up)  # these were all numbers of cells
    return Verdict(
        reason="the formula for all settings has a solution, but none for the tried ones"
    )


def _all_settings(first: Settings, planned: Planned, expected: Rule) -> Iterator[Settings]:
    """Yield the settings for which a counter-example is looked for."""
    yield first
    assert expected.quantity is not None
    divisors = {planned.divisor, expected.quantity.divisor}
    gears = (first.gear, *_FURTHER_GEARS) if Divisor.OUTPUT in divisors else (Fraction(1),)
    most = 1
    if divisors & {Divisor.POLES, Divisor.OUTPUT}:
        most, _ = LARGEST[Divisor.POLES]
    if Divisor.CELLS in divisors:
        most = max(most, _MOST_CELLS)
    for gear in gears:
        for number in range(1, most + 1):
            yield Settings(number, gear, number)


@dataclass
class _World:
    """One formula: everything that can be true at the moment at which a frame is packed.

    Without ``settings``, divided values are any real numbers within their bounds.
    """

    expected: Rule
    planned: Planned
    settings: Settings | None
    facts: list[Any] = field(default_factory=list)
    _quotients: dict[tuple[int, Divisor], Any] = field(default_factory=dict)
    _bytes: dict[tuple[str, int], Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.live, self.info, self.had_info, self.after_live, self.rated = z3.Bools(
            "live info had_info after_live rated"
        )
        self.device, self.cells = z3.Ints("device cells")
        self.facts += [
            z3.Implies(self.info, self.had_info),
            self.device >= 0,
            self.device < _DEVICES,
            self.cells >= 0,
            self.cells <= _MOST_CELLS,
        ]

    def solve(self) -> CounterExample | str | None:
        """Return a counter-example, None if there is none, or why the solver gave up."""
        quantity = self.expected.quantity
        assert quantity is not None
        x, other = self._steps()
        available, want = self._expected(x)
        got = self._planned(other)
        solver = z3.Solver()
        solver.set("timeout", TIMEOUT_MS)
        solver.add(*self.facts, got != want)
        # Counter-examples with a value are easier to read than those without telemetry.
        for condition in (z3.And(available, self.info), available, z3.BoolVal(True)):
            solver.push()
            solver.add(condition)
            answer = solver.check()
            if answer == z3.sat:
                return self._counter_example(solver.model(), x, available, got, want)
            solver.pop()
        if answer == z3.unsat:
            return None
        return f"the solver gave up: {solver.reason_unknown()}"

    def _counter_example(
        self, model: Any, x: Any, available: Any, got: Any, want: Any
    ) -> CounterExample:
        def number(term: Any) -> int:
            return int(model.eval(term, model_completion=True).as_long())

        is_available = z3.is_true(model.eval(available, model_completion=True))
        knows = z3.is_true(model.eval(self.had_info, model_completion=True))
        depends = bool(self.planned.not_on) or bool(
            self.expected.quantity and self.expected.quantity.not_on
        )
        return CounterExample(
            steps=number(x),
            available=is_available,
            device=number(self.device) if knows and depends else None,
            settings=self.settings or Settings(),
            got=number(got),
            want=number(want),
        )

    # --- sources ---------------------------------------------------------------------------------

    def _steps(self) -> tuple[Any, Any]:
        """Return the steps that the DBC's value has, and the steps that the plan reads."""
        quantity = self.expected.quantity
        assert quantity is not None
        if self.planned.read == quantity.read:
            x = z3.Int("x")
            self.facts += [quantity.low <= x, x <= quantity.high]
            return x, x
        x = self._read(quantity.read, "x", quantity.low, quantity.high)
        other = self._read(self.planned.read, "other", 0, _ANY)
        return x, other

    def _read(self, read: Read, name: str, low: int, high: int) -> Any:
        """Return the steps of a source, made of the bytes of a frame if it is a field."""
        mask = read.mask
        if not read.wire or mask & (mask + 1):
            x = z3.Int(name)
            self.facts += [low <= x, x <= high]
            return x
        low, high = TYPE_RANGES[read.wire]
        size = (high - low).bit_length() // _BYTE
        term: Any = 0
        for place in range(size):
            byte = self._byte(read.source, read.offset + place)
            term = term + byte * (1 << _BYTE * place)
        if low < 0:
            term = z3.If(term > high, term - (high - low + 1), term)
        return (term / (1 << read.shift)) % (mask + 1) if mask else term

    def _byte(self, frame: str, offset: int) -> Any:
        key = (frame, offset)
        if key not in self._bytes:
            byte = z3.Int(f"byte {frame} {offset}")
            self.facts += [byte >= 0, byte < 1 << _BYTE]
            self._bytes[key] = byte
        return self._bytes[key]

    def _quotient(self, x: Any, divisor: Divisor) -> tuple[Any, Any]:
        """Return whether the divisor is known, and the steps divided by it."""
        known = self.cells > 0 if divisor is Divisor.CELLS else z3.BoolVal(True)
        if divisor is Divisor.ONE:
            return known, z3.ToReal(x)
        if self.settings is not None:
            self.facts.append(self.cells <= self.settings.cells)
            self.facts.append(z3.Or(self.cells == 0, self.cells == self.settings.cells))
            return known, z3.ToReal(x) / _real(self.settings.ratio(divisor))
        key = (x.get_id(), divisor)
        if key not in self._quotients:
            quotient = z3.Real(f"quotient {len(self._quotients)}")
            by, over = LARGEST[divisor]
            real = z3.ToReal(x)
            self.facts += [
                z3.Implies(x >= 0, z3.And(quotient * by >= real, quotient <= real * over)),
                z3.Implies(x <= 0, z3.And(quotient * by <= real, quotient >= real * over)),
            ]
            self._quotients[key] = quotient
        return known, self._quotients[key]

    def _presence(self, presence: Presence) -> Any:
        return {
            Presence.LIVE: self.live,
            Presence.INFO: self.info,
            Presence.KNOWN_INFO: self.had_info,
            Presence.AFTER_LIVE: self.after_live,
            Presence.RATED: self.rated,
            Presence.ALWAYS: z3.BoolVal(True),
        }[presence]

    # --- the specification -----------------------------------------------------------------------

    def _expected(self, x: Any) -> tuple[Any, Any]:
        """Return whether the value is available, and the raw value that must be sent."""
        rule = self.expected
        quantity = rule.quantity
        assert quantity is not None
        known, y = self._quotient(x, quantity.divisor)
        conditions = [self._presence(quantity.presence), known]
        if quantity.not_on:
            lacks = z3.Or([self.device == device for device in sorted(quantity.not_on)])
            conditions.append(z3.Not(z3.And(self.had_info, lacks)))
            # 0 of a device that is not known may be the 0 of a device that lacks the value
            conditions.append(z3.Not(z3.And(z3.Not(self.info), x == 0)))
        available = z3.And(conditions)
        sent: Any
        if rule.shape is Shape.NAMES:
            sent = z3.IntVal(rule.error)
            for number, raw in rule.numbers.items():
                sent = z3.If(x == number, z3.IntVal(raw), sent)
        else:
            sent = self._rounded(y)
        return available, z3.If(available, sent, z3.IntVal(rule.not_available))

    def _rounded(self, y: Any) -> Any:
        """Return the raw value for a number of steps: rounded once, half up."""
        rule = self.expected
        assert rule.quantity is not None
        nought = rule.exact(Fraction(0))
        step = rule.exact(Fraction(1, rule.quantity.steps)) - nought
        raw = z3.Int("raw")
        # The nearest whole number: less than one half below, or at most one half above.
        distance = z3.ToReal(raw) - (y * _real(step) + _real(nought))
        half = z3.Q(1, 2)
        self.facts += [-half < distance, distance <= half]
        if rule.shape is Shape.COUNTER:
            return self._modulo(raw, rule.modulus, "round")
        low, high = rule.raw_limits
        conditions = [low <= raw, raw <= high]
        conditions += [raw != code for code in sorted(rule.codes)]
        return z3.If(z3.And(conditions), raw, z3.IntVal(rule.error))

    def _modulo(self, number: Any, modulus: int, name: str) -> Any:
        rounds, rest = z3.Ints(f"{name}s {name}_rest")
        self.facts += [number == rounds * modulus + rest, rest >= 0, rest < modulus]
        return rest

    # --- the plan (twins: signals/packer.py; core.c, raw_of) -------------------------------------

    def _planned(self, x: Any) -> Any:
        """Return the raw value that the plan sends, as the DBC's receiver reads its bits."""
        plan = self.planned
        known, y = self._quotient(x, plan.divisor)
        conditions = [self._presence(plan.presence), known]
        if plan.not_on:
            lacks = z3.Or(
                [self.device == device for device in range(_DEVICES) if plan.not_on >> device & 1]
            )
            conditions.append(z3.Or(self.info, x != 0))
            conditions.append(z3.Not(z3.And(self.had_info, lacks)))
        sent: Any
        if plan.numbers is not None:
            sent = self._constant(plan.error)
            for number, raw in plan.numbers.items():
                sent = z3.If(x == number, self._constant(raw), sent)
        else:
            sent = self._computed(x, y)
        return z3.If(z3.And(conditions), sent, self._constant(plan.not_available))

    def _computed(self, x: Any, y: Any) -> Any:
        plan = self.planned
        scale = plan.scale
        if scale is None:
            value = x
        else:
            # v * div <= y * mul + add < (v + 1) * div, so v is the quotient rounded down
            value = z3.Int("v")
            numerator = y * scale.mul + scale.add
            bottom = z3.ToReal(value) * scale.div
            self.facts += [bottom <= numerator, numerator < bottom + scale.div]
            if plan.has_64_bits:
                # ``products`` shows this for all steps that the core multiplies.
                is_small = z3.And(numerator > -INT64_END, numerator < INT64_END)
                steps = z3.BoolVal(True)
                if scale.most is not None:
                    steps = z3.And(-scale.most <= x, x <= scale.most)
                self.facts.append(z3.Implies(steps, is_small))
        error = self._constant(plan.error)
        if plan.rolls:
            sent = self._wrapped(self._modulo(value, plan.high + 1, "turn"), 0, plan.high)
        else:
            is_wrong = [value < plan.low, value > plan.high]
            if plan.excluded is not None:
                is_wrong.append(value == plan.excluded)
            sent = z3.If(z3.Or(is_wrong), error, self._wrapped(value, plan.low, plan.high))
            if plan.saturates:
                sent = z3.If(value < plan.low, self._constant(plan.low), sent)
        if scale is None or scale.most is None:
            return sent
        beyond = error
        if plan.saturates:
            is_below = (x < 0) == z3.BoolVal(scale.mul > 0)
            beyond = z3.If(is_below, self._constant(plan.low), error)
        return z3.If(z3.Or(x > scale.most, x < -scale.most), beyond, sent)

    def _constant(self, bits: int) -> Any:
        return z3.IntVal(received(self.expected, bits))

    def _wrapped(self, value: Any, low: int, high: int) -> Any:
        """Return a number of the plan as the receiver reads its lowest bits."""
        rule = self.expected
        if rule.lowest <= low and high <= rule.highest:
            return value
        return (value - rule.lowest) % (1 << rule.length) + rule.lowest


def received(expected: Rule, bits: int) -> int:
    """Return the raw value that a receiver reads for the lowest bits of a number."""
    return (bits - expected.lowest) % (1 << expected.length) + expected.lowest


def _real(number: Fraction) -> Any:
    return z3.Q(number.numerator, number.denominator)
