"""Unit texts as they are met in DBC files, and exact conversion between those of one quantity."""

from fractions import Fraction
from typing import NamedTuple


class Unit(NamedTuple):
    """``base value = value * scale + shift`` within one quantity."""

    quantity: str
    scale: Fraction
    shift: Fraction = Fraction(0)


def _units(quantity: str, **scales: str) -> dict[str, Unit]:
    return {name: Unit(quantity, Fraction(scale)) for name, scale in scales.items()}


_KELVIN_SHIFT = Fraction("-273.15")
_UNITS: dict[str, Unit] = (
    _units("voltage", V="1", mV="1/1000", kV="1000")
    | _units("current", A="1", mA="1/1000", kA="1000")
    | _units("power", W="1", mW="1/1000", kW="1000", hp="745.69987158227022", PS="735.49875")
    | _units("energy", Wh="1", mWh="1/1000", kWh="1000", J="1/3600", kJ="1000/3600")
    | _units("charge", mAh="1", Ah="1000", As="1000/3600")
    | _units("time", s="1", sec="1", ms="1/1000", us="1/1000000", usec="1/1000000", min="60", h="3600")
    | _units("frequency", Hz="1", kHz="1000")
    | _units("rotation", rpm="1", rps="60")
    | {
        text: Unit("rotation", Fraction(1))
        for text in (
            "1/min",
            "/min",
            "min-1",
            "min^-1",
            "r/min",
            "rev/min",
            "U/min",
            "Upm",
            "erpm",
            "eRPM",
            "RPM",
            "Rpm",
        )
    }
    | {text: Unit("rotation", Fraction(60)) for text in ("1/s", "rev/s", "r/s", "U/s", "s-1")}
    | {text: Unit("share", Fraction(1)) for text in ("%", "percent", "Percent", "pct")}
    | {text: Unit("temperature", Fraction(1)) for text in ("degC", "deg C", "°C", "C", "Cel", "celsius", "Celsius")}
    | {text: Unit("temperature", Fraction(1), _KELVIN_SHIFT) for text in ("K", "degK", "Kelvin")}
    | {
        text: Unit("temperature", Fraction(5, 9), Fraction(-160, 9))
        for text in ("degF", "deg F", "°F", "F", "Fahrenheit")
    }
)
_UNITS |= {"µs": _UNITS["us"], "μs": _UNITS["us"], "Volt": _UNITS["V"], "Ampere": _UNITS["A"], "Watt": _UNITS["W"]}
_COUNT = ("", "1", "-", "count", "counts", "cnt", "#", "bit", "bool", "cells", "B", "byte", "bytes", "frames")
_UNITS |= {text: Unit("number", Fraction(1)) for text in _COUNT}


def conversion(source: str, target: str) -> tuple[Fraction, Fraction] | None:
    """(m, b) with ``value in target = value in source * m + b``; None where the two are not of one quantity.

    An empty target means the source's own unit.
    """
    if target in (source, ""):
        return Fraction(1), Fraction(0)
    a, b = _UNITS.get(source), _UNITS.get(target.strip())
    if a is None or b is None or a.quantity != b.quantity:
        return None
    return a.scale / b.scale, (a.shift - b.shift) / b.scale


def texts_like(source: str) -> list[str]:
    """The unit texts that a source's unit can be converted to, for messages to people."""
    unit = _UNITS.get(source)
    return [
        text for text, other in _UNITS.items() if unit and other.quantity == unit.quantity and text and text.isascii()
    ]
