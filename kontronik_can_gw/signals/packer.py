"""Message plans -> functions of ESCs, gateway and time: to the bits of a frame as an integer, or to the frame.

A value that does not fit becomes the signal's Error code, one that is not available its NotAvailable code; nothing wraps, nothing is
clipped. Bit 0 of the integer is bit 0 of byte 0.
"""

import math
import struct
from collections.abc import Callable, Sequence
from fractions import Fraction

from kontronik_can_gw.esc.telemetry import EscTelemetry
from kontronik_can_gw.esc.values import divisor, steps
from kontronik_can_gw.frames import FIRST_PART, CanFrame
from kontronik_can_gw.gateway_status import GatewayStatus
from kontronik_can_gw.signals.plan import MessagePlan, Piece, Role, SignalPlan

Pack = Callable[[Sequence[EscTelemetry], GatewayStatus, int, int, int], int]
"""ESCs, gateway, time, alive counter and place of the page (``MessagePlan.pages``) to bits, without a CRC."""
MakeFrame = Callable[[Sequence[EscTelemetry], GatewayStatus, int, int, int], CanFrame]
"""The same to the frame with its CRC."""
_Raw = Callable[[Sequence[EscTelemetry], GatewayStatus, int], int]
_FLOATS = {16: "<e", 32: "<f", 64: "<d"}


def place(pieces: Sequence[Piece], raw: int) -> int:
    """A raw value (negative ones in two's complement) at its bits of the frame."""
    return sum([(raw >> piece.shift & (1 << piece.width) - 1) << piece.at for piece in pieces])


def take(pieces: Sequence[Piece], bits: int) -> int:
    """The raw value (unsigned) that stands at the pieces of a frame."""
    return sum((bits >> piece.at & (1 << piece.width) - 1) << piece.shift for piece in pieces)


def alive_modulus(signal: SignalPlan, has_crc: bool) -> int:
    """An alive counter runs 0..modulus-1: to its greatest value, with an E2E profile 1 CRC to 14 of 4 bits."""
    return min(signal.high + 1, 15) if has_crc else signal.high + 1


def compile_pack(plan: MessagePlan) -> Pack:
    """The function to the bits of a frame."""
    has_crc = any(signal.role is Role.CRC for signal in plan.signals)
    counters = [
        (signal.pieces, alive_modulus(signal, has_crc))
        for signal in plan.signals
        if signal.role is Role.ALIVE
    ]
    pages = [_page(plan, page) for page in plan.pages]

    def pack(
        escs: Sequence[EscTelemetry], gateway: GatewayStatus, now: int, alive: int, at: int
    ) -> int:
        bits, sources = pages[at]
        for pieces, raw in sources:
            bits |= place(pieces, raw(escs, gateway, now))
        for places, modulus in counters:
            bits |= place(places, alive % modulus)
        return bits

    return pack


