"""Message plans -> frame bits of many moments at once: what ``dbc_output.packer`` makes one by one, made in columns.

The sources' expressions are the same Python texts; here they stand over columns. Frames of more than 8 bytes have several 64-bit words.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from types import CodeType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from kontronik_can_gw.dbc_output import e2e
from kontronik_can_gw.dbc_output.layout import MessagePlan, Piece, Role, SignalPlan
from kontronik_can_gw.dbc_output.packer import _is_plain_flag, alive_modulus, place
from kontronik_can_gw.sources import Group

Column = NDArray[Any]
Bits = NDArray[np.uint64]
"""A row for each moment, a 64-bit word for each 8 bytes of the frame, the first one lowest."""
Bytes = NDArray[np.uint8]

_ROOM = 1 << 62
_WORD = (1 << 64) - 1
_CRC = np.array([e2e.crc(b"", 0, byte << 8) for byte in range(256)], np.uint8)


class Moments(Protocol):
    """Many moments of one ESC and the gateway. Attributes are columns, or one number for all.

    ``live``, ``info``: fields by their index, None where they are not available in any of the moments; in between there is nothing.
    """

    count: int
    live: Any
    info: Any
    esc: Any
    gateway: Any
    now: Column


@dataclass(frozen=True)
class _Signal:
    plan: SignalPlan
    expression: CodeType
    supplied: CodeType | None
    table: tuple[Column, Column] | None
    """Of an enumeration: by source number, whether there is a raw value, and which."""
    ends: tuple[Fraction | None, Fraction | None]


class ColumnPacker:
    """Packs one message."""

    def __init__(self, plan: MessagePlan) -> None:
        self.plan = plan
        self.words = (plan.length + 7) // 8
        self._pages = {page: [s for s in plan.signals if s.page == page] for page in {None, *plan.pages}}
        crc = next((signal for signal in plan.signals if signal.role is Role.CRC), None)
        self._crc_at = None if crc is None else crc.pieces[0].at // 8
        self._compiled = {id(s): _compiled(s) for s in plan.signals if s.source is not None}
        self._flags = {page: _flags(signals) for page, signals in self._pages.items()}
        texts = [signal.source.expression for signal in plan.signals if signal.source is not None]
        self.follows_time = any(re.search(r"\bnow\b|\bframe_rate\b", text) for text in texts)
        """True where the bits change while no frame comes."""

    def bits(self, moments: Moments, alive: Column | int = 0, page: int | None = None) -> Bits:
        """As the packer's; ``alive``: the alive counter at each moment."""
        bits = np.zeros((moments.count, self.words), np.uint64)
        with np.errstate(all="ignore"):
            for key in (None,) if page is None else (None, page):
                self._add(bits, moments, alive, key, page)
        return bits

    def put_alive(self, bits: Bits, alive: Column) -> None:
        """Write the alive counter into bits that hold 0 for it."""
        for signal in self.plan.signals:
            if signal.role is Role.ALIVE:
                _put(bits, signal.pieces, _column(alive % alive_modulus(signal, self._crc_at is not None)))

    def data(self, bits: Bits) -> Bytes:
        """The frames' bytes, with their CRC."""
        data = np.ascontiguousarray(bits.astype("<u8", copy=False)).view(np.uint8)[:, : self.plan.length]
        if self._crc_at is not None:
            value = np.full(len(data), e2e.crc(b"", 0, self.plan.data_id), np.uint8)
            for at in range(self.plan.length):
                if at != self._crc_at:
                    value = _CRC[value ^ data[:, at]]
            data[:, self._crc_at] = value
        return data

    def _add(self, bits: Bits, moments: Moments, alive: Column | int, key: int | None, page: int | None) -> None:
        constant = 0
        flags, flag_ids = self._flags[key]
        for signal in self._pages[key]:
            if signal.role is Role.CONSTANT:
                constant |= place(signal.pieces, signal.constant)
            elif signal.role is Role.MULTIPLEXER and page is not None:
                constant |= place(signal.pieces, page)
            elif signal.role is Role.ALIVE:
                modulus = alive_modulus(signal, self._crc_at is not None)
                _put(bits, signal.pieces, _column(alive % modulus))
            elif signal.source is not None:
                if signal.source.group in _FRAMES and getattr(moments, signal.source.group.value) is None:
                    constant |= place(signal.pieces, signal.not_available)
                elif id(signal) not in flag_ids:
                    self._add_signal(bits, moments, self._compiled[id(signal)])
        for group, code, moves in flags:
            if group in _FRAMES and getattr(moments, group.value) is None:
                continue
            column = _column(_eval(code, moments)).view(np.uint64)
            for distance, mask in moves.items():
                _put_masked(bits, column, mask, distance)
        if constant:
            for word_at in range(self.words):
                bits[:, word_at] |= np.uint64(constant >> 64 * word_at & _WORD)

    def _add_signal(self, bits: Bits, moments: Moments, signal: _Signal) -> None:
        plan = signal.plan
        supplied: Any = True if signal.supplied is None else _eval(signal.supplied, moments)
        if not isinstance(supplied, np.ndarray):
            if not supplied:
                _put(bits, plan.pieces, np.array([_signed(plan.not_available)], np.int64))
                return
            supplied = None
        column = _column(_eval(signal.expression, moments))
        if supplied is not None:
            supplied = supplied.astype(bool)
            column = np.where(supplied, column, 0)
        raw = _float_raw(signal, column) if plan.is_float else _raw(signal, column)
        if supplied is not None:
            raw = np.where(supplied, raw, _signed(plan.not_available))
        if len(plan.pieces) == 1 and not plan.signed and plan.length < 64:  # no bit is set beyond the length
            _put_masked(bits, np.ascontiguousarray(raw).view(np.uint64), _WORD, plan.pieces[0].at, plan.length)
            return
        _put(bits, plan.pieces, raw)


