"""Message plans -> one compiled function each, of ESCs, gateway and time: to the bits of a frame as an integer, or to the frame.

Python source is generated from the plan once, at start. A value that does not fit becomes the signal's Error code, one that is not
available its NotAvailable code; nothing wraps, nothing is clipped. Bit 0 of the integer is bit 0 of byte 0.
"""

import math
import struct
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any

from kontronik_can_gw.esc.telemetry import EscTelemetry
from kontronik_can_gw.esc.values import Divisor, Kind, Value
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway_status import GatewayStatus
from kontronik_can_gw.signals import e2e
from kontronik_can_gw.signals.plan import MessagePlan, Piece, Role, SignalPlan

Pack = Callable[[Sequence[EscTelemetry], GatewayStatus, int, int, int], int]
"""ESCs, gateway, time, alive counter and multiplexer value to bits."""
MakeFrame = Callable[[Sequence[EscTelemetry], GatewayStatus, int, int, int], CanFrame]
"""ESCs, gateway, time, alive counter and place of the page (``MessagePlan.pages``) to the frame with its CRC."""


def place(pieces: Sequence[Piece], raw: int) -> int:
    """A raw value (negative ones in two's complement) at its bits of the frame."""
    return sum((raw >> piece.shift & (1 << piece.width) - 1) << piece.at for piece in pieces)


def take(pieces: Sequence[Piece], bits: int) -> int:
    """The raw value (unsigned) that stands at the pieces of a frame."""
    return sum((bits >> piece.at & (1 << piece.width) - 1) << piece.shift for piece in pieces)


_FLOATS = {16: "<e", 32: "<f", 64: "<d"}


def float_bits(
    value: float | None, length: int, low: float, high: float, error: int, not_available: int = -1
) -> int:
    """The IEEE 754 bits of a float of 16, 32 or 64 bits.

    ``error`` for what is outside low..high, has no float of this length, or would look like ``not_available``.
    """
    if value is None or not low <= value <= high:
        return error
    try:
        bits = int.from_bytes(struct.pack(_FLOATS[length], value), "little")
    except OverflowError:
        return error
    return error if bits == not_available else bits


def quotient(numerator: int, denominator: int) -> float:
    """A fraction as a double; infinite where it is too large."""
    try:
        return numerator / denominator
    except OverflowError:
        return math.inf if numerator > 0 else -math.inf


def alive_modulus(signal: SignalPlan, has_crc: bool) -> int:
    """An alive counter runs 0..modulus-1: to its greatest value, with an E2E profile 1 CRC to 14 of 4 bits."""
    return min(signal.high + 1, 15) if has_crc else signal.high + 1


def compile_pack(plan: MessagePlan) -> Pack:
    """The function to the bits of a frame, without a CRC."""
    lines = ["def pack(escs, gateway, now, alive, page):", *_bits(plan), "    return bits"]
    return _compiled(plan, "pack", lines)  # type: ignore[no-any-return]


def compile_frame(plan: MessagePlan) -> MakeFrame:
    """The function to the frame."""
    lines = ["def frame(escs, gateway, now, alive, place):"]
    if plan.pages != (None,):
        lines.append(f"    page = {plan.pages}[place]")
    data = f'bits.to_bytes({plan.length}, "little")'
    crc = next((signal for signal in plan.signals if signal.role is Role.CRC), None)
    if crc is not None:
        data = f"protected({data}, {crc.pieces[0].at // 8}, {plan.data_id})"
    of_frame = f"({plan.can_id}, {data}, {plan.extended}, {plan.fd}, place, False, False)"
    lines += [*_bits(plan), f"    return new(CanFrame, {of_frame})"]
    return _compiled(plan, "frame", lines)  # type: ignore[no-any-return]


def _compiled(plan: MessagePlan, name: str, lines: Sequence[str]) -> Any:
    """The function of this name in generated text, which names tables and functions of the plan's signals."""
    names: dict[str, object] = {
        "float_bits": float_bits,
        "quotient": quotient,
        "inf": math.inf,
        "protected": e2e.protected,
        "new": tuple.__new__,
        "CanFrame": CanFrame,
    }
    for signal in plan.signals:
        if signal.numbers:
            names[_name("numbers", signal)] = {int(k): v for k, v in signal.numbers.items()}
        if signal.source is not None:
            names[_name("read", signal)] = signal.source.read
            names[_name("not_on", signal)] = signal.source.not_on
    exec(compile("\n".join(lines), f"<packer of {plan.name}>", "exec"), names)  # noqa: S102  text made here, from checked plans
    return names.pop(name)  # what its own globals hold would be a circle


