"""Decodes the CAN frames of a layout into values, as a logger with the DBC does.

It uses the same plans as packer.py. A value is an integer or a float in the signal's unit, or a
text if the signal is an enumeration. It is None if the value is not available, or if the frame has
the Error code because the value did not fit. A flag has no code. It is None if the other values of
its message are not available.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache, partial
from typing import Any, NamedTuple

from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.signals.packer import extract, float_of, has_code, place
from kontronik_can_gw.signals.plan import MessageLayout, MessagePlan, Role, SignalPlan

Value = int | float | str | None
Chunk = tuple[int, list[Value]]
"""Index of the first of some neighbouring columns, and their values."""


@dataclass(frozen=True)
class Column:
    """One signal of a layout that has a source.

    Alive counters, CRCs, multiplexers and constants are not columns.
    """

    name: str
    """Name of the signal in the DBC."""
    unit: str
    message: str
    key: int
    """CAN id of the message, with ``EXTENDED`` for an id of 29 bits."""
    source: str
    """Name of the value in values.py to which the signal is bound."""
    esc: int | None
    """Index of the ESC. None for a value of the gateway."""
    texts: tuple[tuple[int, str], ...] = ()
    """Raw values and texts of an enumeration, ordered by raw value. Empty for a number."""
    digits: int | None = 0
    """Decimals that are needed to write every value. None for a float."""
    low: float = 0
    """Smallest value that can be sent, in ``unit``."""
    high: float = 0
    """Greatest value that can be sent, in ``unit``."""

    @property
    def is_flag(self) -> bool:
        """True if the value is one bit."""
        is_bit = self.low == 0 and self.high == 1
        return is_bit and self.is_whole

    @property
    def is_whole(self) -> bool:
        """True if every value is a whole number."""
        return not self.texts and self.digits == 0


@dataclass(frozen=True)
class Part:
    """Neighbouring columns that are always in the same frames of a message.

    They are the columns without a page, or the columns of one page.
    """

    first: int
    """Index of the first column."""
    count: int
    """Number of columns."""
    plan: MessagePlan
    page: int | None
    unpacker: "Unpacker"
    """Decodes the columns."""


class FrameParts(NamedTuple):
    """Which parts the frames of one message have. Parts are indices of ``SignalReader.parts``."""

    length: int
    """Shorter frames are ignored."""
    common: tuple[int, ...]
    """The part that is in every frame, if there is one."""
    paged: dict[int, int]
    """The part of each page, which is in the frames with this value of the multiplexer."""
    page_of: Callable[[int], int] | None
    """Returns the multiplexer's value. None if the message has no multiplexer."""

    def in_frame(self, bits: int) -> tuple[int, ...]:
        """Return the parts that a frame has."""
        if self.page_of is None:
            return self.common
        page = self.paged.get(self.page_of(bits))
        return self.common if page is None else (*self.common, page)


class SignalReader:
    """Decodes the frames of one layout. Its ``columns`` are ordered by message, page and signal."""

    def __init__(self, layout: MessageLayout) -> None:
        self.layout = layout
        columns: list[Column] = []
        self.parts: list[Part] = []
        self.messages: dict[int, FrameParts] = {}
        """The layout's messages by CAN id, with ``EXTENDED`` for ids of 29 bits."""
        for plan in layout.messages:
            key = plan.key
            all_signals = plan.signals
            part_of_page: dict[int | None, int] = {}
            for page in dict.fromkeys((None, *plan.pages)):
                signals = [s for s in all_signals if s.role is Role.SOURCE and s.page == page]
                if not signals:
                    continue
                part_of_page[page] = len(self.parts)
                unpacker = Unpacker(signals)
                part = Part(
                    len(columns),
                    len(signals),
                    plan,
                    page,
                    unpacker,
                )
                self.parts.append(part)
                columns += [_column(signal, plan, key) for signal in signals]
            multiplexers = (s for s in all_signals if s.role is Role.MULTIPLEXER)
            page_of = next((partial(extract, each.pieces) for each in multiplexers), None)
            paged: Any = part_of_page.copy()
            common = (paged.pop(None),) if None in paged else ()
            self.messages[key] = FrameParts(plan.length, common, paged, page_of)
        self.columns = tuple(columns)

    @property
    def keys(self) -> frozenset[int]:
        """CAN ids of the layout's messages, with ``EXTENDED`` for ids of 29 bits."""
        return frozenset(self.messages)

    def read(self, key: int, data: bytes) -> list[Chunk] | None:
        """Return the values of a frame.

        None if the layout has no message with this id, or if the frame is shorter than its message.
        """
        message = self.messages.get(key)
        if message is None or len(data) < message.length:
            return None
        bits = int.from_bytes(data[: message.length], "little")
        parts = [self.parts[index] for index in message.in_frame(bits)]
        return [(part.first, part.unpacker.values(bits)) for part in parts]


_KEPT_VALUES = 2048
"""Values of a longer signal that are kept. Computing one takes several times as long."""
_TABLE_BITS = 8
"""Signals of at most this length are decoded with a table of all raw values."""


class Unpacker:
    """Decodes signals from a frame's bits. Bit 0 is bit 0 of byte 0."""

    def __init__(self, signals: Sequence[SignalPlan]) -> None:
        self._rows = [_row(signal) for signal in signals]
        self._lost = _conditions_of_lost_flags(signals)

    def values(self, bits: int) -> list[Value]:
        """Return the values of all signals in one frame."""
        values = [value_of(bits >> at & mask) for at, mask, value_of in self._rows]
        for flags, mask, codes in self._lost:
            if bits & mask == codes:
                for flag in flags:
                    values[flag] = None
        return values

    def column(self, index: int, frames: Sequence[int]) -> list[Value]:
        """Return the values of one signal in many frames.

        Its twin is ``values``, which takes three times as long for a recording
        (tests/signals/test_unpacker_against_cantools.py).
        """
        at, mask, value_of = self._rows[index]
        values = [*map(value_of, [bits >> at & mask for bits in frames])]
        for flags, mask, codes in self._lost:
            if index in flags:
                values = [
                    None if bits & mask == codes else value
                    for bits, value in zip(frames, values, strict=True)
                ]
        return values


