"""The raw values of a signal, from the numbers and texts that its DBC has.

docs/your-own-dbc.md ("Values") has the rules. All numbers are exact fractions. The solver's proof,
the run of every value through the core, and the oracle of the packers use this one description.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from fractions import Fraction

from specification.quantities import Quantity

_NOT_AVAILABLE = ("notavailable", "sna", "na", "signalnotavailable")
_ERROR = ("error", "err", "invalid")
_HALF = Fraction(1, 2)


class Shape(Enum):
    """How the raw value of a signal is computed."""

    NUMBER = "number"
    FLAG = "flag in one bit"
    COUNTER = "counter"
    NAMES = "enumeration"
    FLOAT = "float"
    ALIVE = "alive counter"
    CRC = "CRC"
    CONSTANT = "constant"


@dataclass(frozen=True)
class Rule:
    """The meaning of a signal's raw values, and how they are computed."""

    shape: Shape
    length: int
    signed: bool
    factor: Fraction
    offset: Fraction
    minimum: Fraction | None
    """Smallest physical value. None: no limit."""
    maximum: Fraction | None
    not_available: int
    error: int
    codes: frozenset[int]
    """All raw values that mean "not available" or "error"."""
    quantity: Quantity | None = None
    esc: int | None = None
    scale: Fraction = Fraction(1)
    shift: Fraction = Fraction(0)
    """``number in the signal's unit = number in the quantity's unit * scale + shift``."""
    numbers: Mapping[int, int] = field(default_factory=dict)
    """NAMES: raw value of each number that has a name in the value table."""
    constant: int = 0
    has_code: bool = False
    """True if the value table has a text for "not available"."""
    modulus: int = 0
    """COUNTER and ALIVE: number of values."""

    @property
    def lowest(self) -> int:
        return -(1 << self.length - 1) if self.signed else 0

    @property
    def highest(self) -> int:
        return self.lowest + (1 << self.length) - 1

    @property
    def raw_limits(self) -> tuple[int, int]:
        """Smallest and greatest raw value within bits and limits. Codes may be between them."""
        if self.minimum is None or self.maximum is None:
            return self.lowest, self.highest
        ends = [(limit - self.offset) / self.factor for limit in (self.minimum, self.maximum)]
        return max(self.lowest, math.ceil(min(ends))), min(self.highest, math.floor(max(ends)))

    def physical(self, raw: int) -> Fraction:
        return raw * self.factor + self.offset

    def exact(self, value: Fraction) -> Fraction:
        """Return the exact raw value of a number in the quantity's unit, not rounded yet."""
        return (value * self.scale + self.shift - self.offset) / self.factor

    def is_value(self, raw: int) -> bool:
        """Return True if a raw value is within bits and limits, and not a code."""
        low, high = self.raw_limits
        return low <= raw <= high and raw not in self.codes

    def sent(self, value: Fraction | None) -> int:
        """Return the raw value that is sent for a number in the quantity's unit.

        None: the value is not available.
        """
        if value is None:
            return self.not_available
        if self.shape is Shape.NAMES:
            return self.numbers.get(int(value), self.error)
        if self.shape is Shape.COUNTER:
            return int(value) % self.modulus
        raw = math.floor(self.exact(value) + _HALF)
        return raw if self.is_value(raw) else self.error


