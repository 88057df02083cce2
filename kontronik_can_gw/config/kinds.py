"""Kinds of configuration keys: what each accepts, as JSON Schema and as a check of it, and in a few words for the docs."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import field
from fractions import Fraction
from typing import Any, NamedTuple

from kontronik_can_gw.errors import did_you_mean

_TYPES: dict[str, tuple[type | tuple[type, ...], str]] = {
    "boolean": (bool, "true or false"),
    "integer": (int, "a whole number"),
    "number": ((int, float), "a number"),
    "string": (str, "a text"),
    "object": (dict, "a table"),
}


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


def _typed(value: Any, name: str) -> Any:
    kind, words = _TYPES[name]
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise ValueError(f"{value!r} is not {words}")
    return value


def _plain(span: str, problem: str = "", **schema: Any) -> Kind:
    """A value of one JSON type within its limits or of its form; ``problem`` follows another value in the error."""
    low, high = schema.get("minimum", -math.inf), schema.get("maximum", math.inf)
    gap = schema.get("not", {"exclusiveMinimum": math.inf, "exclusiveMaximum": 0})
    form, longest = schema.get("pattern", ""), schema.get("maxLength", math.inf)

    def check(value: Any) -> Any:
        _typed(value, schema["type"])
        if schema["type"] == "string":
            is_right = len(value) <= longest and re.fullmatch(form, value)
        else:
            in_gap = gap["exclusiveMinimum"] < value < gap["exclusiveMaximum"]
            is_right = low <= value <= high and not in_gap
        if not is_right:
            raise ValueError(f"{value!r} {problem}")
        return value

    return Kind(span, schema, check)


def integer(low: int, high: int, also: int | None = None) -> Kind:
    """A whole number from ``low`` to ``high``, or ``also``, which is above."""
    schema: dict[str, Any] = {"type": "integer", "minimum": low, "maximum": also or high}
    span, problem = f"{low} … {high}", f"is outside {low}..{high}"
    if also is not None:
        schema["not"] = {"exclusiveMinimum": high, "exclusiveMaximum": also}
        span, problem = f"{span}, {also}", f"{problem} and not {also}"
    return _plain(span, problem, **schema)


def number(low: float, high: float) -> Kind:
    """A number from ``low`` to ``high``."""
    problem = f"is outside {low}..{high}"
    return _plain(f"{low} … {high}", problem, type="number", minimum=low, maximum=high)


def pattern(span: str, form: str, problem: str, **limits: int) -> Kind:
    """A text of the form of a regular expression; ``problem`` follows another text in the error."""
    return _plain(span, problem, type="string", pattern=f"^{form}$", **limits)


def choice(*choices: str) -> Kind:
    """One of a few texts."""
    return choice_of(lambda: choices)


def choice_of(known: Callable[[], Sequence[str]], span: str = "") -> Kind:
    """One of a few texts that are asked for at each check: a list that may grow, as that of the devices."""

    def check(value: Any) -> str:
        if (text := _typed(value, "string")) not in known():
            near = did_you_mean(text, known(), 0.5, or_known=True)
            raise ValueError(f"{text!r} is not known here.{near}")
        return str(text)

    span = span or ", ".join(f'"{text}"' for text in known())
    return Kind(span, {"type": "string", "enum": list(known())}, check)


def meanings(known: Sequence[str]) -> Kind:
    """A table: for each text of the user's one of many that are known."""
    return table_of(choice_of(lambda: known, "meanings"))


def table_of(kind: Kind) -> Kind:
    """A table with names of the user's, all entries of one kind."""

    def check(value: Any) -> dict[str, Any]:
        checked = {}
        for name, entry in _typed(value, "object").items():
            try:
                checked[name] = kind.check(entry)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from None
        return checked

    return Kind(kind.span, {"type": "object", "additionalProperties": kind.schema}, check)


