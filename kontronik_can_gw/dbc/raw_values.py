"""Raw values of a signal: their range, numbers as they stand in the file, constants as bits."""

import math
import struct
from fractions import Fraction
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cantools.database.can import Signal

_LARGEST_FLOAT = int(struct.unpack("<f", b"\xff\xff\x7f\x7f")[0])


def raw_range(signal: "Signal") -> tuple[int, int]:
    """The smallest and the largest whole number in the signal's bits."""
    length = signal.length
    if signal.is_signed:
        return -(1 << length - 1), (1 << length - 1) - 1
    return 0, (1 << length) - 1


def is_raw(value: Any, low: int, high: int) -> bool:
    """True for a whole number within the raw range."""
    return (
        isinstance(value, (int, float))
        and math.isfinite(value)
        and value == int(value)
        and low <= value <= high
    )


def exact(number: Any) -> Fraction:
    """The decimal number in the file, not the float nearest to it."""
    return Fraction(repr(number)) if isinstance(number, float) else Fraction(number)


def text(value: Fraction) -> str:
    """A number for people."""
    return f"{float(value):.10g}"


def float_bits(number: float, length: int) -> int:
    """The bits of a float of 32 or 64 bits. OverflowError where it is too large."""
    return int.from_bytes(struct.pack("<f" if length == 32 else "<d", number), "little")


def is_float_of(number: int, length: int) -> bool:
    """True where a float of 32 or 64 bits holds a number of this size."""
    return length != 32 or abs(number) <= _LARGEST_FLOAT


def constant(signal: "Signal", value: float, factor: Fraction, offset: Fraction) -> int | None:
    """The raw bits of a constant physical value; None where the signal cannot hold it (floats are rounded)."""
    if not math.isfinite(value):
        return None
    raw = (exact(value) - offset) / factor
    if signal.is_float:
        try:
            return float_bits(float(raw), signal.length)
        except OverflowError:
            return None
    low, high = raw_range(signal)
    return int(raw) if raw.denominator == 1 and low <= raw <= high else None


def limits(
    signal: "Signal", factor: Fraction, offset: Fraction
) -> tuple[Fraction, Fraction] | None:
    """Minimum and maximum of the file as raw values; None where it gives none: [0|0]."""
    if signal.minimum is None or signal.maximum is None or signal.minimum == signal.maximum == 0:
        return None
    ends = sorted((exact(end) - offset) / factor for end in (signal.minimum, signal.maximum))
    return ends[0], ends[1]
