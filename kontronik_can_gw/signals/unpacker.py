"""CAN frames of a layout -> values: what a logger with the DBC sees. The other way round of packer.py, from the same plans.

One function a message (and multiplexer page) is generated from its plan. A value is an int or a float in the signal's unit, a text
where the signal is an enumeration, None where it is not available (or could not be sent: the Error code). A flag, which has no code for
that, is not available where the other values of its message are not.
"""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction

from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.frames import EXTENDED
from kontronik_can_gw.signals.packer import take
from kontronik_can_gw.signals.plan import Layout, MessagePlan, Role, SignalPlan

Value = int | float | str | None
Chunk = tuple[int, list[Value]]
"""Values of neighbouring columns, and the index of the first."""


@dataclass(frozen=True)
class Column:
    """One signal of a layout. Alive counters, CRCs, multiplexers and constants are no columns."""

    name: str
    """Of the signal in the DBC."""
    unit: str
    message: str
    key: int
    """CAN id of the message, with ``EXTENDED`` for 29 bits."""
    source: str
    """What the signal is bound to: a name of values.py."""
    esc: int | None
    """Index of the ESC; None for the gateway's own."""
    texts: tuple[tuple[int, str], ...] = ()
    """Raw value and text of an enumeration, in the order of the values; empty for a number."""
    digits: int | None = 0
    """Decimals that the signal can differ in; None for a float."""
    low: float = 0
    high: float = 0
    """Least and greatest value that can be sent, in ``unit``."""

    @property
    def is_flag(self) -> bool:
        """One bit that is set or not."""
        return not self.texts and (self.low, self.high, self.digits) == (0, 1, 0)

    @property
    def is_whole(self) -> bool:
        """True where every value is a whole number."""
        return not self.texts and self.digits == 0


@dataclass(frozen=True)
class Part:
    """Neighbouring columns that come together: those of a message without page, or of one of its pages."""

    first: int
    count: int
    plan: MessagePlan
    page: int | None


class SignalReader:
    """Reads the frames of one layout. ``columns`` in the order of messages, pages and signals."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        columns: list[Column] = []
        self.parts: list[Part] = []
        self._messages: dict[
            int, tuple[int, Callable[[int], int] | None, dict[int | None, _Unpack]]
        ] = {}
        for plan in layout.messages:
            key = plan.can_id | (EXTENDED if plan.extended else 0)
            multiplexer = next((s for s in plan.signals if s.role is Role.MULTIPLEXER), None)
            unpacks: dict[int | None, _Unpack] = {}
            for page in dict.fromkeys((None, *plan.pages)):
                signals = [s for s in plan.signals if s.role is Role.SOURCE and s.page == page]
                if not signals:
                    continue
                self.parts.append(Part(len(columns), len(signals), plan, page))
                unpacks[page] = (len(columns), compile_unpack(signals, f"{plan.name}{page or ''}"))
                columns += [_column(s, plan, key) for s in signals]
            self._messages[key] = (
                plan.length,
                None if multiplexer is None else _number(multiplexer),
                unpacks,
            )
        self.columns = tuple(columns)
        self._by_source = {
            (c.source, c.esc): index for index, c in reversed(list(enumerate(columns)))
        }

    @property
    def keys(self) -> frozenset[int]:
        """CAN ids of the layout's messages, with ``EXTENDED`` for 29 bits."""
        return frozenset(self._messages)

    def column_of(self, source: str, esc: int | None = None) -> int | None:
        """Index of the first column that is bound to a source; None where the layout has none."""
        return self._by_source.get((source, esc))

    def read(self, key: int, data: bytes) -> list[Chunk] | None:
        """The values of a frame; None where its id is not ours, or it is shorter than its message."""
        message = self._messages.get(key)
        if message is None or len(data) < message[0]:
            return None
        bits = int.from_bytes(data[: message[0]], "little")
        _, multiplexer, unpacks = message
        chunks = []
        if (common := unpacks.get(None)) is not None:
            chunks.append((common[0], common[1](bits)))
        if multiplexer is not None and (paged := unpacks.get(multiplexer(bits))) is not None:
            chunks.append((paged[0], paged[1](bits)))
        return chunks


_Unpack = tuple[int, Callable[[int], list[Value]]]


def compile_unpack(signals: Sequence[SignalPlan], name: str) -> Callable[[int], list[Value]]:
    """A function from the bits of a frame (bit 0 is bit 0 of byte 0) to the signals' values."""
    names: dict[str, object] = {"float_value": float_value}
    lines = ["def unpack(bits):"]
    for index, signal in enumerate(signals):
        if signal.numbers is not None:
            names[f"texts{index}"] = dict(signal.texts)
        lines += [f"    {line}" for line in _lines(signal, index)]
    lines += [f"    {line}" for line in _lost_flags(signals)]
    lines.append(f"    return [{', '.join(f'v{index}' for index in range(len(signals)))}]")
    exec(compile("\n".join(lines), f"<unpacker of {name}>", "exec"), names)  # noqa: S102  text made here, from checked plans
    return names["unpack"]  # type: ignore[return-value]


