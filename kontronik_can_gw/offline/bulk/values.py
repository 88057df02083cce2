"""Signals of a layout in columns: what ``dbc_output.packer`` and ``dbc_output.unpacker`` make of many moments one by one, at once.

The sources' expressions are the same Python texts; here they stand over columns. A column that is the same in all moments has length 1.
What cannot be computed in 64 bits raises ``Unsuited``: then the streaming way does it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from kontronik_can_gw.dbc_output.layout import SignalPlan
from kontronik_can_gw.sources import Group

Array = NDArray[Any]
_ROOM = 1 << 62
_DIRECT = 1 << 12
_EXACT = 1 << 53
"""Floats hold every whole number up to here."""


class Unsuited(ArithmeticError):
    """These values have no place in columns."""


class Values(NamedTuple):
    """A column: its values in steps of 1 / ``divisor`` (of a text, the place in the signal's texts).

    ``valid``: where they are available; None: everywhere.
    """

    numbers: Array
    valid: NDArray[np.bool_] | None = None
    divisor: int = 1


@dataclass(frozen=True)
class Steps:
    """Whole numbers ``start + step * counts``, which may be too large for 64 bits."""

    start: int
    step: int
    counts: NDArray[np.int64]

    def exact(self) -> list[int]:
        """As Python numbers."""
        return [self.start + self.step * count for count in self.counts.tolist()]


class Moments(Protocol):
    """Many moments of one ESC and the gateway: what the expressions name. Attributes are columns, or one value for all.

    ``live`` and ``info`` give fields by their index; None where they are not available in any of the moments.
    """

    live: Any
    info: Any
    esc: Any
    gateway: Any
    now: Any


@dataclass(frozen=True)
class Range:
    """Whole numbers and between which of them they all are."""

    numbers: NDArray[np.int64]
    low: int
    high: int

    @classmethod
    def of(cls, numbers: NDArray[np.int64]) -> "Range":
        """Looked for."""
        return cls(numbers, int(numbers.min()), int(numbers.max()))


class Table:
    """``table.get(x, default)`` of columns."""

    def __init__(self, table: Mapping[int, int], default: int) -> None:
        self.fits = all(-_ROOM < number < _ROOM for number in (*table, *table.values(), default))
        self._default = default
        known = sorted(table) if self.fits else []
        self._known = np.array(known, np.int64)
        self._values = np.array([*(table[number] for number in known), default if self.fits else 0], np.int64)
        self._first, self._last = (known[0], known[-1]) if known else (0, 0)
        self._direct: NDArray[np.int64] | None = None
        if known and self._last - self._first < _DIRECT:
            self._direct = np.full(self._last - self._first + 3, default, np.int64)  # one more at each end
            self._direct[self._known - self._first + 1] = self._values[:-1]

    def of(self, found: Range) -> NDArray[np.int64]:
        """Unsuited where the table has numbers that are too large."""
        if not self.fits:
            raise Unsuited
        column = found.numbers
        if not len(self._known):
            return np.full(1, self._default, np.int64)
        if self._direct is not None:
            if found.low < self._first - 1:
                column = np.maximum(column, self._first - 1)
            if found.high > self._last + 1:
                column = np.minimum(column, self._last + 1)
            return self._direct[column - (self._first - 1)]
        at = np.minimum(np.searchsorted(self._known, column), len(self._known) - 1)
        return self._values[np.where(self._known[at] == column, at, len(self._known))]


class ColumnReader:
    """Computes one signal. ``message``: the signals that come together with it."""

    def __init__(self, plan: SignalPlan, message: Sequence[SignalPlan] = ()) -> None:
        self.plan = plan
        self._is_flag = is_flag(plan)
        self._others: list[ColumnReader] = []
        """Those of the message by which a flag is known to be lost."""
        if self._is_flag and (group := _lost_with(plan)) is not None:
            self._others = [
                ColumnReader(other)
                for other in message
                if _lost_with(other) == group
                and not is_flag(other)
                and (other.is_float or not other.low <= other.not_available <= other.high)
            ]
        self._is_never_lost = any(other.is_never_missing for other in self._others)
        self._places = Table({raw: place for place, (raw, _) in enumerate(sorted(plan.texts.items()))}, -1)
        numbers = {} if plan.numbers is None else {int(number): raw for number, raw in plan.numbers.items()}
        self._numbers = Table(numbers, plan.error if numbers and not plan.is_float else 0)
        self._known = Table(dict.fromkeys(numbers, 1), 0)
        self._codes = {plan.not_available, plan.error}
        self._divisor = plan.factor.denominator * plan.offset.denominator
        self._steps = 1 if plan.is_float or plan.numbers is not None else self._divisor
        self._factor, self._constant = int(plan.factor * self._divisor), int(plan.offset * self._divisor)
        self._scaler = _Scaler(plan.slope, plan.intercept)

    def read(self, moments: Moments) -> Values:
        """The signal at these moments."""
        plan = self.plan
        source = plan.source
        assert source is not None
        group = source.group
        if (group is Group.LIVE and moments.live is None) or (group is Group.INFO and moments.info is None):
            return self._nothing()
        supplied: Any = True
        if source.supplied is not None:
            supplied = np.atleast_1d(np.asarray(_evaluated(source.supplied, moments), np.bool_))
            if not supplied.any():
                return self._nothing(supplied=False)
            if supplied.all():
                supplied = True
        found = self._flag(moments) if self._is_flag else self._value(moments)
        if supplied is True:
            return found
        if self._is_flag:
            values = np.where(supplied, found.numbers, plan.not_available & 1)
            return Values(values)
        valid = supplied if found.valid is None else supplied & found.valid
        return Values(found.numbers, valid, found.divisor)

    def _nothing(self, supplied: bool = True) -> Values:
        """Not available at all. A flag has no code for that where no other value of its message has one."""
        values: Array = np.zeros(1, np.float64 if self.plan.is_float else np.int64)
        if not self._is_flag or (supplied and self._others):
            return Values(values, np.zeros(1, np.bool_), self._steps)
        return Values(values + (self.plan.not_available & 1))

    def _flag(self, moments: Moments) -> Values:
        plan, source = self.plan, self.plan.source
        assert source is not None
        found, valid = self._raw(moments)
        raw = found.numbers
        if source.bit is None and plan.error != plan.not_available and plan.low <= plan.not_available <= plan.high:
            valid = _both(valid, raw != plan.not_available)
        if valid is not None:
            raw = np.where(valid, raw, plan.error & 1)
        if self._is_never_lost:
            return Values(raw)
        lost: Any = None
        for other in self._others:
            missing = other.looks_missing(moments)
            if missing is None:
                return Values(raw)
            lost = missing if lost is None else lost & missing
        if lost is None or not lost.any():
            return Values(raw)
        return Values(raw, ~lost)

    def _value(self, moments: Moments) -> Values:
        plan = self.plan
        if plan.is_float:
            return self._float(moments)
        found, valid = self._raw(moments)
        raw = found.numbers
        for code in self._codes:
            if found.low <= code <= found.high:
                valid = _both(valid, raw != code)
        if plan.numbers is not None:
            places = self._places.of(found)
            return Values(places, _both(valid, places >= 0))
        a, b, divisor = self._factor, self._constant, self._divisor
        room = _EXACT if divisor > 1 else _ROOM
        if max(abs(found.low), abs(found.high)) * abs(a) + abs(b) >= room:
            if valid is None:
                raise Unsuited
            found = Range.of(np.where(valid, raw, 0))
            if max(abs(found.low), abs(found.high)) * abs(a) + abs(b) >= room:
                raise Unsuited
            raw = found.numbers
        if a != 1:
            raw = raw * a
        if b:
            raw = raw + b
        return Values(raw, valid, divisor)

    def _raw(self, moments: Moments) -> tuple[Range, NDArray[np.bool_] | None]:
        """The raw value that is sent, and where it is one; elsewhere the Error code is sent."""
        plan, source = self.plan, self.plan.source
        assert source is not None
        found = _evaluated(source.expression, moments)
        if source.bit is not None:
            found = _bit(found, source.bit)
        if plan.numbers is not None:
            return Range.of(self._numbers.of(Range.of(_whole(found)))), None
        if source.rolls:
            raw = Range.of(_whole(found))
            if not 0 <= raw.low <= raw.high <= plan.high:
                raw = Range.of(raw.numbers % min(plan.high + 1, _ROOM))
            return raw, None
        if source.whole:
            raw = Range.of(self._scaler.of(found))
        else:
            with np.errstate(all="ignore"):
                scaled = np.asarray(found, np.float64) * float(plan.slope) + float(plan.intercept)
            finite = np.isfinite(scaled)  # where there is no value the device does not supply it
            if np.abs(scaled[finite]).max(initial=0) >= _EXACT:
                raise Unsuited
            raw = Range.of(np.rint(np.where(finite, scaled, 0)).astype(np.int64))
        valid: NDArray[np.bool_] | None = None
        if raw.low < plan.low or raw.high > plan.high:
            low, high = max(plan.low, -_ROOM), min(plan.high, _ROOM)
            valid = (raw.numbers >= low) & (raw.numbers <= high)
        return raw, valid

    def _float(self, moments: Moments) -> Values:
        plan = self.plan
        bits, right = self._float_bits(moments)
        valid: NDArray[np.bool_] | None = None if right.all() else right
        raw = bits.astype(np.float64)
        for code in self._codes:
            valid = _both(valid, bits.view(_BITS[plan.length]) != code)
        valid = _both(valid, ~np.isnan(raw))
        return Values(raw * float(plan.factor) + float(plan.offset), valid)

    def _float_bits(self, moments: Moments) -> tuple[Array, NDArray[np.bool_]]:
        """The float that is sent, and where it is a value; elsewhere the Error code is sent."""
        plan, source = self.plan, self.plan.source
        assert source is not None
        found = _evaluated(source.expression, moments)
        if source.bit is not None:
            found = _bit(found, source.bit)
        if plan.numbers is not None:
            whole = Range.of(_whole(found))
            scaled = np.where(self._known.of(whole) == 1, self._numbers.of(whole).astype(np.float64), np.nan)
        else:
            scaled = _as_float(found) * float(plan.slope) + float(plan.intercept)
        low, high = plan.limits
        with np.errstate(over="ignore", invalid="ignore"):
            right = (scaled >= low) & (scaled <= high)
            bits = scaled.astype(_FLOATS[plan.length])
        right &= np.isfinite(bits) | ~np.isfinite(scaled)
        right &= bits.view(_BITS[plan.length]) != plan.not_available
        return bits, right

    @property
    def is_never_missing(self) -> bool:
        """True where every value of the source is sent as one."""
        plan, source = self.plan, self.plan.source
        if source is None or plan.is_float or plan.numbers is not None or not source.whole or source.bit is not None:
            return False
        if source.low is None or source.high is None or plan.low <= plan.not_available <= plan.high:
            return False
        ends = [end * plan.slope + plan.intercept for end in (source.low, source.high)]
        return plan.low <= min(ends) and max(ends) <= plan.high

    def looks_missing(self, moments: Moments) -> NDArray[np.bool_] | None:
        """Where the signal is sent as not available although its group is there; None: nowhere."""
        plan = self.plan
        if plan.is_float:
            bits, right = self._float_bits(moments)
            same = plan.error == plan.not_available
            missing = ~right if same else right & (bits.view(_BITS[plan.length]) == plan.not_available)
        else:
            raw, valid = self._raw(moments)
            missing = raw.numbers == plan.not_available
            if valid is not None:
                missing = np.where(valid, missing, plan.error == plan.not_available)
        return missing if missing.any() else None


_FLOATS: dict[int, Any] = {32: np.dtype("<f4"), 64: np.dtype("<f8")}
_BITS: dict[int, Any] = {32: np.dtype("<u4"), 64: np.dtype("<u8")}


def is_flag(plan: SignalPlan) -> bool:
    """One bit as it stands, which has no codes."""
    as_it_stands = plan.numbers is None and plan.factor == 1 and plan.offset == 0
    return plan.length == 1 and not plan.signed and not plan.is_float and as_it_stands


def _lost_with(plan: SignalPlan) -> tuple[int | None, Group] | None:
    """What a flag is lost with: the values of the same frame of the same ESC."""
    source = plan.source
    if source is None or source.group not in (Group.LIVE, Group.INFO) or source.supplied is not None:
        return None
    return plan.esc, source.group


_COMPILED: dict[str, Any] = {}


def _evaluated(expression: str, moments: Moments) -> Any:
    code = _COMPILED.get(expression)
    if code is None:
        code = _COMPILED[expression] = compile(expression, "<source>", "eval")
    names = {
        "live": moments.live,
        "info": moments.info,
        "esc": moments.esc,
        "gateway": moments.gateway,
        "now": moments.now,
    }
    with np.errstate(divide="ignore", invalid="ignore"):
        return eval(code, {"__builtins__": {}}, names)  # noqa: S307  texts of sources.py


def _whole(found: Any) -> NDArray[np.int64]:
    """Whole numbers as a column."""
    if isinstance(found, Steps):
        return np.array(_held(found.exact()), np.int64)
    if isinstance(found, int) and not -_ROOM < found < _ROOM:
        raise Unsuited
    return np.atleast_1d(np.asarray(found, np.int64))


def _held(numbers: list[int]) -> list[int]:
    if any(not -_ROOM < number < _ROOM for number in numbers):
        raise Unsuited
    return numbers


def _bit(found: Any, bit: int) -> Array:
    """One bit of a word; of length 1 where it never changes."""
    word = np.atleast_1d(np.asarray(found))
    if len(word) > 1 and not int(np.bitwise_or.reduce(word ^ word[0])) >> bit & 1:
        word = word[:1]
    return word >> bit & 1


class _Scaler:
    """``x * slope + intercept``, rounded to the nearest, halves up."""

    def __init__(self, slope: Fraction, intercept: Fraction) -> None:
        common = slope.denominator * intercept.denominator
        self._factor, self._constant = int(slope * common), int(intercept * common)
        self._divisor = 1
        if common > 1:
            self._factor, self._constant, self._divisor = 2 * self._factor, 2 * self._constant + common, 2 * common

    def of(self, found: Any) -> NDArray[np.int64]:
        """Unsuited where the results are too large."""
        factor, constant, divisor = self._factor, self._constant, self._divisor
        if isinstance(found, Steps):
            start, rest = divmod(found.start * factor + constant, divisor)
            step, part = divmod(found.step * factor, divisor)
            most = int(found.counts.max())
            if rest + part * most < _ROOM and abs(start) + abs(step) * most < _ROOM:
                if not most:
                    return np.full(1, start, np.int64)
                return start + step * found.counts + (rest + part * found.counts) // divisor
            return np.array(_held([(number * factor + constant) // divisor for number in found.exact()]), np.int64)
        whole = _whole(found)
        if factor == divisor == 1 and not constant:
            return whole
        if max(abs(int(whole.min())), abs(int(whole.max()))) * abs(factor) + abs(constant) >= _ROOM:
            numbers = [(number * factor + constant) // divisor for number in whole.tolist()]
            return np.array(_held(numbers), np.int64)
        if divisor >= _ROOM:
            raise Unsuited
        scaled = whole * factor + constant if factor != 1 or constant else whole
        return scaled if divisor == 1 else scaled // divisor


def _as_float(found: Any) -> NDArray[np.float64]:
    if isinstance(found, Steps):
        return np.array([float(number) for number in found.exact()], np.float64)
    if isinstance(found, int):
        return np.array([float(found)], np.float64)
    return np.atleast_1d(np.asarray(found)).astype(np.float64)


def _both(valid: NDArray[np.bool_] | None, further: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    if further.all():
        return valid
    return further if valid is None else valid & further
