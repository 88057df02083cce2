"""Rows of values by name: from bytes of ESCs through telemetry.py, in full resolution, or from CAN frames as far as these hold them.

A row holds each value as it is known at the row's time; None where it is not available. From bytes a row comes with each telemetry
frame, and with its loss; from CAN frames with each group of messages that belong together. What comes of another ESC, or in another
message, within 5 ms goes into the same row.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, pairwise, repeat
from typing import NamedTuple

from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.core.output import Output
from kontronik_can_gw.dbc.view import Freshness
from kontronik_can_gw.desk.recordings.fields import Field, Kind, Read, distinct
from kontronik_can_gw.desk.recordings.recording import LATEST_NS, LogFrame, Sample
from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry, Event
from kontronik_can_gw.esc.values import VALUES, Group
from kontronik_can_gw.esc.values import Kind as How
from kontronik_can_gw.frames import EXTENDED
from kontronik_can_gw.signals import units
from kontronik_can_gw.signals.plan import MessagePlan, SendType
from kontronik_can_gw.signals.unpacker import Column, SignalReader, Value
from kontronik_can_gw.status import GatewayStatus
from kontronik_can_gw.times import MS

SAME_ROW_NS = 5 * MS
GATEWAY_NS = 100 * MS
"""The gateway's own values are read so often."""
_DIGITS = 9
"""Decimals of a value that was in another unit."""


# --- from bytes


class RowMaker(Output):
    """Makes rows of what ESCs say: the values of ``fields``. They gather until ``take_rows``; ``finish`` gives the last."""

    def __init__(
        self,
        fields: Sequence[Field],
        escs: Sequence[EscTelemetry],
        status: GatewayStatus,
        now: int,
    ) -> None:
        super().__init__()
        self._rows: list[Sample] = []
        self._escs = escs
        self._status = status
        self._values: list[Value] = [None] * len(fields)
        self._row_ns: int | None = None
        self._last_ns = 0
        self._in_row: set[int] = set()
        self._gateway_ns = now - GATEWAY_NS
        self._readers: dict[int | None, list[tuple[int, Read]]] = {}
        self._ages: list[tuple[int, int, Read]] = []
        for index, field in enumerate(fields):
            self._readers.setdefault(field.esc, []).append((index, field.reader))
            if field.value and field.value.kind is How.AGE and field.esc is not None:
                self._ages.append((field.esc, index, field.reader))

    def take_rows(self) -> Sequence[Sample]:
        """The rows that are complete."""
        rows, self._rows = self._rows, []
        return rows

    def finish(self) -> Sequence[Sample]:
        """The rows that are left."""
        self._close_row()
        return self.take_rows()

    def on_event(self, esc: int, events: int, now: int) -> None:
        """Something changed with an ESC."""
        if not events & (Event.LIVE | Event.LINK | Event.INFO):
            return
        state, when, row_ns = self._escs[esc], now, self._row_ns
        if events & Event.LIVE and state.live is not None and state.live_ns is not None:
            when = min(now, state.live_ns)  # of its last byte on the wire
        when = max(when, self._last_ns if row_ns is None else row_ns)  # rows do not go back
        if row_ns is not None:
            again = events & Event.LIVE and esc in self._in_row
            if again or when - row_ns > SAME_ROW_NS:
                self._close_row()
        values, status = self._values, self._status
        for index, read in self._readers.get(esc, ()):
            values[index] = read(state, status, when)
        for of, index, read in self._ages:
            values[index] = read(self._escs[of], status, when)
        if when - self._gateway_ns >= GATEWAY_NS or events & Event.LINK:
            self._gateway_ns = when
            for index, read in self._readers.get(None, ()):
                values[index] = read(None, status, when)
        if events & Event.LIVE:
            self._in_row.add(esc)
            if self._row_ns is None:
                self._row_ns = when

    def _close_row(self) -> None:
        if self._row_ns is not None:
            self._rows.append(Sample(self._row_ns, tuple(self._values)))
            self._last_ns = self._row_ns
            self._row_ns = None
            self._in_row.clear()


# --- from CAN frames


def fields_of_log(reader: SignalReader, escs: Sequence[EscSettings]) -> list[Field]:
    """A field for each signal of a layout, with the name and in the unit of the value that it is bound to."""
    found = []
    periods = [_period_ns(part.plan) for part in reader.parts for _ in range(part.count)]
    for column, period_ns in zip(reader.columns, periods, strict=True):
        prefix = "" if column.esc is None or len(escs) == 1 else f"{escs[column.esc].name}."
        unit, slope, shift = _to_value(column)
        kind, high = Kind.FLOAT, column.high
        if (slope, shift) != (1, 0):
            high = (high - shift) / slope
        elif column.texts:
            kind = Kind.TEXT
        elif column.is_flag:
            kind = Kind.FLAG
        elif column.is_whole:
            kind = Kind.WHOLE
        what = prefix + column.source, unit, kind, column.message, column.texts, column.source
        found.append(Field(*what, column.esc, column.name, high, period_ns=period_ns))
    return distinct(found)


def _period_ns(plan: MessagePlan) -> int | None:
    if SendType.EVENT in plan.send_type and Group.LIVE in plan.paces:
        return 0
    return plan.cycle_ns * max(1, len(plan.pages)) or None