def _row(signal: SignalPlan) -> tuple[int, int, Callable[[int], Value]]:
    """Return position, mask and function of a signal.

    ``function(bits >> position & mask)`` is its value.
    """
    value_of = _value_of(signal)
    if signal.length <= _TABLE_BITS:
        table = tuple(value_of(raw) for raw in range(1 << signal.length))
        value_of = table.__getitem__
    else:
        value_of = lru_cache(_KEPT_VALUES)(value_of)
    pieces = []
    for piece in signal.pieces:
        mask = (1 << piece.width) - 1
        pieces.append((piece.at, mask, piece.shift))
    if len(pieces) == 1:
        ((at, mask, _),) = pieces
        return at, mask, value_of

    def value_of_pieces(bits: int) -> Value:
        raw = 0
        for at, mask, shift in pieces:
            raw |= (bits >> at & mask) << shift
        return value_of(raw)

    return 0, -1, value_of_pieces


def _value_of(signal: SignalPlan) -> Callable[[int], Value]:
    """Return a function that maps a signal's unsigned raw value to its value."""
    if signal.source is not None and not signal.source.supplied:
        return lambda _raw: None
    if _is_flag(signal):
        return int
    # If a code lies within the values, it means the code: the packer never sends such a value.
    codes = tuple(sorted({signal.not_available, signal.error}))
    if signal.is_float:
        return partial(
            float_value,
            length=signal.length,
            codes=codes,
            factor=float(signal.factor),
            offset=float(signal.offset),
        )
    modulus = 1 << signal.length
    if signal.numbers is not None:
        texts = {}
        for raw, text in signal.texts.items():
            if raw not in codes:
                texts[raw % modulus] = text
        return texts.get
    least_negative = modulus >> 1 if signal.signed else modulus
    common = signal.factor.denominator * signal.offset.denominator
    factor = int(signal.factor * common)
    offset = int(signal.offset * common)

    def number(raw: int) -> Value:
        """Return an int if all values are whole, or else the float nearest to the exact value.

        That float is printed with the decimals of the DBC's factor.
        """
        if raw >= least_negative:
            raw -= modulus
        if raw in codes:
            return None
        value = raw * factor + offset
        return value if common == 1 else value / common

    return number


def _conditions_of_lost_flags(
    signals: Sequence[SignalPlan],
) -> list[tuple[list[int], int, int]]:
    """Return flags, mask and codes: the flags are not available if ``bits & mask == codes``.

    A flag has no code. It is not available if all other signals in its message, from the
    same kind of frame of the same ESC, have their code for "not available".
    """
    flags: defaultdict[tuple[int | None, Group], list[int]] = defaultdict(list)
    masks: defaultdict[tuple[int | None, Group], int] = defaultdict(int)
    codes: defaultdict[tuple[int | None, Group], int] = defaultdict(int)
    for index, signal in enumerate(signals):
        source = signal.source
        if source is None or source.optional:
            continue
        if source.group not in (Group.LIVE, Group.INFO):
            continue
        frame = (signal.esc, source.group)
        if _is_flag(signal):
            flags[frame].append(index)
        elif has_code(signal):
            masks[frame] |= place(signal.pieces, -1)
            codes[frame] |= place(signal.pieces, signal.not_available)
    return [(flags[frame], masks[frame], codes[frame]) for frame in flags if masks[frame]]


def _is_flag(signal: SignalPlan) -> bool:
    """Return True for a single bit that is sent unchanged. Such a signal has no codes."""
    is_scaled = signal.numbers is not None or signal.factor != 1 or signal.offset != 0
    return signal.length == 1 and not signal.signed and not signal.is_float and not is_scaled


def float_value(
    bits: int,
    length: int,
    codes: tuple[int, ...],
    factor: float,
    offset: float,
) -> float | None:
    """Return the physical value of a float signal. None for its codes and for NaN."""
    if bits in codes:
        return None
    raw = float_of(bits, length)
    if math.isnan(raw):
        return None
    return raw * factor + offset


def _column(signal: SignalPlan, plan: MessagePlan, key: int) -> Column:
    assert signal.source is not None
    texts: tuple[tuple[int, str], ...] = ()
    digits = None
    if signal.is_float:
        factor = float(signal.factor)
        offset = float(signal.offset)
        ends = [raw * factor + offset for raw in signal.limits]
    else:
        raws = (signal.low, signal.high)
        ends = [float(raw * signal.factor + signal.offset) for raw in raws]
        digits = max(_count_decimals(signal.factor), _count_decimals(signal.offset))
        if signal.numbers is not None:
            texts = tuple(sorted(signal.texts.items()))
    return Column(
        name=signal.name,
        unit=signal.unit,
        message=plan.name,
        key=key,
        source=signal.source.name,
        esc=signal.esc,
        texts=texts,
        digits=digits,
        low=min(ends),
        high=max(ends),
    )


def _count_decimals(number: Fraction) -> int:
    """Return the decimals that write the number exactly, 9 at most."""
    for digits in range(9):
        if (number * 10**digits).denominator == 1:
            return digits
    return 9
