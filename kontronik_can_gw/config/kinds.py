"""Kinds of configuration keys: a check, a JSON Schema and a range in words for each."""

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import field
from fractions import Fraction
from functools import partial
from typing import Any, NamedTuple

from kontronik_can_gw.errors import did_you_mean

_TYPES: dict[str, tuple[type | tuple[type, ...], str]] = {
    "boolean": (bool, "true or false"),
    "integer": (int, "an integer"),
    "number": ((int, float), "a number"),
    "string": (str, "a string"),
    "object": (dict, "a table"),
}


class KeyKind(NamedTuple):
    """The values that a key accepts."""

    span: str
    """The range in a few words."""
    schema: dict[str, Any]
    """The accepted values as JSON Schema."""
    check: Callable[[Any], Any]
    """Maps a value from TOML to the value in use, or raises ValueError with the mistake."""


def key(kind: KeyKind, default: Any, doc: str) -> Any:
    """Return the row of a table for one key: its kind, default and meaning."""
    metadata = {"kind": kind, "doc": doc}
    if isinstance(default, dict):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


_LONGEST = 200
"""Number of characters after which a value in an error is cut."""


def toml_of(value: Any) -> str:
    """Return a value as it is written in TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Fraction):
        decimal = repr(float(value))
        is_exact = Fraction(decimal) == value
        return decimal if is_exact else f'"{value}"'
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(map(toml_of, value))}]"
    if isinstance(value, Mapping):
        pairs = [f"{key_of(name)} = {toml_of(entry)}" for name, entry in value.items()]
        return f"{{ {', '.join(pairs)} }}" if pairs else "{}"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return str(value)


def key_of(name: str) -> str:
    """Return a key as it is written in TOML, in quotes if it needs them."""
    return name if re.fullmatch("[A-Za-z0-9_-]+", name) else toml_of(name)


def shown(value: Any) -> str:
    """Return a value as TOML for an error, cut after 200 characters."""
    text = toml_of(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…"


def _check_type(value: Any, name: str, span: str = "") -> Any:
    """Return the value if it has this JSON type. In Python a bool is an int, in JSON it is not.

    In the error, ``span`` is the accepted range.
    """
    expected, words = _TYPES[name]
    is_stray_bool = isinstance(value, bool) and expected is not bool
    if is_stray_bool or not isinstance(value, expected):
        text = f"{shown(value)} is not {words}"
        if span:
            text += f", {span}"
        if name == "string" and isinstance(value, (int, float)):
            text += f'. Write it in quotes: "{toml_of(value)}"'
        raise ValueError(text)
    return value


def _plain(span: str, problem: str = "", limits: str = "", **schema: Any) -> KeyKind:
    """Return the kind that a JSON Schema of one type describes.

    In the error, ``problem`` follows a refused value, and ``limits`` the name of the type.
    """
    low = schema.get("minimum", -math.inf)
    high = schema.get("maximum", math.inf)
    gap = schema.get("not", {"exclusiveMinimum": math.inf, "exclusiveMaximum": 0})
    form = schema.get("pattern", "")
    longest = schema.get("maxLength", math.inf)

    def check(value: Any) -> Any:
        _check_type(value, schema["type"], limits)
        if schema["type"] == "string":
            is_valid = len(value) <= longest and re.fullmatch(form, value)
        else:
            is_in_gap = gap["exclusiveMinimum"] < value < gap["exclusiveMaximum"]
            is_valid = low <= value <= high and not is_in_gap
        if not is_valid:
            raise ValueError(f"{shown(value)} {problem}")
        return value

    return KeyKind(span, schema, check)


def number(
    low: float, high: float, unit: str = "", also: float | None = None, name: str = "number"
) -> KeyKind:
    """Accept a number of a JSON type from ``low`` to ``high``, or the other number ``also``."""
    span = f"{low} … {high} {unit}".rstrip()
    limits = f"{low} to {high} {unit}".rstrip()
    problem = f"is outside {limits}"
    schema: dict[str, Any] = {"type": name, "minimum": low, "maximum": high}
    if also is not None:
        schema |= {"minimum": min(low, also), "maximum": max(high, also)}
        schema["not"] = {"exclusiveMinimum": min(high, also), "exclusiveMaximum": max(low, also)}
        span = f"{span}, {also}"
        problem = f"is neither {limits} nor {also}"
        limits = f"{limits} or {also}"
    return _plain(span, problem, limits, **schema)


integer = partial(number, name="integer")


def integer_or_list(low: int, high: int, length: int) -> KeyKind:
    """Accept a whole number from ``low`` to ``high``, or a list of ``length`` such numbers."""
    one = integer(low, high)

    def check(value: Any) -> int | tuple[int, ...]:
        if not isinstance(value, list):
            found: int = one.check(value)
            return found
        if len(value) != length:
            raise ValueError(f"{shown(value)} is not a list of {length} numbers")
        return tuple(one.check(entry) for entry in value)

    numbers = {"type": "array", "items": one.schema, "minItems": length, "maxItems": length}
    return KeyKind(f"{one.span}, or lists of {length}", {"anyOf": [one.schema, numbers]}, check)


def list_of(kind: KeyKind, span: str, example: str) -> KeyKind:
    """Accept a list whose entries are all of one kind. Mistakes of all entries are reported.

    ``example`` follows "is not a list of" in the error.
    """

    def check(value: Any) -> tuple[Any, ...]:
        if not isinstance(value, list):
            raise ValueError(f"{shown(value)} is not a list of {example}")
        checked = []
        problems = []
        for entry in value:
            try:
                checked.append(kind.check(entry))
            except ValueError as error:
                problems.append(str(error))
        if problems:
            raise ValueError("; ".join(problems).replace("?; ", "? "))
        return tuple(checked)

    return KeyKind(span, {"type": "array", "items": kind.schema}, check)


def pattern(
    span: str,
    form: str,
    problem: str,
    **limits: int,
) -> KeyKind:
    """Accept a text that matches the regular expression ``form``.

    In the error, ``problem`` follows the refused text.
    """
    schema: dict[str, Any] = {"type": "string", "pattern": f"^{form}$", **limits}
    return _plain(span, problem, **schema)


def choice(*choices: str) -> KeyKind:
    """Accept one of these texts."""
    return choice_of(lambda: choices)


def choice_of(known: Callable[[], Sequence[str]], span: str = "") -> KeyKind:
    """Accept one of the texts that ``known`` returns at each check.

    The list may grow after import, as the list of devices does with another ESC protocol.
    """

    def check(value: Any) -> str:
        text = _check_type(value, "string")
        if text not in known():
            near = did_you_mean(text, known(), or_known=True)
            raise ValueError(f"unknown value {shown(text)}.{near}")
        return str(text)

    span = span or ", ".join(f'"{text}"' for text in known())
    return KeyKind(span, {"type": "string", "enum": list(known())}, check)


def meanings(known: Sequence[str]) -> KeyKind:
    """Accept a table that maps each of the user's texts to one of the known texts."""
    return table_of(choice_of(lambda: known, "strings"))