def _to_value(column: Column) -> tuple[str, float, float]:
    """The unit of the value that a signal is bound to, and ``value = (signal - shift) / slope``."""
    unit = VALUES[column.source].unit
    factors = units.conversion(unit, column.unit)
    return (column.unit, 1, 0) if factors is None else (unit, float(factors[0]), float(factors[1]))


_Change = tuple[int, int | None]
"""A row, and the bits of the frame with which it began. None: the values ceased to be fresh."""


class _Wanted(NamedTuple):
    """A signal that is a column: its place among the columns, and in its part."""

    place: int
    at: int
    slope: float
    shift: float


class RowsOfFrames:
    """Rows of the ``chosen`` signals as a listener on the bus has them, while they are fresh.

    They are those of a View (tests/recordings/test_log_rows.py). But a View decodes each frame, and
    this class decodes each signal once a block, in all frames that have it: a recorded hour has a
    million frames.
    """

    def __init__(self, reader: SignalReader, chosen: Sequence[int]) -> None:
        self._reader = reader
        self._freshness = Freshness(reader.parts)
        self._times: list[int] = []
        """Times of the rows that are complete."""
        self._changes: list[list[_Change]] = [[] for _ in reader.parts]
        """For each part, what it had in these rows and in the next one."""
        self._held: list[Value] = [None] * len(chosen)
        """Value of each column in front of these rows."""
        self._wanted: dict[int, list[_Wanted]] = {}
        for place, at in enumerate(chosen):
            index, part = next(
                (index, part)
                for index, part in enumerate(reader.parts)
                if part.first <= at < part.first + part.count
            )
            _, slope, shift = _to_value(reader.columns[at])
            wanted = _Wanted(place, at - part.first, slope, shift)
            self._wanted.setdefault(index, []).append(wanted)

    def blocks(
        self, frames: Iterable[TimedFrame | LogFrame], count: int
    ) -> Iterator[tuple[Sequence[int], Sequence[Sequence[Value]]]]:
        """Yield times and columns of ``count`` rows at once, as soon as these are complete."""
        messages, freshness = self._reader.messages, self._freshness
        times, changes = self._times, self._changes
        row_ns: int | None = None
        in_row: set[int] = set()
        now = -LATEST_NS
        for item in frames:
            if item.time_ns > now:  # a log of several interfaces may not be in order
                now = item.time_ns
            frame = item.frame
            key = frame.can_id | EXTENDED if frame.extended else frame.can_id
            if (message := messages.get(key)) is None:
                continue
            if row_ns is not None and (key in in_row or now - row_ns > SAME_ROW_NS):
                times.append(row_ns)
                if len(times) == count:
                    yield self._take_block()
                row_ns = None
                in_row.clear()
            while (due := freshness.next_expiry) is not None and due < now:
                if expired := freshness.expire(due + 1):  # a loss is a row of its own
                    for part in expired:
                        changes[part].append((len(times), None))
                    times.append(due + 1)
                    if len(times) == count:
                        yield self._take_block()
                    row_ns = None
                    in_row.clear()
            length, parts, _, page_of = message
            data = frame.data
            if len(data) < length:
                continue
            bits = int.from_bytes(data[:length], "little")
            if page_of is not None:
                parts = message.in_frame(bits)
            for part in parts:
                changes[part].append((len(times), bits))
            freshness.note(parts, now)
            in_row.add(key)
            if row_ns is None:
                row_ns = now
        if row_ns is not None:
            times.append(row_ns)
        if times:
            yield self._take_block()

    def _take_block(self) -> tuple[Sequence[int], Sequence[Sequence[Value]]]:
        """Times and columns of the rows that are complete."""
        times = [*self._times]
        self._times.clear()
        held = self._held
        columns: list[Sequence[Value]] = [()] * len(held)
        for part, wanted in self._wanted.items():
            changes = self._changes[part]
            if not changes:
                for place, *_ in wanted:
                    columns[place] = [held[place]] * len(times)
                continue
            frames = [bits for _, bits in changes]
            begins = [row for row, _ in changes]
            lengths = [end - begin for begin, end in pairwise((*begins, len(times)))]
            changes.clear()
            is_dense = 2 * len(frames) > len(times)
            if is_dense:  # a value for each row is faster than many short runs
                frames = [*chain.from_iterable(map(repeat, frames, lengths))]
            fresh = [bits for bits in frames if bits is not None]
            unpacker = self._reader.parts[part].unpacker
            for place, at, slope, shift in wanted:
                values = unpacker.column(at, fresh)
                if (slope, shift) != (1, 0):
                    values = [_converted(value, slope, shift) for value in values]
                if len(fresh) < len(frames):
                    each = iter(values)
                    values = [None if bits is None else next(each) for bits in frames]
                if not is_dense:
                    values = _runs(values, lengths)
                columns[place] = [held[place]] * begins[0] + values if begins[0] else values
                held[place] = values[-1]
        return times, columns


def _runs(values: Sequence[Value], lengths: Sequence[int]) -> list[Value]:
    """Each value as often as its length tells."""
    found: list[Value] = []
    for value, length in zip(values, lengths, strict=True):
        found += [value] * length
    return found


def _converted(value: Value, slope: float, shift: float) -> Value:
    is_number = isinstance(value, (int, float))
    return round((value - shift) / slope, _DIGITS) if is_number else value  # type: ignore[operator]
