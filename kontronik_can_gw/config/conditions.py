"""Conditions about the values of an ESC, such as "battery_voltage < 20"."""

import operator
import re
from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import Any, NamedTuple

from kontronik_can_gw.config.kinds import TEXT, KeyKind, list_of, shown
from kontronik_can_gw.errors import did_you_mean
from kontronik_can_gw.esc.decoder import Severity
from kontronik_can_gw.esc.protocols import PROTOCOLS
from kontronik_can_gw.esc.value_names import VALUES_BY_KEY, normalize
from kontronik_can_gw.esc.values import Group, Kind, Value
from kontronik_can_gw.signals.units import conversion, texts_like

_OPERATORS: Mapping[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
_FORM = re.compile(r"(?:([^<>=!.]*)\.)?([^<>=!.]*)([<>=!]+)(.*)", re.DOTALL)
_NUMBER = re.compile(r"\s*([-+]?[0-9]+(?:\.[0-9]+)?(?:[eE][-+]?[0-9]{1,2})?)(.*)", re.DOTALL)
_EXAMPLE = '"battery_voltage < 20"'
_LONGEST = 200


class Condition(NamedTuple):
    """A value of an ESC on one side of a limit."""

    text: str
    """The condition as the user wrote it, without the ESC and further spaces."""
    esc: str
    """Normalized name of the only ESC for which it holds. Empty: all ESCs."""
    value: Value
    compare: Callable[[float, float], bool]
    limit: float
    """The limit in the unit of the value."""


def condition(text: str) -> Condition:
    """Read a condition. Raises ValueError with the mistake."""
    match = _FORM.fullmatch(text)
    if match is None or len(text) > _LONGEST:
        raise ValueError(f"{shown(text)} is not a condition such as {_EXAMPLE}")
    esc, name, sign, rest = match.groups("")
    if sign not in _OPERATORS:
        raise ValueError(f"{shown(text)}: {sign} is unknown. Use one of {', '.join(_OPERATORS)}")
    value = _value(text, name.strip())
    limit = _limit(text, rest, value)
    about = text[match.start(2) :]
    return Condition(" ".join(about.split()), normalize(esc), value, _OPERATORS[sign], limit)


def _value(text: str, name: str) -> Value:
    value = VALUES_BY_KEY.get(normalize(name))
    if value is None:
        near = did_you_mean(name, [each.name for each in VALUES_BY_KEY.values()])
        raise ValueError(f"{shown(text)}: there is no value {shown(name)}{near and f'.{near}'}")
    if value.group is Group.GATEWAY:
        raise ValueError(f"{shown(text)}: {value.name} is a value of the gateway, not of an ESC")
    if value.names:
        raise ValueError(f"{shown(text)}: {value.name} is not a number")
    if value.kind is Kind.AGE:
        raise ValueError(
            f"{shown(text)}: {value.name} cannot be compared. "
            "The loss of telemetry is an event without a condition"
        )
    return value


def _limit(text: str, rest: str, value: Value) -> float:
    """Return the limit in the unit of the value."""
    match = _NUMBER.fullmatch(rest)
    if match is None:
        raise ValueError(f"{shown(text)}: {shown(rest.strip())} is not a number")
    number = Fraction(match[1])
    unit = match[2].strip()
    if unit:
        if not value.unit:
            raise ValueError(f"{shown(text)}: {value.name} has no unit. Remove {shown(unit)}")
        factors = conversion(unit, value.unit)
        if factors is None:
            units = ", ".join(texts_like(value.unit)) or value.unit
            raise ValueError(
                f"{shown(text)}: {shown(unit)} is no unit of {value.name}. Known: {units}"
            )
        number = number * factors[0] + factors[1]
    return float(number)


def _check_condition(value: Any) -> str:
    text: str = TEXT.check(value)
    condition(text)
    return text


_TEXT = {"type": "string", "pattern": r"^[^<>=!]*[<>]=?\s*[-+]?[0-9].*$"}
CONDITIONS = list_of(
    KeyKind("condition", _TEXT, _check_condition),
    "list of conditions",
    f"conditions such as [{_EXAMPLE}]",
)


def _error_names() -> list[str]:
    """Return the classes of error bits, and the names of all bits."""
    names = [severity.value for severity in Severity]
    for protocol in PROTOCOLS:
        for bits in protocol.errors.values():
            names += [bit.text for bit in bits]
    return list(dict.fromkeys(names))


def _check_error(value: Any) -> str:
    text: str = TEXT.check(value)
    names = _error_names()
    if text not in names:
        near = did_you_mean(text, names).replace(" Did", ". Did")
        raise ValueError(
            f"{shown(text)} is neither error, warning or status nor an error bit{near}"
        )
    return text


ERRORS = list_of(
    KeyKind("error", {"type": "string", "enum": _error_names()}, _check_error),
    "list of error, warning, status and error bits",
    'names such as ["error", "undervoltage"]',
)
