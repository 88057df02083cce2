"""Compiles message plans into functions that pack a frame from ESCs, gateway and time.

Nothing wraps and nothing is clipped: a value that does not fit becomes the signal's Error code, and
a value that is not available becomes its NotAvailable code. The bits of a frame are one integer,
whose bit 0 is bit 0 of byte 0.
"""

import math
import struct
from collections.abc import Callable, Sequence
from fractions import Fraction

from kontronik_can_gw.esc.telemetry import EscTelemetry
from kontronik_can_gw.esc.values import Value, divisor, rounded, steps
from kontronik_can_gw.frames import FIRST_PART, CanFrame
from kontronik_can_gw.signals.e2e import Protection
from kontronik_can_gw.signals.plan import MessagePlan, Piece, Role, SignalPlan
from kontronik_can_gw.status import GatewayStatus

Pack = Callable[[Sequence[EscTelemetry], GatewayStatus, int, int, int], int]
"""Maps ESCs, gateway, time, alive counter and group to the bits of a frame, without a CRC.

The group is given by its position in ``MessagePlan.pages``.
"""
MakeFrame = Callable[[Sequence[EscTelemetry], GatewayStatus, int, int, int], CanFrame]
"""Maps the same arguments to the frame, with its CRC."""
_FLOATS = {16: "<e", 32: "<f", 64: "<d"}
"""struct codes of IEEE 754 numbers by their length in bits."""


def place(pieces: Sequence[Piece], raw: int) -> int:
    """Return a frame's bits with a raw value at these pieces and 0 elsewhere.

    Bits beyond the pieces are cut off, so a negative value is stored as two's complement.
    """
    bits = 0
    for piece in pieces:
        bits |= (raw >> piece.shift & (1 << piece.width) - 1) << piece.at
    return bits


def extract(pieces: Sequence[Piece], bits: int) -> int:
    """Return the unsigned raw value at these pieces of a frame's bits."""
    return sum((bits >> piece.at & (1 << piece.width) - 1) << piece.shift for piece in pieces)


def alive_modulus(signal: SignalPlan, e2e: Protection | None) -> int:
    """Return the number of values of an alive counter. It counts from 0 and then restarts.

    It uses all values of its bits, or as many as the E2E profile of its message.
    """
    modulus = signal.high + 1
    return modulus if e2e is None else min(modulus, e2e.profile.counters)


def compile_pack(plan: MessagePlan) -> Pack:
    """Return the function that packs the message's bits."""
    counters = [
        (signal.pieces, alive_modulus(signal, plan.e2e))
        for signal in plan.signals
        if signal.role is Role.ALIVE
    ]
    pages = [_compile_page(plan, page) for page in plan.pages]

    def pack(
        escs: Sequence[EscTelemetry],
        gateway: GatewayStatus,
        now: int,
        alive: int,
        at: int,
    ) -> int:
        bits, sources = pages[at]
        for signal, source in sources:
            esc = escs[signal.esc or 0]
            bits |= place(signal.pieces, raw_value(signal, source, esc, gateway, now))
        for pieces, modulus in counters:
            bits |= place(pieces, alive % modulus)
        return bits

    return pack


def compile_frame(plan: MessagePlan) -> MakeFrame:
    """Return the function that makes the message's frame."""
    pack = compile_pack(plan)
    crc = next((signal for signal in plan.signals if signal.role is Role.CRC), None)

    def make_frame(
        escs: Sequence[EscTelemetry],
        gateway: GatewayStatus,
        now: int,
        alive: int,
        at: int,
    ) -> CanFrame:
        data = pack(escs, gateway, now, alive, at).to_bytes(plan.length, "little")
        if crc is not None and plan.e2e is not None:
            data = plan.e2e.insert_crc(data, crc.pieces[0].at // 8, alive)
        # FIRST_PART and greater numbers mean a part of a transfer. Negative numbers are free.
        page = at if at < FIRST_PART else -at
        return CanFrame(plan.can_id, data, plan.extended, plan.fd, page)

    return make_frame


def _compile_page(
    plan: MessagePlan, page: int | None
) -> tuple[int, list[tuple[SignalPlan, Value]]]:
    """Return a group's constant bits, and the signals with a source, each with its source."""
    constant = 0
    sources = []
    for signal in plan.signals:
        if signal.role is Role.MULTIPLEXER:
            constant |= place(signal.pieces, page or 0)
        elif signal.page not in (None, page):
            continue
        elif signal.role in (Role.CONSTANT, Role.DATA_ID):
            constant |= place(signal.pieces, signal.constant)
        elif signal.source is not None:
            sources.append((signal, signal.source))
    return constant, sources


def raw_value(
    signal: SignalPlan,
    source: Value,
    esc: EscTelemetry,
    gateway: GatewayStatus,
    now: int,
) -> int:
    """Return the raw value of a signal, or its code for an error or for "not available".

    The value is multiplied first and rounded once, half up. A true value must not be mistaken for
    a code that lies within the values.
    """
    count = steps(source, esc, gateway, now)
    parts = divisor(source, esc)
    if count is None or parts is None:
        return signal.not_available
    if signal.is_float:
        raw = _float_raw(signal, count, parts)
    elif signal.numbers is not None:
        return signal.numbers.get(count, signal.error)
    else:
        raw = rounded(count, signal.slope, parts, signal.intercept)
        if source.rolls:
            return raw % (signal.high + 1)
        if not signal.low <= raw <= signal.high:
            return signal.low if signal.saturates and raw < signal.low else signal.error
    return signal.error if raw in (None, signal.not_available) else raw


def _float_raw(signal: SignalPlan, count: int, parts: tuple[int, int]) -> int | None:
    """Return the IEEE 754 bits of ``count`` steps with this divisor, computed with one division.

    None if the number is outside the limits, or not in the signal's value table.
    """
    number: float | None
    if signal.numbers is not None:
        number = signal.numbers.get(count)
    else:
        over, under = parts
        dividend = count * signal.slope.numerator * under
        number = ratio(dividend, signal.slope.denominator * over) + float(signal.intercept)
    low, high = signal.limits
    if number is None or not low <= number <= high:
        return None
    return float_bits(number, signal.length)


def ratio(numerator: int, denominator: int) -> float:
    """Return the quotient as a double, infinite if it is too large."""
    try:
        return numerator / denominator
    except OverflowError:
        return math.inf if numerator > 0 else -math.inf


def float_bits(number: float | Fraction, length: int) -> int | None:
    """Return the IEEE 754 bits of a number in 16, 32 or 64 bits.

    None if the number is too large, or for another length.
    """
    try:
        packed = struct.pack(_FLOATS[length], float(number))
    except (KeyError, OverflowError):
        return None
    return int.from_bytes(packed, "little")


def has_code(signal: SignalPlan) -> bool:
    """Return True if the code for "not available" differs from every value of the signal."""
    if signal.is_float:
        value = float_of(signal.not_available, signal.length)
        low, high = signal.limits
        return math.isnan(value) or not low <= value <= high
    if signal.numbers is not None:
        return signal.not_available not in signal.numbers.values()
    return not signal.low <= signal.not_available <= signal.high


def float_of(bits: int, length: int) -> float:
    """Return the number that IEEE 754 bits of 16, 32 or 64 bits represent."""
    number: float
    data = bits.to_bytes(length // 8, "little")
    (number,) = struct.unpack(_FLOATS[length], data)
    return number
