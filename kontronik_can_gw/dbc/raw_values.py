"""Raw values of a signal: their bits, their range, numbers as they stand in the file, constants, the codes in a value table."""

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


class ValueTable:
    """The value table of a signal: texts of values, codes for "not available" and "error"."""

    def __init__(self, signal: "Signal") -> None:
        self.entries = {int(raw): str(text) for raw, text in (signal.choices or {}).items()}
        self.codes = {normalize(text): raw for raw, text in self.entries.items()}
        """Raw values by normalized text."""
        self.not_available = self._first(_NOT_AVAILABLE)
        self.error = self._first(_ERROR)
        self.special = [raw for text, raw in self.codes.items() if text in _NOT_AVAILABLE | _ERROR]
        """Raw values that are codes and no values."""
        self.texts = {
            raw: text
            for raw, text in self.entries.items()
            if normalize(text) not in _NOT_AVAILABLE | _ERROR
        }
        """Entries that are values."""

    def numbers(self, value: Value) -> dict[int, int]:
        """Numbers of an enumeration to the raw values of their texts."""
        keys = {number: normalize(text) for number, text in value.names.items()}
        return {number: self.codes[key] for number, key in keys.items() if key in self.codes}

    def _first(self, texts: frozenset[str]) -> int | None:
        return next((raw for text, raw in self.codes.items() if text in texts), None)


@lru_cache(maxsize=1024)
def pieces(start: int, length: int, byte_order: str) -> tuple[Piece, ...]:
    """The bits of a signal as runs of adjacent ones; of signals at the same place one and the same object."""
    if byte_order == "little_endian":
        return (Piece(0, length, start),)
    # big-endian: start is the most significant bit, downward within a byte, then the next byte
    found = []
    while length:
        width = min(length, start % 8 + 1)
        length -= width
        found.append(Piece(length, width, start - width + 1))
        start = start // 8 * 8 + 15
    return tuple(reversed(found))


def raw_range(signal: "Signal") -> tuple[int, int]:
    """The smallest and the largest whole number in the signal's bits."""
    length = signal.length
    if signal.is_signed:
        return -(1 << length - 1), (1 << length - 1) - 1
    return 0, (1 << length) - 1


@lru_cache(maxsize=1024)
def exact(number: Any) -> Fraction:
    """The decimal number in the file, not the float nearest to it."""
    return Fraction(repr(number)) if isinstance(number, float) else Fraction(number)


def text(value: Fraction) -> str:
    """A number for people."""
    return f"{float(value):.10g}"


def constant(signal: "Signal", value: float, factor: Fraction, offset: Fraction) -> int | None:
    """The raw bits of a constant physical value; None where the signal cannot hold it (floats are rounded)."""
    if not math.isfinite(value):
        return None
    raw = (exact(value) - offset) / factor
    if signal.is_float:
        return float_bits(raw, signal.length)
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
