"""The simplest fraction rounds like the exact one for every input, and no simpler one does."""

import random
import struct
from fractions import Fraction
from functools import partial

import pytest

from kontronik_can_gw.native.simplest import Steps, round_alike, simplest

pytestmark = pytest.mark.promise("round-once")


def _results(slope: Fraction, intercept: Fraction, steps: Steps) -> list[int]:
    return [(slope * x + intercept).__floor__() for x in range(steps.low, steps.high + 1)]


def _has_intercept(slope: Fraction, results: list[int], low: int) -> bool:
    """Return True if this slope gives the results with some intercept."""
    rests = [result - slope * x for x, result in enumerate(results, low)]
    return max(rests) < min(rests) + 1


@pytest.mark.parametrize("seed", range(300))
def test_simplest_fraction_gives_the_same_integers(seed: int) -> None:
    chance = random.Random(seed)
    low = chance.randint(-30, 20)
    slope = Fraction(chance.randint(-500, 500), chance.randint(1, 300))
    intercept = Fraction(chance.randint(-50, 50), chance.randint(1, 30))
    steps = Steps(slope, intercept, low, low + chance.randint(0, 40))

    def is_good(other: Fraction) -> bool:
        first, end = steps.intercepts(other)
        return first < end

    found = simplest(slope, is_good)
    results = _results(slope, intercept, steps)
    first, end = steps.intercepts(found)
    assert _results(found, first, steps) == results
    assert _results(found, end, steps) != results
    for denominator in range(1, found.denominator):
        middle = (slope * denominator).__floor__()
        for numerator in range(middle - 3, middle + 5):
            other = Fraction(numerator, denominator)
            assert not _has_intercept(other, results, low), other


def _single(number: float) -> bytes:
    return struct.pack("<f", number)


def _is_alike(slope: Fraction, most: int, is_single: bool, other: Fraction) -> bool:
    if is_single:
        return round_alike(slope, other, most, 24, Fraction(1, 1 << 30))
    return round_alike(slope, other, most, 53)


@pytest.mark.parametrize("is_single", [True, False])
def test_simplest_fraction_gives_the_same_floats(is_single: bool) -> None:
    chance = random.Random(1)
    simpler = 0
    for _ in range(60):
        slope = Fraction(chance.randint(1, 10**17), 10 ** chance.randint(1, 17))
        most = chance.randint(1, 1000)
        found = simplest(slope, partial(_is_alike, slope, most, is_single))
        simpler += found != slope
        for x in range(most + 1):
            exact = x * slope.numerator / slope.denominator
            other = x * found.numerator / found.denominator
            if is_single:
                assert _single(exact) == _single(other)
            else:
                assert exact == other
    assert simpler > 30