_FRAMES = (Group.LIVE, Group.INFO)
_FlagWords = list[tuple[Group, CodeType, dict[int, int]]]


def _flags(signals: Sequence[SignalPlan]) -> tuple[_FlagWords, set[int]]:
    """Flags that are bits of one word: by the word, what moves together by which distance."""
    words: dict[str, tuple[Group, CodeType, dict[int, int]]] = {}
    ids: set[int] = set()
    for signal in signals:
        source = signal.source
        if source is None or source.bit is None or not _is_plain_flag(signal):
            continue
        ids.add(id(signal))
        code = compile(source.expression, f"<{source.name}>", "eval")
        moves = words.setdefault(source.expression, (source.group, code, {}))[2]
        distance = signal.pieces[0].at - source.bit
        moves[distance] = moves.get(distance, 0) | 1 << source.bit
    return list(words.values()), ids


def _compiled(signal: SignalPlan) -> _Signal:
    source = signal.source
    assert source is not None
    text = source.expression if source.bit is None else f"{source.expression} >> {source.bit} & 1"
    table = None
    if signal.numbers is not None:
        numbers = {int(number): raw for number, raw in signal.numbers.items()}
        size = max(numbers, default=0) + 2  # the last one stands for all that are greater
        known = np.zeros(size, bool)
        raws = np.zeros(size, np.float64 if signal.is_float else np.int64)
        for number, raw in numbers.items():
            known[number] = True
            raws[number] = raw if signal.is_float else _signed(raw)
        table = known, raws
    supplied = None if source.supplied is None else compile(source.supplied, f"<{source.name}>", "eval")
    return _Signal(signal, compile(text, f"<{source.name}>", "eval"), supplied, table, _ends(signal))


def _eval(code: CodeType, moments: Moments) -> Any:
    names = {
        "esc": moments.esc,
        "live": moments.live,
        "info": moments.info,
        "gateway": moments.gateway,
        "now": moments.now,
    }
    return eval(code, {"__builtins__": {}}, names)  # noqa: S307  texts of sources.py


def _column(value: Any) -> Column:
    """A column of int64, of float64, or of Python's integers where those are too great; a number for all is a column of one."""
    if isinstance(value, np.ndarray):
        if value.dtype == np.int64 or value.dtype == np.float64 or value.dtype == object:
            return value
        return value.astype(np.float64 if value.dtype.kind == "f" else np.int64)
    if isinstance(value, float):
        return np.array([value])
    number = int(value)
    return np.array([number], np.int64 if -_ROOM < number < _ROOM else object)


def _signed(code: int) -> int:
    """The 64-bit pattern of a code as an int64 has it."""
    code &= _WORD
    return code - (1 << 64) if code >> 63 else code


def _looked_up(table: tuple[Column, Column], column: Column) -> tuple[Column, Column]:
    known, raws = table
    at = np.clip(column, 0, len(known) - 1).astype(np.int64)
    return known[at], raws[at]


