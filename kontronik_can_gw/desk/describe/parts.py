"""What several parts of a description have in common: plain data that JSON can hold."""

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

from kontronik_can_gw.esc.decoder import ErrorBit

Facts = dict[str, Any]


def number(value: Fraction) -> int | float:
    return value.numerator if value.denominator == 1 else float(value)


def one_line(text: object) -> str:
    """A comment as one line."""
    return " ".join(str(text or "").split())


def value_table(texts: Mapping[int, str]) -> list[Facts]:
    """A value table: raw values and their names."""
    return [{"value": value, "name": texts[value]} for value in sorted(texts)]


def error(bit: ErrorBit) -> Facts:
    """What an error bit means. ``severity``: error, warning or status."""
    return {
        "name": bit.text,
        "severity": bit.severity.value,
        "meaning": bit.meaning,
        "remedy": bit.remedy,
    }
