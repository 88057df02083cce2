"""Parts of a capture's header that several modules read: numbers, texts, files and ESCs.

A header can be damaged or hostile, so every part is checked. The JSON form is described in
``assembly/capture_setup.py``.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from fractions import Fraction
from typing import Any

from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import (
    WRITTEN,
    EscSettings,
)

_UNUSABLE = (LookupError, TypeError, AttributeError, ValueError, ArithmeticError)
"""Errors of Python if a part of a header is missing or has another type."""
_MAX_NAME = 12
"""Maximum length of an ESC's name."""
LATEST_NS = 1 << 62
"""Largest time or duration in a header, in ns."""


class HeaderError(ValueError):
    """A header that no recorder has written. The text is for users."""


class _WrongValue(HeaderError):
    """The value and its rule, before the part of the header is known."""


@contextmanager
def reading(part: str) -> Iterator[None]:
    """Turn errors of Python into a HeaderError that names this part of the header."""
    try:
        yield
    except _WrongValue as error:
        raise HeaderError(f"{part} has {error}") from None
    except (HeaderError, UserError):
        raise
    except KeyError as error:
        raise HeaderError(f'{part} lacks "{str(error.args[0])[:40]}"') from None
    except _UNUSABLE:
        raise HeaderError(f"{part} has a value of the wrong type or form") from None


def whole_number(value: Any, low: int, high: int) -> int:
    """Return a number of a header. HeaderError if it is not a whole number in this range."""
    if isinstance(value, str) and len(value) < 20 and value.isdecimal():
        value = int(value)
    if type(value) is not int or not low <= value <= high:
        raise _WrongValue(f"{str(value)[:40]!r}, which is not a whole number from {low} to {high}")
    return value


def short_text(value: Any, longest: int) -> str:
    """Return a text of a header. HeaderError if it is too long or not printable."""
    if not isinstance(value, str) or len(value) > longest or not value.isprintable():
        raise _WrongValue(
            f"{str(value)[:40]!r}, which is not a text of at most {longest} characters"
        )
    return value


def file_bytes(text: str, part: str) -> bytes:
    """Return the bytes of a file that a header holds, one character a byte."""
    try:
        return text.encode("latin-1")
    except UnicodeEncodeError as error:
        character = text[error.start]
        raise HeaderError(
            f"{part}: the text of the file has {character!r}, "
            "but each character must fit in one byte"
        ) from None


def esc_json(esc: EscSettings) -> dict[str, Any]:
    """Return the JSON form of an ESC's settings."""
    found = {}
    for name, value in asdict(esc).items():
        found[name] = str(value) if isinstance(value, Fraction) else value
    return found


def esc_of(found: Mapping[str, Any]) -> EscSettings:
    """Read the settings of an ESC.

    They must be in the ranges of the configuration, or in those that a CANopen master may write.
    """
    numbers: dict[str, Any] = {}
    for name, limits in WRITTEN.items():
        if isinstance(getattr(EscSettings, name), Fraction):
            numbers[name] = _ratio(found[name], *limits)
        else:
            numbers[name] = whole_number(found[name], *limits)
    return EscSettings(
        name=short_text(found["name"], _MAX_NAME),
        # Captures of 0.5.0 name no protocol.
        protocol=protocol_named(found.get("protocol")).name,
        **numbers,
    )


def _ratio(text: str, low: int, high: int) -> Fraction:
    """Return a ratio such as "31/4". Both numbers are in the range."""
    numerator, _, denominator = text.partition("/")
    return Fraction(whole_number(numerator, low, high), whole_number(denominator or "1", low, high))
