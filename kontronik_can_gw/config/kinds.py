"""Kinds of configuration keys: what each accepts, as a check, as JSON Schema, and in a few words for the docs."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import field
from fractions import Fraction
from typing import Any, NamedTuple

from kontronik_can_gw.errors import did_you_mean


class Kind(NamedTuple):
    """What a key may hold."""

    span: str
    """The range in a few words."""
    schema: dict[str, Any]
    check: Callable[[Any], Any]
    """The value as it is used; ValueError says what is wrong with it."""


def key(kind: Kind, default: Any, doc: str) -> Any:
    """A row of a table: what it may hold, its default, its meaning."""
    metadata = {"kind": kind, "doc": doc}
    if isinstance(default, dict):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


def _boolean(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"{value!r} is not true or false")
    return value


def _ratio(value: Any) -> Fraction:
    try:
        if isinstance(value, bool) or (isinstance(value, str) and not re.fullmatch(_RATIO, value)):
            raise ValueError
        numerator, _, denominator = str(value).partition("/")
        ratio = Fraction(numerator) / Fraction(denominator or 1)
    except (ValueError, ZeroDivisionError):
        raise ValueError(f"{value!r} is neither a number nor 'numerator/denominator'") from None
    if not Fraction(1, 1000) <= ratio <= 1000:
        raise ValueError(f"{value} is outside 0.001..1000")
    return ratio


def _text(value: Any) -> str:
    if not isinstance(value, str) or not value.strip() or "\0" in value:
        raise ValueError(f"{value!r} is not a text")
    return value


def _names(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(n, str) and n.strip() for n in value):
        raise ValueError(f'{value!r} is not a list of names, as ["Motor_*"]')
    return tuple(value)


def _source(value: Any) -> Any:
    is_text = isinstance(value, str) and bool(value.strip())
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not is_text and not (is_number and math.isfinite(value)):
        raise ValueError(f"{value!r} is neither the name of a source nor a number")
    return value


def _table(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{value!r} is not a table")
    return value


def _bindings(value: Any) -> Any:
    flat: dict[str, Any] = {}
    for name, entry in _table(value).items():
        if isinstance(entry, dict):
            flat |= {f"{name}.{key}": inner for key, inner in entry.items()}
        else:
            flat[name] = entry
    return _SOURCES.check(flat)


def integer(low: int, high: int, also: int | None = None) -> Kind:
    """A whole number from ``low`` to ``high``, or ``also``, which is above."""
    schema: dict[str, Any] = {"type": "integer", "minimum": low, "maximum": high}
    span, limits = f"{low} … {high}", f"{low}..{high}"
    if also is not None:
        gap = {"exclusiveMinimum": high, "exclusiveMaximum": also}
        schema |= {"maximum": also, "not": gap}
        span, limits = f"{span}, {also}", f"{limits} and not {also}"

    def check(value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int):
            raise ValueError(f"{value!r} is not a whole number")
        if not low <= value <= high and value != also:
            raise ValueError(f"{value} is outside {limits}")
        return value

    return Kind(span, schema, check)


def number(low: float, high: float) -> Kind:
    """A number from ``low`` to ``high``."""

    def check(value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError(f"{value!r} is not a number")
        if not low <= value <= high:
            raise ValueError(f"{value} is outside {low}..{high}")
        return float(value)

    return Kind(f"{low} … {high}", {"type": "number", "minimum": low, "maximum": high}, check)


def choice(*choices: str) -> Kind:
    """One of a few texts."""
    return choice_of(lambda: choices)


def choice_of(known: Callable[[], Sequence[str]]) -> Kind:
    """One of a few texts that are asked for at each check: a list that may grow, as that of the devices."""

    def check(value: Any) -> str:
        choices, text = known(), _text(value)
        if text not in choices:
            near = did_you_mean(text, choices, 0.5, or_known=True)
            raise ValueError(f"{text!r} is none of {', '.join(choices)}.{near}")
        return text

    span = ", ".join(f'"{text}"' for text in known())
    return Kind(span, TEXT.schema | {"enum": list(known())}, check)


def meanings(known: Sequence[str]) -> Kind:
    """A table: for each text of the user's one of many that are known."""

    def check(value: Any) -> str:
        if value not in known:
            near = did_you_mean(str(value), known, 0.5, or_known=True)
            raise ValueError(f"{value!r} is none of those known here.{near}")
        return str(value)

    return table_of(Kind("meanings", {"enum": list(known)}, check))