def options(path: str, own: frozenset[str]) -> Kind:
    """A table of texts, numbers and booleans. ``own``: names that are keys of the table ``path``."""

    def entry(value: Any) -> Any:
        if not isinstance(value, (str, int, float)):
            raise ValueError(f"{value!r} is not a text, a number or a boolean")
        return value

    kind = table_of(Kind("options", {"type": ["string", "number", "boolean"]}, entry))

    def check(value: Any) -> Any:
        checked = kind.check(value)
        for name in sorted(own & set(checked)):
            raise ValueError(f"{name} has its own key: {path}.{name}")
        return checked

    return Kind(kind.span, kind.schema | {"propertyNames": {"not": {"enum": sorted(own)}}}, check)


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


def _names(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list):
        raise ValueError(f'{value!r} is not a list of names, as ["Motor_*"]')
    return tuple(TEXT.check(name) for name in value)


def _source(value: Any) -> Any:
    if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
        return value
    if isinstance(value, str):
        return TEXT.check(value)
    raise ValueError(f"{value!r} is neither the name of a source nor a number")


def _bindings(value: Any) -> Any:
    flat: dict[str, Any] = {}
    for name, entry in _typed(value, "object").items():
        nested = entry if isinstance(entry, dict) else None
        flat |= {name: entry} if nested is None else {f"{name}.{n}": e for n, e in nested.items()}
    return _SOURCES.check(flat)


BOOLEAN = _plain("boolean", type="boolean")
TEXT = pattern("string", r"[^\x00]*[^\x00\s][^\x00]*", "is not a text")
_RATIO = r"[0-9]+(\.[0-9]+)?(/[0-9]+(\.[0-9]+)?)?"
_RATIO_NUMBER = {"type": "number", "minimum": 0.001, "maximum": 1000}
_RATIO_TEXT = {"type": "string", "pattern": f"^{_RATIO}$"}
RATIO = Kind("ratio", {"anyOf": [_RATIO_NUMBER, _RATIO_TEXT]}, _ratio)
NAMES = Kind("names", {"type": "array", "items": TEXT.schema}, _names)
_SOURCES = table_of(Kind("bindings", {"anyOf": [TEXT.schema, {"type": "number"}]}, _source))
_SIGNAL_OR_MESSAGE = {"anyOf": [_SOURCES.schema["additionalProperties"], _SOURCES.schema]}
BINDINGS = Kind(
    "bindings", {"type": "object", "additionalProperties": _SIGNAL_OR_MESSAGE}, _bindings
)
"""Sources by signal; ``Message.Signal = x`` without quotes is a nested table in TOML."""

_PORT = "(6553[0-5]|655[0-2][0-9]|65[0-4][0-9]{2}|6[0-4][0-9]{3}|[1-5][0-9]{4}|[1-9][0-9]{0,3})"
BROKER = pattern(
    "broker",
    rf"([A-Za-z0-9]([A-Za-z0-9._-]*[A-Za-z0-9])?|\[[0-9A-Fa-f:.]*:[0-9A-Fa-f:.]*\])(:{_PORT})?",
    "is not a broker, as broker.example, 192.168.1.5:1883 or [fe80::1]:1883",
    maxLength=200,
)
TOPIC = pattern(
    "topic",
    r"[^\s\x00+#/$][^\x00-\x1f\x7f+#/]*(/[^\x00-\x1f\x7f+#/]+){0,7}",
    "is not the beginning of topics, as kontronik or fleet/north: no + and #, no / at the ends",
    maxLength=200,
)
LEVEL = pattern("level", "[A-Za-z0-9_-]{1,64}", "is not a name of 1 to 64 letters, digits, _ and -")
NODE_NAME = pattern(
    "string",
    r"[a-z0-9_-]+(\.[a-z0-9_-]+)*",
    "is not a name of small letters, digits, - and _, with dots in between, of at most 60",
    maxLength=60,
)
ESC_NAME = pattern(
    "string",
    "[A-Za-z][A-Za-z0-9_]{0,11}",
    "is not a name of 1 to 12 letters, digits and underscores that begins with a letter",
)
