"""Factor and offset of a signal as numbers of the core in C.

It is proven for each signal that no product leaves 64 bits, and that the core in C sends the same
raw value as the core in Python for each number of steps.
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from typing import Any, NamedTuple

from kontronik_can_gw.esc.telemetry import MAX_COUNT, MAX_ENERGY, EscSettings
from kontronik_can_gw.esc.values import Divisor, Kind, Value
from kontronik_can_gw.native.header import KCG
from kontronik_can_gw.native.rows import MAX_CELLS, MAX_GEAR, MAX_POLES, NotInCore
from kontronik_can_gw.native.simplest import Steps, round_alike, simplest
from kontronik_can_gw.signals.plan import SignalPlan
from kontronik_can_gw.times import END_OF_TIME

_TYPE_RANGES = {
    KCG.U8: (0, 0xFF),
    KCG.I8: (-0x80, 0x7F),
    KCG.U16: (0, 0xFFFF),
    KCG.I16: (-0x8000, 0x7FFF),
    KCG.U32: (0, 0xFFFF_FFFF),
}
_LARGEST_DIVISOR = {
    Divisor.ONE: (1, 1),
    Divisor.POLE_PAIRS: (MAX_POLES, 1),
    Divisor.SHAFT: (MAX_POLES * MAX_GEAR, MAX_GEAR),
    Divisor.CELLS: (MAX_CELLS, 1),
}
_OF_SETTINGS = (Divisor.POLE_PAIRS, Divisor.SHAFT)
_LIMIT = 1 << 63
_HALF = Fraction(1, 2)
_DIGITS = range(15, 6, -1)
"""Numbers of digits of the factors that a message suggests."""
_ALIKE = Fraction(1, 10**6)
"""Largest relative difference between such a factor and the factor in use."""


class Scale(NamedTuple):
    """Numbers of a row of kcg_signal."""

    mul: int
    add: int
    """For a float, the bits of the offset."""
    div: int
    most: int


def set_scale(
    row: Any,
    signal: SignalPlan,
    value: Value,
    esc: EscSettings,
) -> bool:
    """Enter factor, offset and limits into a row.

    Exact numbers are valid for any settings. If a product could then leave 64 bits, the row gets a
    simpler fraction with the same results. Such a row contains the pole pairs and the gear of
    ``esc``. Returns True if it does, so that it has to be made again if they change. Raises
    NotInCore if no such fraction exists.
    """
    is_plain = _set_limits(row, signal, value)
    if is_plain or signal.numbers is not None:
        return False
    scale = _scale_of(row, signal, value)
    found = scale.exact()
    is_of_settings = found is None and value.divisor in _OF_SETTINGS
    if found is None:
        found = scale.simple(esc)
    if found is None:
        remedy = _fitting_factor(row, signal, value, esc) or scale.remedy
        raise NotInCore(f"factor {_decimal(signal.factor)} exceeds 64 bits. {remedy}")
    if is_of_settings:
        row.divisor = KCG.BY_ONE
    row.mul, row.add, row.div, row.most = found
    return is_of_settings


def rescaled(row: Any, signal: SignalPlan, esc: EscSettings) -> Any:
    """Return a row that contains other settings than the row that ``set_scale`` made.

    If no numbers fit these settings, the signal is always sent as not available.
    """
    assert signal.source is not None
    found = type(row).from_buffer_copy(row)
    try:
        set_scale(found, signal, signal.source, esc)
    except NotInCore:
        found.flags = KCG.PLAIN
        found.low = 1
        found.high = 0
        found.error = found.not_available
    return found


def _set_limits(row: Any, signal: SignalPlan, value: Value) -> bool:
    """Enter flags and limits. Return True if the raw value is the number of steps."""
    if signal.is_float:
        row.flags |= KCG.REAL
        row.low, row.high = map(_bits_of, signal.limits)
        if signal.intercept == 0:
            row.flags |= KCG.PLAIN
        row.add = _bits_of(float(signal.intercept))
        return False
    if value.rolls:
        row.flags |= KCG.ROLLS
    if signal.saturates:
        row.flags |= KCG.SATURATES
    has_own_code = signal.error != signal.not_available
    if has_own_code and signal.low <= signal.not_available <= signal.high:
        row.flags |= KCG.CODE_AMID
    row.low = max(signal.low, -_LIMIT)
    row.high = min(signal.high, _LIMIT - 1)
    is_identity = signal.slope == 1 and signal.intercept == 0
    is_plain = value.divisor is Divisor.ONE and is_identity
    if is_plain:
        row.flags |= KCG.PLAIN
    return is_plain


def _range(row: Any, value: Value) -> tuple[int, int]:
    """Return the smallest and the greatest number of steps, before they are divided."""
    if row.kind in (KCG.OF_LIVE, KCG.OF_INFO, KCG.OF_LAST):
        return (0, row.mask) if row.mask else _TYPE_RANGES[row.wire]
    if row.kind == KCG.OF_DIRECTED:
        largest = max(map(abs, _TYPE_RANGES[row.wire]))
        return -largest, largest
    low = 0 if value.low is None else value.low
    if value.high is not None:
        return low, value.high
    if value.kind is Kind.RUN_TIME:
        return low, END_OF_TIME  # in ns
    if value.kind is Kind.INTEGRAL:
        return low, MAX_ENERGY  # in mW s
    return low, MAX_COUNT  # in ms or frames


def _scale_of(row: Any, signal: SignalPlan, value: Value) -> "_IntegerScale | _FloatScale":
    """Return what finds the numbers of a row whose limits are set."""
    if signal.is_float:
        return _FloatScale(row, signal, value)
    return _IntegerScale(row, signal, value)


class _IntegerScale:
    """Finds the numbers of an integer signal.

    The raw value is ``floor((x * mul * over + add * by) / (div * by))``, and the fraction by / over
    is the divisor.
    """

    remedy = "A smaller maximum or fewer bits may fit"

    def __init__(self, row: Any, signal: SignalPlan, value: Value) -> None:
        self._signal = signal
        self._value = value
        self._low, self._high = _range(row, value)
        self._intercept = signal.intercept + _HALF  # a half is rounded up

    def exact(self) -> Scale | None:
        """Return the exact numbers, or None if a product can leave 64 bits with any settings."""
        slope = self._signal.slope
        div = math.lcm(slope.denominator, self._intercept.denominator)
        mul = int(slope * div)
        add = int(self._intercept * div)
        by, _ = divisor = _LARGEST_DIVISOR[self._value.divisor]
        return self._within_limits(mul, add, div, self._most(slope / by), divisor)

    def simple(self, esc: EscSettings) -> Scale | None:
        """Return the simplest numbers with the same results for these settings, or None."""
        by = 1
        slope = self._signal.slope
        if self._value.divisor in _OF_SETTINGS:
            slope /= _ratio(self._value.divisor, esc)
        elif self._value.divisor is Divisor.CELLS:
            by = MAX_CELLS
        most = self._most(slope / by)
        lines = [self._steps(slope / count, most) for count in range(by, 0, -1)]

        def intercepts(slope: Fraction) -> tuple[Fraction, Fraction]:
            lowest = Fraction(-_LIMIT)
            end = Fraction(_LIMIT)
            for count, line in zip(range(by, 0, -1), lines, strict=True):
                own_lowest, own_end = line.intercepts(slope / count)
                lowest = max(lowest, own_lowest)
                end = min(end, own_end)
                if lowest >= end:
                    break
            return lowest, end

        def is_good(other: Fraction) -> bool:
            lowest, end = intercepts(other)
            return lowest < end and bool(other)  # core.c needs the sign of the slope

        found = simplest(slope, is_good)
        lowest, end = intercepts(found)
        under = found.denominator
        lowest *= under
        end *= under
        intercept = simplest((lowest + end) / 2, lambda other: lowest <= other < end)
        div = under * intercept.denominator
        add = math.ceil(lowest * intercept.denominator)
        return self._within_limits(int(found * div), add, div, most, (by, 1))

    def _most(self, slope: Fraction) -> int:
        """Return the largest absolute number of steps that the core has to multiply.

        Beyond it, in either direction, the signal cannot hold the value, whatever the divisor is,
        and is Error. A counter that rolls over is never too large.
        """
        greatest = max(abs(self._low), abs(self._high))
        if self._value.rolls or not slope:
            return greatest
        above = self._signal.high + 1 - self._intercept
        below = self._intercept - self._signal.low
        widest: Fraction = max(Fraction(0), above, below)
        return min(greatest, int(widest / abs(slope)))

    def _steps(self, slope: Fraction, most: int) -> Steps:
        """Return the raw values of the steps for which they must be equal.

        They end one step after the first value that the signal cannot hold. Beyond it, the results
        are equal because they are ordered as the steps are.
        """
        low = max(self._low, -most)
        high = min(self._high, most)
        if self._value.rolls:
            return Steps(slope, self._intercept, low, high)
        ends = [
            (self._signal.low - self._intercept) / slope,
            (self._signal.high + 1 - self._intercept) / slope,
        ]
        first = min(high, max(low, math.floor(min(ends)) - 1))
        last = max(low, min(high, math.ceil(max(ends)) + 1))
        return Steps(slope, self._intercept, first, last)

    def _within_limits(
        self,
        mul: int,
        add: int,
        div: int,
        most: int,
        divisor: tuple[int, int],
    ) -> Scale | None:
        """Return the numbers in lowest terms. None if a product leaves 64 bits."""
        common = math.gcd(mul, add, div)
        scale = Scale(mul // common, add // common, div // common, most)
        by, over = divisor
        greatest = max(1, most) * abs(scale.mul) * over + abs(scale.add) * by
        if max(greatest, scale.div * by) >= _LIMIT:
            return None
        return scale


class _FloatScale:
    """Finds the numbers of a float signal: ``x * mul * over / (div * by)``, then the offset."""

    remedy = "An integer may fit"

    def __init__(self, row: Any, signal: SignalPlan, value: Value) -> None:
        self._signal = signal
        self._value = value
        self._add = row.add
        self._most = max(map(abs, _range(row, value)))

    def exact(self) -> Scale | None:
        """Return the exact numbers, or None if a product can leave 63 bits with any settings."""
        return self._within_limits(self._signal.slope, _LARGEST_DIVISOR[self._value.divisor])

    def simple(self, esc: EscSettings) -> Scale | None:
        """Return the simplest numbers with the same results for these settings, or None."""
        if self._value.divisor is Divisor.CELLS:
            return None
        slope = self._signal.slope / _ratio(self._value.divisor, esc)
        has_limits = any(map(math.isfinite, self._signal.limits))
        is_single = self._signal.length == 32 and not self._signal.intercept and not has_limits
        # A number is rounded to 53 digits first. That error is half a unit of its last digit.
        digits = 24 if is_single else 53
        slack = Fraction(1, 1 << 30) if is_single else Fraction(0)
        largest = Fraction(1 << (126 if is_single else 1022))
        if abs(slope) < 1 / largest or abs(slope) * self._most > largest:
            return None  # not a normal number

        def is_good(other: Fraction) -> bool:
            return round_alike(slope, other, self._most, digits, slack)

        return self._within_limits(simplest(slope, is_good), (1, 1))

    def _within_limits(self, slope: Fraction, divisor: tuple[int, int]) -> Scale | None:
        by, over = divisor
        greatest = self._most * abs(slope.numerator) * over
        if max(greatest, slope.denominator * by) >= _LIMIT // 2:
            return None
        return Scale(slope.numerator, self._add, slope.denominator, 0)


def _ratio(divisor: Divisor, esc: EscSettings) -> Fraction:
    """Return the divisor of a value's steps with these settings."""
    if divisor is Divisor.ONE:
        return Fraction(1)
    return esc.pole_pairs * (esc.gear if divisor is Divisor.SHAFT else Fraction(1))


def _bits_of(number: float) -> int:
    """Return the bits of a double as a signed integer."""
    (bits,) = struct.unpack("<q", struct.pack("<d", number))
    return int(bits)


def _fitting_factor(
    row: Any,
    signal: SignalPlan,
    value: Value,
    esc: EscSettings,
) -> str:
    """Return a remedy with an almost equal factor that the core can express, or ""."""
    for factor in _rounded(signal.factor):
        ratio = signal.factor / factor
        other = replace(
            signal,
            factor=factor,
            slope=signal.slope * ratio,
            intercept=signal.intercept * ratio,
        )
        scale = _scale_of(row, other, value)
        if scale.exact() or scale.simple(esc):
            return f"Factor {_decimal(factor)} fits"
    return ""


def _rounded(factor: Fraction) -> Iterator[Fraction]:
    """Yield the factor with fewer and fewer digits, as long as it is almost the same."""
    for digits in _DIGITS:
        rounded = Fraction(f"{float(factor):.{digits}g}")
        if 0 < abs(rounded - factor) <= _ALIKE * abs(factor):
            yield rounded


def _decimal(number: Fraction) -> str:
    """Return a factor as it is written in a DBC."""
    return f"{float(number):.15g}"
