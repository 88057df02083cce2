"""What is measured of an ESC, as plans for slots of the core: it sends them at a rate while telemetry is fresh.

Layouts as in the DSDL. What a device does not supply is NaN, or 0 where the type has no such thing; what is out of range is the limit
(a throttle beyond 127 %, which no ESC sends, is 0).
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from functools import cache
from typing import NamedTuple

from kontronik_can_gw.dronecan import types
from kontronik_can_gw.dronecan.types import DataType
from kontronik_can_gw.esc.decoder import EscProtocol
from kontronik_can_gw.esc.telemetry import Event
from kontronik_can_gw.esc.values import Group, Value, values_of
from kontronik_can_gw.signals.packer import compile_pack, place
from kontronik_can_gw.signals.plan import MessagePlan, Piece, Role, SendType, SignalPlan
from kontronik_can_gw.slots import SlotPlan

MAX_RPM, MAX_ESC_INDEX = (1 << 17) - 1, 31
_KELVIN = Fraction("273.15")
_MAX_HALF, _MAX_HALF_BITS, _NAN = 65504.0, 0x7BFF, 0x7E00
_NO_BITS = 1 << 40
"""What of an integer is not available: 0 at its place, and like no value."""
_UNKNOWN_MOTOR_TEMPERATURE = -256
"""StatusExtended has no such thing: what is certainly no temperature."""


class _Part(NamedTuple):
    """A value in a message: from which bit on, how many; 16 are a float, 18 have a sign. Parts at one place are ORed."""

    name: str
    """Empty: the speed that the configuration chooses."""
    at: int
    bits: int
    slope: Fraction = Fraction(1)
    intercept: Fraction = Fraction(0)
    error: int | None = None
    """What is sent instead of what is out of range; None: the greatest number."""
    is_cut: bool = False
    """Its low bits are sent."""


_ANY_HIGHER = Fraction(1, 1 << 18), Fraction(-1, 2)
"""Of the error word: 1 where a bit from the 18th on is set."""
_LAYOUTS: Mapping[DataType, tuple[int, tuple[int, int], Sequence[_Part]]] = {
    # bytes, place and bits of the index, values: without the first one there is no message
    types.STATUS: (14, (105, 5), (
        _Part("", 80, 18), _Part("battery_voltage", 32, 16), _Part("battery_current", 48, 16),
        _Part("power_stage_temperature", 64, 16), _Part("output_opening", 98, 7),
    )),
    types.STATUS_EXTENDED: (7, (51, 5), (
        _Part("output_opening", 7, 7), _Part("throttle", 0, 7, error=0), _Part("throttle", 0, 7, Fraction(-1), error=0),
        _Part("operating_errors", 32, 19, is_cut=True), _Part("operating_errors", 48, 1, *_ANY_HIGHER),
    )),
    types.CIRCUIT_STATUS: (7, (0, 16), (
        _Part("bec_voltage", 16, 16), _Part("bec_current", 32, 16),
        _Part("bec_overcurrent", 53, 1), _Part("bec_undervoltage", 54, 1), _Part("bec_overvoltage", 55, 1),
    )),
    types.TEMPERATURE: (5, (0, 16), (_Part("bec_temperature", 16, 16), _Part("bec_overtemperature", 39, 1))),
}  # fmt: skip


@cache
def plans_of(protocol: EscProtocol, speed: str) -> Mapping[DataType, SlotPlan]:
    """Of what an ESC of this protocol supplies; ``speed``: the value that is sent as rpm."""
    values, found = values_of(protocol), {}
    for kind, (length, _, parts) in _LAYOUTS.items():
        signals = tuple(_signal(part, values[part.name or speed]) for part in parts)
        if signals[0].source is None or not signals[0].source.supplied:
            continue
        plan = MessagePlan(
            *("transfer", 0, True, False, length, SendType.EVENT, 0, 0, signals),
            *(frozenset({0}), frozenset({Group.LIVE})),
        )
        pack = compile_pack(plan)
        found[kind] = SlotPlan(plan, pack, Event.LIVE, 0, None, False, "", kind.seed, True)
    return found


def fill(kind: DataType, index: int, errors: int) -> int:
    """The bits of a message that are no value of the ESC. ``errors``: since the motor was started."""
    found = place(pieces(*_LAYOUTS[kind][1]), index)
    if kind is types.STATUS:
        found |= errors & 0xFFFF_FFFF
    elif kind is types.STATUS_EXTENDED:
        found |= place(pieces(14, 9), _UNKNOWN_MOTOR_TEMPERATURE)
    return found


def pieces(at: int, bits: int) -> tuple[Piece, ...]:
    """Where a number is, from bit ``at`` of the message on: its low byte first, in each byte the most significant bit."""
    whole = 0 if at % 8 else bits // 8 * 8
    found = [Piece(0, whole, at)] if whole else []
    at += whole
    for shift in range(whole, bits, 8):
        left = min(8, bits - shift)
        while left:
            width = min(left, 8 - at % 8)
            left -= width
            found.append(Piece(shift + left, width, at // 8 * 8 + 8 - at % 8 - width))
            at += width
    return tuple(found)


def _signal(part: _Part, value: Value) -> SignalPlan:
    is_float, signed = part.bits == 16, part.bits == 18
    intercept, not_available, error = part.intercept, _NO_BITS, part.error
    high = 0xFFFF_FFFF if part.is_cut else (1 << part.bits - signed) - 1
    if is_float:
        not_available, error = _NAN, _MAX_HALF_BITS
        intercept = _KELVIN if value.unit == "°C" else intercept
    return SignalPlan(
        *(part.name, value.unit, Role.SOURCE, high.bit_length() + signed, signed, is_float),
        *(pieces(part.at, part.bits), -high - 1 if signed else 0, high),
        *(not_available, high if error is None else error),
        slope=part.slope / value.per_unit,
        intercept=intercept,
        source=value,
        esc=0,
        limits=(-_MAX_HALF, _MAX_HALF),
    )