def _raw(signal: _Signal, column: Column) -> Column:
    """Raw values and codes as 64-bit patterns."""
    plan, source = signal.plan, signal.plan.source
    assert source is not None
    error = _signed(plan.error)
    if signal.table is not None:
        known, raws = _looked_up(signal.table, column)
        return np.where(known, raws, error)
    if source.rolls:
        return _patterns(column % (plan.high + 1)) if plan.high < _ROOM else _patterns(_wide(column) % (plan.high + 1))
    if source.whole:
        value = _scaled(column, plan.slope, plan.intercept)
    else:
        value = _rounded(column * float(plan.slope) + float(plan.intercept))
    least, most = signal.ends
    wrong = None
    if least is None or least < plan.low:
        wrong = ~_at_least(value, plan.low)
    if most is None or most > plan.high:
        above = ~_at_most(value, plan.high)
        wrong = above if wrong is None else wrong | above
    if plan.low <= plan.not_available <= plan.high:  # a code amid the values: a true value must not look like it
        hides = ((value if abs(plan.not_available) < _ROOM else _wide(value)) == plan.not_available).astype(bool)
        wrong = hides if wrong is None else wrong | hides
    patterns = _patterns(value)
    if wrong is None or not wrong.any():
        return patterns
    return np.where(wrong, error, patterns)


def _ends(signal: SignalPlan) -> tuple[Fraction | None, Fraction | None]:
    """Least and greatest raw value that the source can give; None where it has no bound."""
    source = signal.source
    assert source is not None
    if source.low is None or source.high is None or not source.whole:
        return None, None
    ends = [end * signal.slope + signal.intercept for end in (source.low, source.high)]
    return min(ends), max(ends)


def _float_raw(signal: _Signal, column: Column) -> Column:
    plan = signal.plan
    if signal.table is not None:
        known, values = _looked_up(signal.table, column)
        values = np.where(known, values, np.nan)
    else:
        values = (column * float(plan.slope) + float(plan.intercept)).astype(np.float64)
    low, high = plan.limits
    inside = (low <= values) & (values <= high)
    if plan.length == 32:
        short = values.astype(np.float32)
        inside &= np.isfinite(short) | ~np.isfinite(values)
        patterns = short.view(np.uint32).astype(np.int64)
    else:
        patterns = np.ascontiguousarray(values).view(np.int64)
    inside &= patterns != _signed(plan.not_available)
    return np.where(inside, patterns, _signed(plan.error))


def _scaled(column: Column, slope: Fraction, intercept: Fraction) -> Column:
    """``x * slope + intercept`` rounded to the nearest, halves up, exactly."""
    if slope == 1 and intercept == 0:
        return column
    if slope.denominator == 1 and intercept.denominator == 1:
        a, b, divisor = int(slope), int(intercept), 1
    else:
        common = slope.denominator * intercept.denominator
        a, b, divisor = int(slope * common) * 2, int(intercept * common) * 2 + common, 2 * common
    if column.dtype != object and len(column):
        peak = max(abs(int(column.max())), abs(int(column.min())))
        if peak * abs(a) + abs(b) >= _ROOM or divisor >= _ROOM:
            column = _wide(column)
    value = column * a + b
    return value if divisor == 1 else value // divisor


def _rounded(column: Column) -> Column:
    """Floats to the nearest integers, halves to the even one, as round() does."""
    if len(column) and not np.all(np.abs(column) < float(_ROOM)):
        return np.array([round(value) for value in column.tolist()], object)
    return np.rint(column).astype(np.int64)


def _wide(column: Column) -> Column:
    """Python's integers, which have no end."""
    return column.astype(object)


def _at_least(column: Column, low: int) -> Column:
    if column.dtype == object or -_ROOM < low < _ROOM:
        return (column >= low).astype(bool, copy=False)
    return np.full(len(column), low < 0)


def _at_most(column: Column, high: int) -> Column:
    if column.dtype == object or -_ROOM < high < _ROOM:
        return (column <= high).astype(bool, copy=False)
    return np.full(len(column), high > 0)


def _patterns(column: Column) -> Column:
    """64-bit patterns: of Python's integers the low 64 bits."""
    if column.dtype == object:
        return (column & _WORD).astype(np.uint64).view(np.int64)
    return column


def _put(bits: Bits, pieces: Sequence[Piece], raw: Column) -> None:
    patterns = np.ascontiguousarray(raw).view(np.uint64)
    for piece in pieces:
        moved = patterns >> np.uint64(piece.shift) if piece.shift else patterns
        _put_masked(bits, moved, (1 << piece.width) - 1, piece.at)


def _put_masked(bits: Bits, patterns: Column, mask: int, distance: int, width: int = 64) -> None:
    """``(patterns & mask) << distance``, downward where it is negative, over the words' borders. ``width``: of the patterns, at most."""
    if mask != _WORD:
        patterns = patterns & np.uint64(mask)
    if distance < 0:
        patterns, distance = patterns >> np.uint64(-distance), 0
    word, up = divmod(distance, 64)
    if word < bits.shape[1]:
        bits[:, word] |= patterns << np.uint64(up) if up else patterns
    if up and up + min(width, mask.bit_length()) > 64 and word + 1 < bits.shape[1]:
        bits[:, word + 1] |= patterns >> np.uint64(64 - up)
