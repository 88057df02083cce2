"""CAN frames of a layout -> values: what a logger with the DBC sees. The other way round of packer.py, from the same plans.

Each message (and multiplexer page) is a list of signals: where the raw value stands, and what makes the value of it. A value is an int
or a float in the signal's unit, a text where the signal is an enumeration, None where it is not available (or could not be sent: the
Error code). A flag, which has no code for that, is not available where the other values of its message are not.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache, partial
from typing import NamedTuple

from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.frames import EXTENDED
from kontronik_can_gw.signals.packer import float_of, has_code, place, take
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


_Unpack = Callable[[int], list[Value]]


class _Message(NamedTuple):
    """How the frames of one message are read."""

    length: int
    page_of: Callable[[int], int] | None
    """The multiplexer's value, from the bits of a frame."""
    unpacks: dict[int | None, tuple[int, _Unpack]]
    """For each page (None: every frame) the index of its first column, and what makes the values."""


class SignalReader:
    """Reads the frames of one layout. ``columns`` in the order of messages, pages and signals."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        columns: list[Column] = []
        self.parts: list[Part] = []
        self._messages: dict[int, _Message] = {}
        for plan in layout.messages:
            key = plan.can_id | (EXTENDED if plan.extended else 0)
            multiplexer = next((s for s in plan.signals if s.role is Role.MULTIPLEXER), None)
            unpacks: dict[int | None, tuple[int, _Unpack]] = {}
            for page in dict.fromkeys((None, *plan.pages)):
                signals = [s for s in plan.signals if s.role is Role.SOURCE and s.page == page]
                if not signals:
                    continue
                self.parts.append(Part(len(columns), len(signals), plan, page))
                unpacks[page] = (len(columns), unpack_of(signals))
                columns += [_column(s, plan, key) for s in signals]
            page_of = None if multiplexer is None else partial(take, multiplexer.pieces)
            self._messages[key] = _Message(plan.length, page_of, unpacks)
        self.columns = tuple(columns)

    @property
    def keys(self) -> frozenset[int]:
        """CAN ids of the layout's messages, with ``EXTENDED`` for 29 bits."""
        return frozenset(self._messages)

    def read(self, key: int, data: bytes) -> list[Chunk] | None:
        """The values of a frame; None where its id is not ours, or it is shorter than its message."""
        message = self._messages.get(key)
        if message is None or len(data) < message.length:
            return None
        length, page_of, unpacks = message
        bits = int.from_bytes(data[:length], "little")
        chunks = []
        if (common := unpacks.get(None)) is not None:
            chunks.append((common[0], common[1](bits)))
        if page_of is not None and (paged := unpacks.get(page_of(bits))) is not None:
            chunks.append((paged[0], paged[1](bits)))
        return chunks


_KEPT_VALUES = 2048
"""Values of a longer signal that are kept, because computing one takes several times as long as finding it."""
_TABLE_BITS = 8
"""Up to this length a signal's values are looked up in a table of all its raw values."""


def unpack_of(signals: Sequence[SignalPlan]) -> _Unpack:
    """A function from the bits of a frame (bit 0 is bit 0 of byte 0) to the signals' values."""
    rows = [_row(signal) for signal in signals]
    lost = _lost_flags(signals)

    def unpack(bits: int) -> list[Value]:
        values = [value_of(bits >> at & mask) for at, mask, value_of in rows]
        for flags, mask, codes in lost:
            if bits & mask == codes:
                for flag in flags:
                    values[flag] = None
        return values

    return unpack


def _row(signal: SignalPlan) -> tuple[int, int, Callable[[int], Value]]:
    """Where a signal's raw value stands, the mask of its length, and the function from it to the value."""
    value_of = _value_of(signal)
    if signal.length <= _TABLE_BITS:
        value_of = tuple(value_of(raw) for raw in range(1 << signal.length)).__getitem__
    else:
        value_of = lru_cache(_KEPT_VALUES)(value_of)
    pieces = [(piece.at, (1 << piece.width) - 1, piece.shift) for piece in signal.pieces]
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
    """A function from a signal's raw value, without its sign, to its value."""
    if signal.source is not None and not signal.source.supplied:
        return lambda _raw: None
    if _is_flag(signal):
        return int
    # a code amid the values counts as the code: the packer sends no value that looks like it
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
        texts = {raw % modulus: text for raw, text in signal.texts.items() if raw not in codes}
        return texts.get
    least_negative = modulus >> 1 if signal.signed else modulus
    common = signal.factor.denominator * signal.offset.denominator
    factor, offset = int(signal.factor * common), int(signal.offset * common)

    def number(raw: int) -> Value:
        """The float nearest to the exact decimal, which prints as it stands in the DBC; an int where all are whole."""
        if raw >= least_negative:
            raw -= modulus
        if raw in codes:
            return None
        scaled = raw * factor + offset
        return scaled if common == 1 else scaled / common

    return number


def _lost_flags(signals: Sequence[SignalPlan]) -> list[tuple[list[int], int, int]]:
    """Flags that are not available where a frame has these bits under this mask.

    A flag has no code for not available: it is that where all values of the same ESC's frame that have one say so, in its message.
    """
    groups: dict[tuple[int | None, Group], tuple[list[int], list[SignalPlan]]] = {}
    for index, signal in enumerate(signals):
        source = signal.source
        if source is None or source.group not in (Group.LIVE, Group.INFO) or source.optional:
            continue
        flags, others = groups.setdefault((signal.esc, source.group), ([], []))
        if _is_flag(signal):
            flags.append(index)
        elif has_code(signal):
            others.append(signal)
    return [
        (
            flags,
            sum(place(signal.pieces, -1) for signal in others),
            sum(place(signal.pieces, signal.not_available) for signal in others),
        )
        for flags, others in groups.values()
        if flags and others
    ]


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
    raw = float_of(bits, length)
    return None if raw != raw else raw * factor + offset


def _column(signal: SignalPlan, plan: MessagePlan, key: int) -> Column:
    assert signal.source is not None
    texts: tuple[tuple[int, str], ...] = ()
    digits = None
    if signal.is_float:
        ends = [raw * float(signal.factor) + float(signal.offset) for raw in signal.limits]
    else:
        ends = [float(raw * signal.factor + signal.offset) for raw in (signal.low, signal.high)]
        digits = max(_digits(signal.factor), _digits(signal.offset))
        texts = tuple(sorted(signal.texts.items())) if signal.numbers is not None else ()
    return Column(
        signal.name,
        signal.unit,
        plan.name,
        key,
        signal.source.name,
        signal.esc,
        texts,
        digits,
        low=min(ends),
        high=max(ends),
    )


def _digits(number: Fraction) -> int:
    """Decimals of a number; 9 at most."""
    return next((digits for digits in range(9) if (number * 10**digits).denominator == 1), 9)
