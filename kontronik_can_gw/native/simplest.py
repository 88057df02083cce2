"""Simple fractions that round like an exact one for every input of a range.

A DBC's factor and its unit can give a slope whose numerator and denominator leave 64 bits. The core
in C then computes with the simplest fraction that gives the same result for each possible input.
"""

from collections.abc import Callable
from fractions import Fraction
from typing import NamedTuple


class Steps(NamedTuple):
    """The integers ``floor(x * slope + intercept)`` for the integers x from low to high."""

    slope: Fraction
    intercept: Fraction
    low: int
    high: int

    def intercepts(self, slope: Fraction) -> tuple[Fraction, Fraction]:
        """Return the limits of an intercept with which another slope gives the same integers.

        The first limit is included, and the second one is not. If the first is not less than the
        second, this slope gives other integers with every intercept.
        """
        begin = self.slope * self.low + self.intercept
        divisor = self.slope.denominator * begin.denominator
        line = (
            self.high - self.low + 1,
            divisor,
            int(self.slope * divisor),
            int(begin * divisor),
        )
        over = slope.numerator
        under = slope.denominator
        lowest = _largest(-over, under, *line)
        highest = under - _largest(over, -under, *line)
        shift = slope * self.low
        return Fraction(lowest, under) - shift, Fraction(highest, under) - shift


def simplest(slope: Fraction, is_good: Callable[[Fraction], bool]) -> Fraction:
    """Return the fraction with the smallest denominator for which ``is_good`` is true.

    The good fractions must form an interval that contains ``slope``. The candidates are the
    convergents and semiconvergents of the slope's continued fraction. Within one term they approach
    the slope from one side, so the first good one is found by bisection.
    """
    sign = -1 if slope < 0 else 1
    numerator = abs(slope.numerator)
    denominator = slope.denominator
    before = (0, 1)
    last = (1, 0)
    first = 0
    while denominator:
        term, rest = divmod(numerator, denominator)
        numerator = denominator
        denominator = rest

        def candidate(
            count: int,
            before: tuple[int, int] = before,
            last: tuple[int, int] = last,
        ) -> Fraction:
            return Fraction(sign * (before[0] + count * last[0]), before[1] + count * last[1])

        if is_good(candidate(term)):
            below = first - 1
            good = term
            while good - below > 1:
                middle = (below + good) // 2
                if is_good(candidate(middle)):
                    good = middle
                else:
                    below = middle
            return candidate(good)
        following = (before[0] + term * last[0], before[1] + term * last[1])
        before = last
        last = following
        first = 1
    return slope


def round_alike(
    slope: Fraction,
    other: Fraction,
    most: int,
    digits: int,
    slack: Fraction = Fraction(0),
) -> bool:
    """Return True if both slopes give equal floats for the integers from ``-most`` to ``most``.

    Both are rounded to ``digits`` binary digits. ``slack`` is the largest error of an earlier
    rounding, in units of the last digit. False is also returned if ``other`` is nearer to 0.
    """
    slope = abs(slope)
    other = abs(other)
    if not 0 < slope <= other:
        return False
    exponent = _exponent(slope * most)
    low = most + 1
    while low > 1:
        high = low - 1
        low = max(1, -(-_power(exponent) // slope))
        unit = _power(exponent - digits + 1)
        for sign in (1, -1):
            # Each number at which the result changes is a step of one of these two lines.
            steps = Steps(sign * slope / unit, Fraction(1, 2) + slack, low, high)
            first, end = steps.intercepts(sign * other / unit)
            if not first <= steps.intercept < end:
                return False
        exponent -= 1
    return True


def _largest(
    factor: int,
    step: int,
    count: int,
    divisor: int,
    slope: int,
    intercept: int,
) -> int:
    """Return the largest ``factor * x + step * ((slope * x + intercept) // divisor)``.

    x is from 0 to ``count - 1``, and factor and step have different signs. As in Euclid's
    algorithm, x and the quotient change their roles until the quotient is constant.
    """
    found = step * (intercept // divisor)
    base = 0
    while True:
        whole, slope = divmod(slope, divisor)
        factor += step * whole
        whole, intercept = divmod(intercept, divisor)
        base += step * whole
        jumps = (slope * (count - 1) + intercept) // divisor
        found = max(found, base, base + factor * (count - 1) + step * jumps)
        if not jumps or (factor >= 0) == (step >= 0) or not factor or not step:
            return found
        if factor < 0:  # the best x are those at which the quotient has just increased
            base += factor + step
        count = jumps
        intercept = divisor - intercept - 1
        factor, step = step, factor
        slope, divisor = divisor, slope


def _exponent(number: Fraction) -> int:
    """Return the largest integer e with 2**e <= number."""
    found = number.numerator.bit_length() - number.denominator.bit_length()
    return found if _power(found) <= number else found - 1


def _power(exponent: int) -> Fraction:
    return Fraction(1 << exponent) if exponent >= 0 else Fraction(1, 1 << -exponent)