def pattern(span: str, form: str, problem: str, longest: int | None = None) -> Kind:
    """A text of the form of a regular expression; ``problem`` follows another text in the error."""

    def check(value: Any) -> str:
        text = _text(value)
        if (longest is not None and len(text) > longest) or not re.fullmatch(form, text):
            raise ValueError(f"{text!r} {problem}")
        return text

    length = {} if longest is None else {"maxLength": longest}
    return Kind(span, {"type": "string", "pattern": f"^{form}$"} | length, check)


def table_of(kind: Kind) -> Kind:
    """A table with names of the user's, all entries of one kind."""

    def check(value: Any) -> dict[str, Any]:
        checked = {}
        for name, entry in _table(value).items():
            try:
                checked[name] = kind.check(entry)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from None
        return checked

    return Kind(kind.span, {"type": "object", "additionalProperties": kind.schema}, check)


def options(path: str, own: frozenset[str]) -> Kind:
    """A table of texts, numbers and booleans. ``own``: names that are keys of the table ``path``."""

    def check(value: Any) -> dict[str, Any]:
        entries = value.values() if isinstance(value, dict) else [None]
        if not all(isinstance(entry, (str, int, float)) for entry in entries):
            raise ValueError(f"{value!r} is not a table of texts, numbers and booleans")
        for name in sorted(own & set(value)):
            raise ValueError(f"{name} has its own key: {path}.{name}")
        return dict(value)

    schema = {
        "type": "object",
        "propertyNames": {"not": {"enum": sorted(own)}},
        "additionalProperties": {"type": ["string", "number", "boolean"]},
    }
    return Kind("options", schema, check)


_NOT_BLANK = {"type": "string", "pattern": r"\S"}
_RATIO = r"[0-9]+(\.[0-9]+)?(/[0-9]+(\.[0-9]+)?)?"
_RATIO_NUMBER = {"type": "number", "minimum": 0.001, "maximum": 1000}
_RATIO_TEXT = {"type": "string", "pattern": f"^{_RATIO}$"}
_SOURCES = table_of(Kind("bindings", {"anyOf": [_NOT_BLANK, {"type": "number"}]}, _source))
_SIGNAL_OR_MESSAGE = {"anyOf": [_SOURCES.schema["additionalProperties"], _SOURCES.schema]}

BOOLEAN = Kind("boolean", {"type": "boolean"}, _boolean)
RATIO = Kind("ratio", {"anyOf": [_RATIO_NUMBER, _RATIO_TEXT]}, _ratio)
TEXT = Kind("string", {"type": "string", "pattern": r"^[^\x00]*[^\x00\s][^\x00]*$"}, _text)
NAMES = Kind("names", {"type": "array", "items": _NOT_BLANK}, _names)
BINDINGS = Kind(
    "bindings", {"type": "object", "additionalProperties": _SIGNAL_OR_MESSAGE}, _bindings
)
"""Sources by signal; ``Message.Signal = x`` without quotes is a nested table in TOML."""

_PORT = "(6553[0-5]|655[0-2][0-9]|65[0-4][0-9]{2}|6[0-4][0-9]{3}|[1-5][0-9]{4}|[1-9][0-9]{0,3})"
BROKER = pattern(
    "broker",
    rf"([A-Za-z0-9]([A-Za-z0-9._-]*[A-Za-z0-9])?|\[[0-9A-Fa-f:.]*:[0-9A-Fa-f:.]*\])(:{_PORT})?",
    "is not a broker, as broker.example, 192.168.1.5:1883 or [fe80::1]:1883",
    longest=200,
)
TOPIC = pattern(
    "topic",
    r"[^\s\x00+#/$][^\x00-\x1f\x7f+#/]*(/[^\x00-\x1f\x7f+#/]+){0,7}",
    "is not the beginning of topics, as kontronik or fleet/north: no + and #, no / at the ends",
    longest=200,
)
LEVEL = pattern(
    "level", "[A-Za-z0-9_-]{1,64}", "is not a name of 1 to 64 letters, digits, _ and -", 200
)
NODE_NAME = pattern(
    "string",
    r"[a-z0-9_-]+(\.[a-z0-9_-]+)*",
    "is not a name of small letters, digits, - and _, with dots in between, of at most 60",
    longest=60,
)
ESC_NAME = pattern(
    "string",
    "[A-Za-z][A-Za-z0-9_]{0,11}",
    "is not a name of 1 to 12 letters, digits and underscores that begins with a letter",
)