def _bits(plan: MessagePlan) -> list[str]:
    """Lines of a function that put a frame together in ``bits``."""
    lines: list[str] = []
    for page in dict.fromkeys((None, *plan.pages)):
        indent = "    "
        if page is not None:
            lines.append(f"    if page == {page}:")
            indent = "        "
        for number, (setup, bits) in enumerate(_parts(plan, page)):
            lines += [indent + line for line in setup]
            lines.append(f"{indent}bits {'=' if page is None and number == 0 else '|='} {bits}")
    return lines


def _parts(plan: MessagePlan, page: int | None) -> list[tuple[list[str], str]]:
    """Python text of what makes up a page's bits: lines in front, and an expression. At least one."""
    parts: list[tuple[list[str], str]] = []
    has_crc = any(signal.role is Role.CRC for signal in plan.signals)
    by_reading: dict[tuple[int | None, str | None], list[SignalPlan]] = {}
    constant = 0
    for signal in plan.signals:
        if signal.role is Role.MULTIPLEXER and page is not None:
            constant |= place(signal.pieces, page)
        if signal.page != page:
            continue
        if signal.role is Role.CONSTANT:
            constant |= place(signal.pieces, signal.constant)
        elif signal.role is Role.ALIVE:
            parts.append(([], _placed(signal, f"alive % {alive_modulus(signal, has_crc)}")))
        elif signal.source is not None:
            key = (signal.esc, _reading(signal.source))
            by_reading.setdefault(key, []).append(signal)
    for (esc, reading), signals in by_reading.items():
        setup = ["esc = None" if esc is None else f"esc = escs[{esc}]"]
        bits = " | ".join(_terms(signals))
        if reading is not None:
            nothing = sum(place(signal.pieces, signal.not_available) for signal in signals)
            setup.append(f"reading = esc.{reading}")
            bits = f"{nothing:#x} if reading is None else {bits}"
        parts.append((setup, bits))
    if constant or not parts:
        parts.append(([], f"{constant:#x}"))
    return parts


def _reading(source: Value) -> str | None:
    """The reading of the ESC that a value is taken from; None for one that is read by a function."""
    if source.read is not None:
        return None
    if source.last:
        return "last_info"
    return source.group.value


def _terms(signals: Sequence[SignalPlan]) -> list[str]:
    """Python text of each signal's bits; flags of one word that move together are one."""
    terms: list[str] = []
    # (word, distance moved up) -> bits of the word that move together
    flags: dict[tuple[int, int], int] = {}
    for signal in signals:
        source = signal.source
        assert source is not None
        if source.bit is not None and source.supplied and _is_plain_flag(signal):
            key = (source.words[0], signal.pieces[0].at - source.bit)
            flags[key] = flags.get(key, 0) | 1 << source.bit
            continue
        steps, condition = _steps(signal, source)
        term = _placed(signal, _value(signal, steps))
        if condition is not None:
            term = f"({term} if {condition} else {place(signal.pieces, signal.not_available):#x})"
        terms.append(term)
    for (word, distance), mask in flags.items():
        moved = f" << {distance}" if distance > 0 else f" >> {-distance}" if distance else ""
        terms.append(f"(reading[{word}] & {mask:#x}){moved}")
    return terms


def _steps(signal: SignalPlan, source: Value) -> tuple[str, str | None]:
    """Python text of the value in steps before the divisor, and of when it is available (None: with its reading)."""
    if source.read is not None:
        return "x", f"(x := {_name('read', signal)}(esc, gateway, now)) is not None"
    fields = [f"reading[{word}]" for word in source.words]
    steps = " * ".join(fields)
    if source.kind is Kind.BITS:
        moved = f"{steps} >> {source.shift}" if source.shift else steps
        steps = f"({moved} & {source.mask:#x})"
    if source.not_on:
        return steps, f"esc.supplies({_name('not_on', signal)}, {steps})"
    return steps, "esc.cells" if source.divisor is Divisor.CELLS else None


def _is_plain_flag(signal: SignalPlan) -> bool:
    return (
        signal.length == 1
        and not signal.is_float
        and signal.slope == 1
        and signal.intercept == 0
        and not signal.signed
    )