def _lost_flags(signals: Sequence[SignalPlan]) -> list[str]:
    """A flag has no code for not available: it is that where all values of the same ESC's frame that have one say so, in its message."""
    groups: dict[tuple[int | None, Group], tuple[list[str], list[str]]] = {}
    for index, signal in enumerate(signals):
        source = signal.source
        if source is None or source.group not in (Group.LIVE, Group.INFO) or source.optional:
            continue
        flags, others = groups.setdefault((signal.esc, source.group), ([], []))
        if _is_flag(signal):
            flags.append(f"v{index}")
        elif signal.is_float or not signal.low <= signal.not_available <= signal.high:
            raw = " | ".join(_piece(piece.shift, piece.width, piece.at) for piece in signal.pieces)
            others.append(f"({raw}) == {signal.not_available & (1 << signal.length) - 1}")
    lines = []
    for flags, others in groups.values():
        if flags and others:
            lines.append(f"if {' and '.join(others)}:")
            lines.append(f"    {' = '.join(flags)} = None")
    return lines


def _is_flag(signal: SignalPlan) -> bool:
    """One bit as it stands; it has no codes."""
    as_it_stands = signal.numbers is None and signal.factor == 1 and signal.offset == 0
    return signal.length == 1 and not signal.signed and not signal.is_float and as_it_stands


def float_value(
    bits: int, length: int, codes: tuple[int, ...], factor: float, offset: float
) -> float | None:
    """The physical value of a float signal's bits; None for its codes and for NaN."""
    if bits in codes:
        return None
    raw: float = struct.unpack(
        "<f" if length == 32 else "<d", bits.to_bytes(length // 8, "little")
    )[0]
    return None if raw != raw else raw * factor + offset


def _lines(signal: SignalPlan, index: int) -> list[str]:
    v = f"v{index}"
    raw = " | ".join(_piece(piece.shift, piece.width, piece.at) for piece in signal.pieces)
    if signal.is_float:
        codes = tuple(sorted({signal.not_available, signal.error}))
        return [
            f"{v} = float_value({raw}, {signal.length}, {codes}, {float(signal.factor)!r}, {float(signal.offset)!r})"
        ]
    if _is_flag(signal):
        return [f"{v} = {raw}"]
    lines = [f"{v} = {raw}"]
    if signal.signed:
        lines.append(f"if {v} >= {1 << signal.length - 1}: {v} -= {1 << signal.length}")
    # a code amid the values counts as the code: the packer sends no value that looks like it
    codes = tuple(sorted({signal.not_available, signal.error}))
    if signal.numbers is not None:
        lines.append(f"{v} = None if {v} in {codes} else texts{index}.get({v})")
        return lines
    scaled = _scaled(v, signal.factor, signal.offset)
    lines.append(f"{v} = None if {v} in {codes} else {scaled}")
    return lines


def _piece(shift: int, width: int, at: int) -> str:
    part = f"(bits >> {at} & {(1 << width) - 1:#x})"
    return f"{part} << {shift}" if shift else part


def _scaled(v: str, factor: Fraction, offset: Fraction) -> str:
    """The float nearest to the exact decimal, which prints as it stands in the DBC; an int where all are whole."""
    common = factor.denominator * offset.denominator
    a, b = int(factor * common), int(offset * common)
    text = v if a == 1 else f"{v} * {a}"
    text = text if not b else f"{text} + {b}"
    return text if common == 1 else f"({text}) / {common}"


def _number(signal: SignalPlan) -> Callable[[int], int]:
    return lambda bits: take(signal.pieces, bits)


def _column(signal: SignalPlan, plan: MessagePlan, key: int) -> Column:
    assert signal.source is not None
    if signal.is_float:
        ends = sorted(raw * float(signal.factor) + float(signal.offset) for raw in signal.limits)
        return Column(
            signal.name,
            signal.unit,
            plan.name,
            key,
            signal.source.name,
            signal.esc,
            (),
            None,
            ends[0],
            ends[1],
        )
    texts = tuple(sorted(signal.texts.items())) if signal.numbers is not None else ()
    ends = sorted(float(raw * signal.factor + signal.offset) for raw in (signal.low, signal.high))
    digits = max(_digits(signal.factor), _digits(signal.offset))
    return Column(
        signal.name,
        signal.unit,
        plan.name,
        key,
        signal.source.name,
        signal.esc,
        texts,
        digits,
        ends[0],
        ends[1],
    )


def _digits(number: Fraction) -> int:
    """Decimals of a number; 9 at most."""
    return next((digits for digits in range(9) if (number * 10**digits).denominator == 1), 9)