def table_of(kind: KeyKind) -> KeyKind:
    """Accept a table with any names, whose entries are all of one kind."""

    def check(value: Any) -> dict[str, Any]:
        checked = {}
        for name, entry in _check_type(value, "object").items():
            try:
                checked[name] = kind.check(entry)
            except ValueError as error:
                raise ValueError(f"{key_of(name)}: {error}") from None
        return checked

    span = f"table of {kind.span}"
    return KeyKind(span, {"type": "object", "additionalProperties": kind.schema}, check)


def options(path: str, own: frozenset[str]) -> KeyKind:
    """Accept a table of texts, numbers and booleans.

    Refuses the names in ``own``, which are keys of the table ``path``.
    """

    def entry(value: Any) -> Any:
        if not isinstance(value, (str, int, float)):
            raise ValueError(f"{shown(value)} is not a string, a number or a boolean")
        return value

    of_entry = {"type": ["string", "number", "boolean"]}
    kind = table_of(KeyKind("strings, numbers or booleans", of_entry, entry))

    def check(value: Any) -> Any:
        checked = kind.check(value)
        misplaced = sorted(own & set(checked))
        if misplaced:
            name = misplaced[0]
            raise ValueError(f"{name} cannot be set here. Use {path}.{name}.")
        return checked

    schema = kind.schema | {"propertyNames": {"not": {"enum": sorted(own)}}}
    return KeyKind(kind.span, schema, check)


