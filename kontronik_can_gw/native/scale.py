"""Factor and offset of a signal as numbers of the core in C.

It is proven for each signal that no product leaves 64 bits.
"""

import math
import struct
import sys
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from typing import Any

from kontronik_can_gw.esc.telemetry import MAX_COUNT, MAX_ENERGY
from kontronik_can_gw.esc.values import Divisor, Kind, Value
from kontronik_can_gw.native.header import KCG
from kontronik_can_gw.native.rows import MAX_GEAR, MAX_POLES, NotInCore
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
    Divisor.OUTPUT: (MAX_POLES * MAX_GEAR, MAX_GEAR),
    Divisor.CELLS: (255, 1),
}
_LIMIT = 1 << 63
_MAX_DIGITS = 15
"""Digits that a factor of a DBC has at most."""
_SMALLEST = Fraction(sys.float_info.min)
_LARGEST = Fraction(sys.float_info.max)
_MAX_POWER = 330
"""A factor that fits is searched within this power of ten."""


def set_scale(row: Any, signal: SignalPlan, value: Value) -> None:
    """Enter factor, offset and limits into a row.

    Raises NotInCore if a product can leave 64 bits. The message names a factor that fits.
    """
    if signal.is_float:
        set_one = _set_float_scale
        row.flags |= KCG.REAL
    else:
        set_one = _set_integer_scale
        if value.rolls:
            row.flags |= KCG.ROLLS
        if signal.saturates:
            row.flags |= KCG.SATURATES
        has_own_code = signal.error != signal.not_available
        if has_own_code and signal.low <= signal.not_available <= signal.high:
            row.flags |= KCG.CODE_AMID
        row.low = max(signal.low, -_LIMIT)
        row.high = min(signal.high, _LIMIT - 1)
    try:
        set_one(row, signal, value)
    except NotInCore as error:
        hint = _fitting_factor(row, signal, value, set_one)
        raise NotInCore(f"{error}.{hint}") from None


def _reduced(mul: int, add: int, div: int) -> tuple[int, int, int]:
    """Return smaller numbers for the same quotient floor((x * mul + add) / div)."""
    by = math.gcd(mul, add, div)
    return (
        mul // by,
        add // by,
        div // by,
    )


def _range(row: Any, value: Value) -> tuple[int, int]:
    """Return the smallest and the greatest number of steps, before they are divided."""
    if row.kind in (KCG.OF_LIVE, KCG.OF_INFO, KCG.OF_LAST):
        return _TYPE_RANGES[row.wire]
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


def _set_integer_scale(row: Any, signal: SignalPlan, value: Value) -> None:
    """Factor and offset of an integer signal. NotInCore if a product leaves 64 bits."""
    is_identity = signal.slope == 1 and signal.intercept == 0
    if value.divisor is Divisor.ONE and is_identity:
        row.flags |= KCG.PLAIN
        return
    if signal.numbers is not None:
        return
    common = signal.slope.denominator * signal.intercept.denominator
    mul = 2 * int(signal.slope * common)
    add = 2 * int(signal.intercept * common) + common  # plus one half: halves are rounded up
    mul, add, div = _reduced(mul, add, 2 * common)
    most = _most(row, signal, value, (mul, add, div))
    by, over = _LARGEST_DIVISOR[value.divisor]
    greatest = most * abs(mul) * over + abs(add) * by
    if greatest >= _LIMIT or div * by >= _LIMIT:
        raise NotInCore(f"factor {_decimal(signal.factor)} exceeds 64 bits")
    row.mul = mul
    row.add = add
    row.div = div
    row.most = most


def _most(
    row: Any,
    signal: SignalPlan,
    value: Value,
    scale: tuple[int, int, int],
) -> int:
    """Return the largest absolute number of steps that the core has to multiply.

    Beyond it, in either direction, the signal cannot hold the value, whatever the divisor is, and
    is Error. A counter that rolls over is never too large.
    """
    greatest = max(map(abs, _range(row, value)))
    mul, add, div = scale
    if value.rolls or not mul:
        return greatest
    by, _ = _LARGEST_DIVISOR[value.divisor]
    above = (signal.high + 1) * div - add
    below = add - signal.low * div
    first_too_large = by * max(0, above, below) // abs(mul) + 1
    return min(greatest, first_too_large)


def _set_float_scale(row: Any, signal: SignalPlan, value: Value) -> None:
    """Factor, offset and limits of a float signal. NotInCore if a product leaves 63 bits."""
    low, high = signal.limits
    row.low = _bits_of(low)
    row.high = _bits_of(high)
    by, over = _LARGEST_DIVISOR[value.divisor]
    mul = signal.slope.numerator
    div = signal.slope.denominator
    most = max(map(abs, _range(row, value)))
    greatest = most * abs(mul) * over
    if signal.numbers is None and max(greatest, div * by) >= _LIMIT // 2:
        raise NotInCore(f"factor {_decimal(signal.factor)} exceeds 63 bits")
    if signal.numbers is None:
        row.mul = mul
        row.div = div
    row.add = _bits_of(float(signal.intercept))
    if signal.intercept == 0:
        row.flags |= KCG.PLAIN


def _bits_of(number: float) -> int:
    """Return the bits of a double as a signed integer."""
    (bits,) = struct.unpack("<q", struct.pack("<d", number))
    return int(bits)


def _fitting_factor(
    row: Any,
    signal: SignalPlan,
    value: Value,
    set_one: Callable[..., None],
) -> str:
    """Return a hint with a factor that the core can express, or "".

    It has fewer digits. If no such factor fits, it is a coarser or a finer power of ten.
    """
    rounded = [f"{float(signal.factor):.{digits}g}" for digits in range(_MAX_DIGITS, 0, -1)]
    first = Fraction(rounded[-1])
    coarser = [first * 10**power for power in range(1, _MAX_POWER)]
    finer = [first / 10**power for power in range(1, _MAX_POWER)]
    for factor in (*map(Fraction, rounded), *coarser, *finer):
        if not _SMALLEST <= abs(factor) <= _LARGEST:
            continue  # no factor of a DBC, which is a float
        ratio = signal.factor / factor
        other = replace(
            signal,
            factor=factor,
            slope=signal.slope * ratio,
            intercept=signal.intercept * ratio,
        )
        try:
            set_one(type(row).from_buffer_copy(row), other, value)
        except (NotInCore, OverflowError):
            continue
        return f" Factor {_decimal(factor)} fits"
    return ""


def _decimal(number: Fraction) -> str:
    """Return a factor as it is written in a DBC."""
    return f"{float(number):.{_MAX_DIGITS}g}"
