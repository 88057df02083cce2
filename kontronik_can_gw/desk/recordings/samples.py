"""Makes rows of values by name, from the bytes of ESCs or from CAN frames.

From bytes, values have their full resolution (see esc/telemetry.py). From CAN frames they have the
resolution of the DBC. A row has each value that is known at the row's time, and None for each value
that is not available.

From bytes there is a row for each telemetry frame and each loss of telemetry. From CAN frames there
is a row for each group of messages. Data of another ESC, or of another message, that arrive within
5 ms are put into the same row.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, pairwise, repeat
from typing import NamedTuple

from kontronik_can_gw.core.output import Output
from kontronik_can_gw.desk.receiver.unpacker import Column, SignalReader, Value
from kontronik_can_gw.desk.receiver.view import Freshness
from kontronik_can_gw.desk.recordings.fields import ColumnType, Read, TableColumn, distinct
from kontronik_can_gw.desk.recordings.recording import LATEST_NS, LogFrame, Sample
from kontronik_can_gw.desk.recordings.replay import TimedFrame
from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry, Event
from kontronik_can_gw.esc.values import VALUES, Group, Kind
from kontronik_can_gw.frames import EXTENDED
from kontronik_can_gw.signals import units
from kontronik_can_gw.signals.plan import MessagePlan, SendType
from kontronik_can_gw.status import GatewayStatus
from kontronik_can_gw.times import MS

SAME_ROW_NS = 5 * MS
"""Longest time between the first data of a row and further data of the same row."""
GATEWAY_NS = 100 * MS
"""Period with which the gateway's own values are read."""
_DIGITS = 9
"""Decimals of a value that was converted from another unit."""


# --- from bytes


class RowMaker(Output):
    """Makes rows of the values of ``fields`` from the telemetry of ESCs.

    Complete rows are kept until ``take_rows``. ``finish`` returns the last rows.
    """

    def __init__(
        self,
        fields: Sequence[TableColumn],
        escs: Sequence[EscTelemetry],
        status: GatewayStatus,
        now: int,
    ) -> None:
        super().__init__()
        self._rows: list[Sample] = []
        self._escs = escs
        self._status = status
        self._values: list[Value] = [None] * len(fields)
        """The newest value of each field."""
        self._is_open = False
        """True while a row is being filled."""
        self._row_ns = 0
        """Time of the newest row, which is open or complete."""
        self._in_row: set[int] = set()
        """ESCs whose live frames are in the row that is being filled."""
        self._gateway_ns = now - GATEWAY_NS
        """Time at which the gateway's own values were last read."""
        self._readers: dict[int | None, list[tuple[int, Read]]] = {}
        """By ESC, or None for the gateway: index and function of each value."""
        self._ages: list[tuple[int, int, Read]] = []
        """ESC, index and function of each value that changes with time alone."""
        for index, field in enumerate(fields):
            readers = self._readers.setdefault(field.esc, [])
            readers.append((index, field.reader))
            is_age = field.value is not None and field.value.kind is Kind.AGE
            if is_age and field.esc is not None:
                self._ages.append((field.esc, index, field.reader))

    def take_rows(self) -> Sequence[Sample]:
        """Return the complete rows and forget them."""
        rows = self._rows
        self._rows = []
        return rows

    def finish(self) -> Sequence[Sample]:
        """Return the remaining rows, with the one that is being filled."""
        self._close_row()
        return self.take_rows()

    def on_event(self, esc: int, events: int, now: int) -> None:
        """Read the values of an ESC that changed."""
        if not events & (Event.LIVE | Event.LINK | Event.INFO):
            return
        state = self._escs[esc]
        is_live = bool(events & Event.LIVE)
        when = now
        if is_live and state.live is not None and state.live_ns is not None:
            when = min(now, state.live_ns)  # arrival of the frame's last byte
        when = max(when, self._row_ns)  # the times of rows never decrease
        has_frame = is_live and esc in self._in_row
        if has_frame or when - self._row_ns > SAME_ROW_NS:
            self._close_row()
        values = self._values
        status = self._status
        for index, read in self._readers.get(esc, ()):
            values[index] = read(state, status, when)
        for age_esc, index, read in self._ages:
            values[index] = read(self._escs[age_esc], status, when)
        if when - self._gateway_ns >= GATEWAY_NS or events & Event.LINK:
            self._gateway_ns = when
            for index, read in self._readers.get(None, ()):
                values[index] = read(None, status, when)
        if is_live:
            self._in_row.add(esc)
            if not self._is_open:
                self._is_open = True
                self._row_ns = when

    def _close_row(self) -> None:
        if self._is_open:
            self._rows.append(Sample(self._row_ns, tuple(self._values)))
            self._is_open = False
            self._in_row.clear()


# --- from CAN frames


def fields_of_log(reader: SignalReader, escs: Sequence[EscSettings]) -> list[TableColumn]:
    """Return a field for each signal of a layout.

    It has the name and the unit of the value to which the signal is bound.
    """
    found = []
    periods: list[int | None] = []
    for part in reader.parts:
        periods += [_period_ns(part.plan)] * part.count
    for column, period_ns in zip(reader.columns, periods, strict=True):
        prefix = ""
        if column.esc is not None and len(escs) > 1:
            prefix = f"{escs[column.esc].name}."
        unit, slope, shift = _to_value(column)
        kind = ColumnType.FLOAT
        high = column.high
        if (slope, shift) != (1, 0):
            high = (high - shift) / slope
        elif column.texts:
            kind = ColumnType.TEXT
        elif column.is_flag:
            kind = ColumnType.FLAG
        elif column.is_whole:
            kind = ColumnType.WHOLE
        field = TableColumn(
            name=prefix + column.source,
            unit=unit,
            kind=kind,
            message=column.message,
            texts=column.texts,
            source=column.source,
            esc=column.esc,
            signal=column.name,
            high=high,
            period_ns=period_ns,
        )
        found.append(field)
    return distinct(found)