def _value(signal: SignalPlan, steps: str) -> str:
    """Python text of a signal's raw value, or of its Error code where it has none."""
    source = signal.source
    assert source is not None
    if signal.is_float:
        least, most = signal.limits
        number = (
            _float(signal, steps)
            if signal.numbers is None
            else f"{_name('numbers', signal)}.get({steps})"
        )
        return f"float_bits({number}, {signal.length}, {least!r}, {most!r}, {signal.error}, {signal.not_available})"
    if signal.numbers is not None:
        return f"{_name('numbers', signal)}.get({steps}, {signal.error})"
    if source.rolls:
        return f"{_scaled(signal, steps)} % {signal.high + 1}"
    value = _scaled(signal, steps)
    low, high = _ends(signal)
    unfit = [f"> {signal.high}"] if high is None or high > signal.high else []
    unfit += [f"< {signal.low}"] if low is None or low < signal.low else []
    if signal.low <= signal.not_available <= signal.high and signal.error != signal.not_available:
        # a code amid the values: a true value must not look like it
        unfit.append(f"== {signal.not_available}")
    if not unfit:
        return value
    name, first = ("x", "x") if value == "x" else ("v", f"(v := {value})")
    tests = " or ".join([f"{first} {unfit[0]}", *(f"{name} {test}" for test in unfit[1:])])
    return f"{signal.error} if {tests} else {name}"


def _name(what: str, signal: SignalPlan) -> str:
    """The name of a table or function of a signal in the generated text."""
    return f"{what}_at_{signal.pieces[0].at}_of_{signal.page or 0}"


_DIVISORS = {
    Divisor.ONE: ("", ""),
    Divisor.POLE_PAIRS: (" * esc.pole_pairs", ""),
    Divisor.OUTPUT: (" * esc.output_divisor", " * esc.gear_denominator"),
    Divisor.CELLS: (" * esc.cells", ""),
}
"""Python text by which what divides a value, and the value, are multiplied."""


def _scaled(signal: SignalPlan, steps: str) -> str:
    """Python text of ``steps / divisor * slope + intercept``: multiplied first, rounded once to the nearest, halves up."""
    assert signal.source is not None
    slope, intercept = signal.slope, signal.intercept
    by, over = _DIVISORS[signal.source.divisor]
    if not by and slope.denominator == 1 and intercept.denominator == 1:
        product = steps if slope == 1 else f"{steps} * {slope}"
        return product if intercept == 0 else f"({product} + {intercept})"
    common = slope.denominator * intercept.denominator
    factor, offset = int(slope * common), int(intercept * common)
    rest = f"{2 * offset + common}{by}"
    return f"(({steps} * {2 * factor}{over} + {rest}) // ({2 * common}{by}))"


def _float(signal: SignalPlan, steps: str) -> str:
    """Python text of ``steps / divisor * slope + intercept`` as a double: one exact division."""
    assert signal.source is not None
    by, over = _DIVISORS[signal.source.divisor]
    numerator, denominator = signal.slope.numerator, signal.slope.denominator
    divided = f"quotient({steps} * {numerator}{over}, {denominator}{by})"
    return divided if signal.intercept == 0 else f"{divided} + {float(signal.intercept)!r}"


def _ends(signal: SignalPlan) -> tuple[Fraction | None, Fraction | None]:
    """Least and greatest raw value that the source can give; None where it has no limit."""
    source = signal.source
    assert source is not None
    if source.low is None or source.high is None or source.divisor is not Divisor.ONE:
        return None, None
    ends = [
        source.low * signal.slope + signal.intercept,
        source.high * signal.slope + signal.intercept,
    ]
    return min(ends), max(ends)


def _placed(signal: SignalPlan, value: str) -> str:
    """A value's Python text at the signal's bits. Only signed values and codes can have bits beyond the length."""
    parts: list[str] = []
    at_first = f"({value})" if len(signal.pieces) == 1 else f"(w := {value})"
    for piece in signal.pieces:
        part = "w" if parts else at_first
        if piece.shift:
            part += f" >> {piece.shift}"
        if signal.signed or piece.shift + piece.width < signal.length:
            part = f"({part} & {(1 << piece.width) - 1:#x})"
        elif piece.shift:
            part = f"({part})"
        parts.append(f"{part} << {piece.at}" if piece.at else part)
    return " | ".join(parts)