def _check_ratio(value: Any) -> Fraction:
    try:
        is_wrong_text = isinstance(value, str) and not re.fullmatch(_RATIO, value)
        if isinstance(value, bool) or is_wrong_text:
            raise ValueError
        numerator, _, denominator = str(value).partition("/")
        ratio = Fraction(numerator) / Fraction(denominator or 1)
    except (ValueError, ZeroDivisionError):
        raise ValueError(
            f'{shown(value)} is neither a number, 0.001 to 1000, nor "numerator/denominator"'
        ) from None
    if not Fraction(1, 1000) <= ratio <= 1000:
        raise ValueError(f"{shown(value)} is outside 0.001 to 1000")
    return ratio


def _check_source(value: Any) -> Any:
    if isinstance(value, str):
        return TEXT.check(value)
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if is_number and math.isfinite(value):
        return value
    raise ValueError(f"{shown(value)} is neither the name of a source nor a number")


def _check_bindings(value: Any) -> Any:
    """Return sources by "Signal" or "Message.Signal".

    In TOML, ``Message.Signal = x`` without quotes is a nested table.
    """
    flat: dict[str, Any] = {}
    for name, entry in _check_type(value, "object").items():
        if isinstance(entry, dict):
            flat |= {f"{name}.{signal}": source for signal, source in entry.items()}
        else:
            flat[name] = entry
    return _SOURCES.check(flat)


BOOLEAN = _plain("boolean", type="boolean")
TEXT = pattern("string", r"[^\x00]*[^\x00\s][^\x00]*", "is blank or contains a NUL character")
_RATIO = r"[0-9]+(\.[0-9]+)?(/[0-9]+(\.[0-9]+)?)?"
_RATIO_NUMBER = {"type": "number", "minimum": 0.001, "maximum": 1000}
_RATIO_TEXT = {"type": "string", "pattern": f"^{_RATIO}$"}
RATIO = KeyKind("0.001 … 1000", {"anyOf": [_RATIO_NUMBER, _RATIO_TEXT]}, _check_ratio)
NAMES = list_of(TEXT, "list of strings", 'names such as ["Motor_*"]')
_SOURCES = table_of(
    KeyKind("sources or numbers", {"anyOf": [TEXT.schema, {"type": "number"}]}, _check_source)
)
_SIGNAL_OR_MESSAGE = {"anyOf": [_SOURCES.schema["additionalProperties"], _SOURCES.schema]}
BINDINGS = KeyKind(
    _SOURCES.span, {"type": "object", "additionalProperties": _SIGNAL_OR_MESSAGE}, _check_bindings
)

_PORT = "(6553[0-5]|655[0-2][0-9]|65[0-4][0-9]{2}|6[0-4][0-9]{3}|[1-5][0-9]{4}|[1-9][0-9]{0,3})"
BROKER = pattern(
    "host or host:port",
    rf"([A-Za-z0-9]([A-Za-z0-9._-]*[A-Za-z0-9])?|\[[0-9A-Fa-f:.]*:[0-9A-Fa-f:.]*\])(:{_PORT})?",
    "is not a broker address such as broker.example, 192.168.1.5:1883 or [fe80::1]:1883",
    maxLength=200,
)
TOPIC = pattern(
    "string without + and #",
    r"[^\s\x00+#/$][^\x00-\x1f\x7f+#/]*(/[^\x00-\x1f\x7f+#/]+){0,7}",
    "is not a topic prefix such as kontronik or fleet/north. Do not use + or #, or / at the ends.",
    maxLength=200,
)
LEVEL = pattern(
    "letters, digits, _ and -",
    "[A-Za-z0-9_-]{1,64}",
    "is not a name of 1 to 64 letters, digits, _ and -",
)
NODE_NAME = pattern(
    "string",
    r"[a-z0-9_-]+(\.[a-z0-9_-]+)*",
    "is not a name of 1 to 60 lower-case letters, digits, - and _, with single dots in between",
    maxLength=60,
)
ESC_NAME = pattern(
    "string",
    "[A-Za-z][A-Za-z0-9_]{0,11}",
    "is not a name of 1 to 12 letters, digits and underscores that begins with a letter",
)