def _period_ns(plan: MessagePlan) -> int | None:
    """Return the longest time between two values of a message, as in Field.period_ns."""
    if SendType.EVENT in plan.send_type and Group.LIVE in plan.paces:
        return 0
    pages = max(1, len(plan.pages))
    return plan.cycle_ns * pages or None


def _to_value(column: Column) -> tuple[str, float, float]:
    """Return (unit, slope, shift) of the value to which a signal is bound.

    ``value = (signal - shift) / slope``. If the units cannot be converted, the value keeps the
    signal's unit.
    """
    unit = VALUES[column.source].unit
    factors = units.conversion(unit, column.unit)
    if factors is None:
        return column.unit, 1, 0
    slope, shift = factors
    return unit, float(slope), float(shift)


_Change = tuple[int, int | None]
"""The number of a row, and the bits of a frame with new values. None: the values expired."""


class _Wanted(NamedTuple):
    """A signal that is a column."""

    place: int
    """Index among the columns."""
    at: int
    """Index of the signal in its part."""
    slope: float
    shift: float


class RowsOfFrames:
    """Makes rows of the ``chosen`` signals with the fresh values that a listener on the bus has.

    The values equal those of a View (tests/recordings/test_log_rows.py). But a View decodes each
    frame, and this class decodes each signal once for a block, in all frames that contain it. It is
    faster, because a recorded hour has a million frames.
    """

    def __init__(self, reader: SignalReader, chosen: Sequence[int]) -> None:
        self._reader = reader
        self._freshness = Freshness(reader.parts)
        self._times: list[int] = []
        """Times of the complete rows of the present block."""
        self._changes: list[list[_Change]] = [[] for _ in reader.parts]
        """The changes of each part in these rows and in the next one."""
        self._held: list[Value] = [None] * len(chosen)
        """Value of each column before these rows."""
        self._wanted: dict[int, list[_Wanted]] = {}
        """The chosen signals of each part."""
        for place, signal in enumerate(chosen):
            _, slope, shift = _to_value(reader.columns[signal])
            for index, part in enumerate(reader.parts):
                if part.first <= signal < part.first + part.count:
                    wanted = _Wanted(place, signal - part.first, slope, shift)
                    self._wanted.setdefault(index, []).append(wanted)
                    break

    def blocks(
        self, frames: Iterable[TimedFrame | LogFrame], count: int
    ) -> Iterator[tuple[Sequence[int], Sequence[Sequence[Value]]]]:
        """Yield times and columns of ``count`` rows as soon as these rows are complete.

        The last block may be shorter. An expiry of values makes a row of its own.
        """
        messages = self._reader.messages
        freshness = self._freshness
        times = self._times
        changes = self._changes
        row_ns: int | None = None
        in_row: set[int] = set()
        now = -LATEST_NS
        for item in frames:
            if item.time_ns > now:  # frames of several interfaces may be out of order
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
                if self._add_expiry(due + 1):
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

    def _add_expiry(self, now: int) -> bool:
        """Add a row without the values that have expired. Return False if there are none."""
        expired = self._freshness.expire(now)
        for part in expired:
            self._changes[part].append((len(self._times), None))
        if expired:
            self._times.append(now)
        return bool(expired)

    def _take_block(self) -> tuple[Sequence[int], Sequence[Sequence[Value]]]:
        """Return times and columns of the complete rows, and begin a new block."""
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
            edges = (*begins, len(times))
            lengths = [end - begin for begin, end in pairwise(edges)]
            changes.clear()
            is_dense = 2 * len(frames) > len(times)
            if is_dense:  # one value for each row is faster than many short runs
                frames = list(chain.from_iterable(map(repeat, frames, lengths)))
            fresh = [bits for bits in frames if bits is not None]
            unpacker = self._reader.parts[part].unpacker
            for place, at, slope, shift in wanted:
                values = unpacker.column(at, fresh)
                if (slope, shift) != (1, 0):
                    values = [_converted(value, slope, shift) for value in values]
                if len(fresh) < len(frames):
                    values = _with_gaps(values, frames)
                if not is_dense:
                    values = _runs(values, lengths)
                last = values[-1]
                if begins[0]:
                    values = [held[place]] * begins[0] + values
                columns[place] = values
                held[place] = last
        return times, columns


def _with_gaps(values: Sequence[Value], frames: Sequence[int | None]) -> list[Value]:
    """Return the values with None at the place of each expiry in ``frames``."""
    remaining = iter(values)
    return [None if bits is None else next(remaining) for bits in frames]


def _runs(values: Sequence[Value], lengths: Sequence[int]) -> list[Value]:
    """Return each value repeated by its length."""
    found: list[Value] = []
    for value, length in zip(values, lengths, strict=True):
        found += [value] * length
    return found


def _converted(value: Value, slope: float, shift: float) -> Value:
    if not isinstance(value, (int, float)):
        return value
    return round((value - shift) / slope, _DIGITS)