@dataclass(frozen=True)
class Described:
    """A signal as its DBC describes it."""

    length: int
    signed: bool
    is_float: bool
    factor: Fraction
    offset: Fraction
    limits: tuple[Fraction, Fraction]
    texts: Sequence[tuple[int, str]]
    """Raw values and texts of its value table, in the order of the file."""
    start: int | None = None
    """Its start value. None if it has none, or if its bits cannot hold it."""
    has_own_start: bool = False
    """False if the start value is the default of all signals."""

    def codes(self, meanings: Sequence[str]) -> list[int]:
        """Return the raw values whose text has one of these meanings.

        The first one is sent. If its text is in the table twice, this is the last with the text.
        """
        found = [(raw, letters_of(text)) for raw, text in self.texts]
        found = [(raw, text) for raw, text in found if text in meanings]
        if found:
            first = found[0][1]
            last = [each for each in found if each[1] == first][-1]
            found.remove(last)
            found.insert(0, last)
        return [raw for raw, _ in found]

    @property
    def named_not_available(self) -> list[int]:
        """Raw values with a text for "not available". The first one is sent."""
        return self.codes(_NOT_AVAILABLE)

    def base(self) -> Rule:
        """Return a rule with the limits and codes of the file."""
        lowest = highest = None
        if any(self.limits):
            lowest, highest = sorted(self.limits)
        named = self.named_not_available
        errors = self.codes(_ERROR)
        if named:
            not_available = named[0]
        elif self.start is not None and (self.has_own_start or self.length == 1):
            not_available = self.start
        elif self.signed:
            not_available = -(1 << self.length - 1)
        else:
            not_available = (1 << self.length) - 1
        return Rule(
            shape=Shape.FLOAT if self.is_float else Shape.NUMBER,
            length=self.length,
            signed=self.signed,
            factor=self.factor,
            offset=self.offset,
            minimum=lowest,
            maximum=highest,
            not_available=not_available,
            error=errors[0] if errors else not_available,
            codes=frozenset((*named, *errors)),
            has_code=bool(named),
        )

    def counted(self, shape: Shape, most: int | None = None) -> Rule:
        """Return the rule of a counter, which restarts before the first code.

        ``most``: it has no more values.
        """
        rule = self.base()
        _, greatest = rule.raw_limits
        values = [greatest + 1, *(code for code in rule.codes if code >= 0)]
        if most is not None:
            values.append(most)
        return replace(rule, shape=shape, modulus=min(values))

    def of_quantity(
        self,
        quantity: Quantity,
        esc: int | None,
        conversion: tuple[Fraction, Fraction],
        flags_on_loss: int | None = None,
    ) -> Rule:
        """Return the rule of a signal that shows a value.

        ``conversion`` are scale and shift. ``flags_on_loss`` is the value of a flag without a code.
        """
        rule = replace(self.base(), quantity=quantity, esc=esc)
        if not self.is_float:
            numbers = self._numbers(quantity.names)
            if numbers:
                return replace(rule, shape=Shape.NAMES, numbers=numbers)
            if quantity.rolls:
                counted = self.counted(Shape.COUNTER)
                return replace(counted, quantity=quantity, esc=esc)
        scale, shift = conversion
        rule = replace(rule, scale=scale, shift=shift)
        if self.is_float:
            return rule
        if quantity.is_flag and self.length == 1 and not rule.has_code:
            return self._flag(rule, flags_on_loss)
        # Without a text for it, the code is nevertheless not a value.
        return replace(rule, codes=rule.codes | {rule.not_available})

    def _flag(self, rule: Rule, on_loss: int | None) -> Rule:
        """Return the rule of a flag in one bit, which needs both raw values for its value."""
        if on_loss is None and self.has_own_start and self.start is not None:
            lost = self.start
        else:
            lost = math.floor(rule.exact(Fraction(on_loss or 0)) + _HALF)
        return replace(
            rule,
            shape=Shape.FLAG,
            minimum=None,
            maximum=None,
            not_available=lost,
            error=lost,
            codes=frozenset(),
        )

    def _numbers(self, names: Mapping[int, str]) -> dict[int, int]:
        """Return the raw value of each number whose name is in the value table."""
        raws = {letters_of(text): raw for raw, text in self.texts}
        found = {}
        for number, name in names.items():
            if letters_of(name) in raws:
                found[number] = raws[letters_of(name)]
        return found


def letters_of(text: str) -> str:
    """Return letters and digits. Only they count when texts of a DBC are compared."""
    return "".join(filter(str.isalnum, text.lower()))