def compile_frame(plan: MessagePlan) -> MakeFrame:
    """The function to the frame."""
    pack = compile_pack(plan)
    crc = next((signal for signal in plan.signals if signal.role is Role.CRC), None)

    def frame(
        escs: Sequence[EscTelemetry], gateway: GatewayStatus, now: int, alive: int, at: int
    ) -> CanFrame:
        data = pack(escs, gateway, now, alive, at).to_bytes(plan.length, "little")
        if crc is not None:
            data = _protected(data, crc.pieces[0].at // 8, plan.data_id)
        # from FIRST_PART on a page would be a part of a transfer
        return CanFrame(plan.can_id, data, plan.extended, plan.fd, at if at < FIRST_PART else -at)

    return frame


def _page(plan: MessagePlan, page: int | None) -> tuple[int, list[tuple[tuple[Piece, ...], _Raw]]]:
    """The constant bits of a page, and where the raw value of each of its sources stands."""
    constant = 0
    sources = []
    for signal in plan.signals:
        if signal.role is Role.MULTIPLEXER:
            constant |= place(signal.pieces, page or 0)
        elif signal.page not in (None, page):
            continue
        elif signal.role is Role.CONSTANT:
            constant |= place(signal.pieces, signal.constant)
        elif signal.source is not None:
            sources.append((signal.pieces, _raw(signal)))
    return constant, sources


def _raw(signal: SignalPlan) -> _Raw:
    """The function to a signal's raw value, multiplied first and rounded once to the nearest, halves up; else to one of its codes."""
    source, index, numbers = signal.source, signal.esc or 0, signal.numbers
    assert source is not None
    low, high, error, not_available = signal.low, signal.high, signal.error, signal.not_available
    common = signal.slope.denominator * signal.intercept.denominator
    factor, offset = int(signal.slope * common), int(signal.intercept * common)

    def raw(escs: Sequence[EscTelemetry], gateway: GatewayStatus, now: int) -> int:
        esc = escs[index]
        found = steps(source, esc, gateway, now)
        by = None if found is None else divisor(source, esc)
        if found is None or by is None:
            return not_available
        if signal.is_float:
            number = _float(signal, found, by)
            if number is None or not signal.limits[0] <= number <= signal.limits[1]:
                return error
            bits = float_bits(number, signal.length)
            return error if bits is None or bits == not_available else bits
        if numbers is not None:
            return numbers.get(found, error)
        over, under = by
        value = (2 * (found * factor * under + offset * over) + common * over) // (
            2 * common * over
        )
        if source.rolls:
            return value % (high + 1)
        if signal.saturates and value < low:
            return low
        # a true value must not look like a code amid the values
        return value if low <= value <= high and value != not_available else error

    return raw


def _float(signal: SignalPlan, found: int, by: tuple[int, int]) -> float | None:
    """Steps as a double, by one exact division; None for a number that the value table does not name."""
    if signal.numbers is not None:
        return signal.numbers.get(found)
    slope = signal.slope
    quotient = ratio(found * slope.numerator * by[1], slope.denominator * by[0])
    return quotient + float(signal.intercept)


def ratio(numerator: int, denominator: int) -> float:
    """A fraction as a double; infinite where it is too large."""
    try:
        return numerator / denominator
    except OverflowError:
        return math.inf if numerator > 0 else -math.inf


def float_bits(number: float | Fraction, length: int) -> int | None:
    """The IEEE 754 bits of a float of 16, 32 or 64 bits; None where it is too large, and of any other length."""
    try:
        packed = struct.pack(_FLOATS[length], float(number))
    except (KeyError, OverflowError):
        return None
    return int.from_bytes(packed, "little")


def has_code(signal: SignalPlan) -> bool:
    """True where "not available" is a code of its own, outside the values."""
    if signal.is_float:
        value = float_of(signal.not_available, signal.length)
        return math.isnan(value) or not signal.limits[0] <= value <= signal.limits[1]
    if signal.numbers is not None:
        return signal.not_available not in signal.numbers.values()
    return not signal.low <= signal.not_available <= signal.high


def float_of(bits: int, length: int) -> float:
    """The number that IEEE 754 bits hold."""
    number: float
    (number,) = struct.unpack(_FLOATS[length], bits.to_bytes(length // 8, "little"))
    return number


def _crc_table() -> bytes:
    """AUTOSAR E2E profile 1: CRC-8 SAE J1850 (polynomial 1Dh) over data id and data, start and final XOR 0 (PRS_E2EProtocol)."""
    table = []
    for byte in range(256):
        for _ in range(8):
            byte = byte << 1 ^ (0x11D if byte & 0x80 else 0)
        table.append(byte)
    return bytes(table)


_CRC = _crc_table()


def e2e_crc(data: bytes, at: int, data_id: int) -> int:
    """The CRC of a frame whose CRC byte stands at ``at``: data id low byte, high byte, all other bytes in order."""
    value = 0
    for byte in bytes((data_id & 0xFF, data_id >> 8 & 0xFF)) + data[:at] + data[at + 1 :]:
        value = _CRC[value ^ byte]
    return value


def _protected(data: bytes, at: int, data_id: int) -> bytes:
    """The frame with its CRC at ``at``."""
    return data[:at] + bytes((e2e_crc(data, at, data_id),)) + data[at + 1 :]
