"""Raw values of a signal: bits, range, exact numbers of the file, constants, value tables."""

import math
from fractions import Fraction
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.esc.values import Value
from kontronik_can_gw.signals.packer import float_bits
from kontronik_can_gw.signals.plan import Piece

if TYPE_CHECKING:
    from cantools.database.can import Signal

_NOT_AVAILABLE = frozenset({"notavailable", "sna", "na", "signalnotavailable"})
_ERROR = frozenset({"error", "err", "invalid"})
_CODES = _NOT_AVAILABLE | _ERROR


class ValueTable:
    """The value table of a signal: texts of values, and codes for "not available" and "error"."""

    def __init__(self, signal: "Signal") -> None:
        self.entries: dict[int, str] = {}
        self.codes: dict[str, int] = {}
        """Raw values by normalized text."""
        for raw, text in (signal.choices or {}).items():
            self.entries[int(raw)] = str(text)
            self.codes[normalize(str(text))] = int(raw)
        self.not_available = self._first(_NOT_AVAILABLE)
        self.error = self._first(_ERROR)
        self.special: list[int] = []
        """Raw values that are codes."""
        self.texts: dict[int, str] = {}
        """Entries that are values."""
        for raw, text in self.entries.items():
            if normalize(text) in _CODES:
                self.special.append(raw)
            else:
                self.texts[raw] = text

    def numbers(self, value: Value) -> dict[int, int]:
        """Return the raw value of each number of an enumeration whose text is in the table."""
        found = {}
        for number, text in value.names.items():
            key = normalize(text)
            if key in self.codes:
                found[number] = self.codes[key]
        return found

    def _first(self, texts: frozenset[str]) -> int | None:
        for text, raw in self.codes.items():
            if text in texts:
                return raw
        return None


@lru_cache(maxsize=1024)
def pieces(start: int, length: int, byte_order: str) -> tuple[Piece, ...]:
    """Return the bits of a signal as runs of adjacent bits.

    Signals with the same place share one object.
    """
    if byte_order == "little_endian":
        return (Piece(0, length, start),)
    # big-endian: start is the most significant bit; bits continue downward, then in the next byte
    found = []
    while length:
        width = min(length, start % 8 + 1)
        length -= width
        found.append(Piece(length, width, start - width + 1))
        start = start // 8 * 8 + 15  # the most significant bit of the next byte
    return tuple(reversed(found))


def raw_range(signal: "Signal") -> tuple[int, int]:
    """Return the smallest and the largest whole number in the signal's bits."""
    length = signal.length
    if signal.is_signed:
        half = 1 << length - 1
        return -half, half - 1
    return 0, (1 << length) - 1


@lru_cache(maxsize=1024)
def exact(number: Any) -> Fraction:
    """Return the decimal number in the file, not the nearest float."""
    return Fraction(repr(number)) if isinstance(number, float) else Fraction(number)


def text(value: Fraction) -> str:
    """Return a number for people."""
    return f"{float(value):.10g}"


def constant(
    signal: "Signal",
    value: float,
    factor: Fraction,
    offset: Fraction,
) -> int | None:
    """Return the raw bits of a constant physical value. Floats are rounded.

    None if the signal cannot contain the value.
    """
    if not math.isfinite(value):
        return None
    raw = (exact(value) - offset) / factor
    if signal.is_float:
        return float_bits(raw, signal.length)
    low, high = raw_range(signal)
    if raw.denominator != 1 or not low <= raw <= high:
        return None
    return int(raw)


def limits(
    signal: "Signal",
    factor: Fraction,
    offset: Fraction,
) -> tuple[Fraction, Fraction] | None:
    """Return minimum and maximum of the file as raw values.

    None if the file has no limits, which is written as [0|0].
    """
    minimum = signal.minimum
    maximum = signal.maximum
    if minimum is None or maximum is None or minimum == maximum == 0:
        return None
    low = (exact(minimum) - offset) / factor
    high = (exact(maximum) - offset) / factor
    return min(low, high), max(low, high)
