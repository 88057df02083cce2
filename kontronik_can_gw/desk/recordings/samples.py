"""Rows of values by name: from bytes of ESCs through telemetry.py, in full resolution, or from CAN frames as far as these hold them.

A row holds each value as it is known at the row's time; None where it is not available. From bytes a row comes with each telemetry
frame, and with its loss; from CAN frames with each group of messages that belong together. What comes of another ESC, or in another
message, within 5 ms goes into the same row.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby

from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.core.output import Output
from kontronik_can_gw.dbc.view import View
from kontronik_can_gw.desk.recordings.fields import Field, Kind, Read, distinct
from kontronik_can_gw.desk.recordings.recording import LATEST_NS, Sample
from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry, Event
from kontronik_can_gw.esc.values import VALUES, Group
from kontronik_can_gw.esc.values import Kind as How
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


PartsOfRow = tuple[Sequence[Value], ...]
"""The values of a row in lists, one for each part of the SignalReader."""


class ColumnMaker:
    """Makes columns of the ``chosen`` signals from rows. Most lists of a row are those of the row before, which saves most of the work."""

    def __init__(self, reader: SignalReader, chosen: Sequence[int]) -> None:
        self._width = len(chosen)
        self._wanted: dict[int, list[tuple[int, int]]] = {}
        """By part: places among the columns, and in the part's list."""
        for place, at in enumerate(chosen):
            index, part = next(
                (index, part)
                for index, part in enumerate(reader.parts)
                if part.first <= at < part.first + part.count
            )
            self._wanted.setdefault(index, []).append((place, at - part.first))
        scales = [(place, *_to_value(reader.columns[at])[1:]) for place, at in enumerate(chosen)]
        self._scales = [one for one in scales if one[1:] != (1, 0)]

    def columns(self, rows: Sequence[PartsOfRow]) -> list[Sequence[Value]]:
        """The columns of some rows, in the units of the values."""
        found: list[Sequence[Value]] = [()] * self._width
        for index, wanted in self._wanted.items():
            lists = [row[index] for row in rows]
            if 2 * len(set(map(id, lists))) > len(lists):
                every = [*zip(*lists, strict=True)]
                for place, at in wanted:
                    found[place] = every[at]
                continue
            runs = [(next(run), 1 + sum(1 for _ in run)) for _, run in groupby(lists, id)]
            for place, at in wanted:
                column: list[Value] = []
                for values, count in runs:
                    column += [values[at]] * count
                found[place] = column
        for place, slope, shift in self._scales:
            found[place] = [_converted(value, slope, shift) for value in found[place]]
        return found


def _converted(value: Value, slope: float, shift: float) -> Value:
    is_number = isinstance(value, (int, float))
    return round((value - shift) / slope, _DIGITS) if is_number else value  # type: ignore[operator]


def samples_of_frames(
    frames: Iterable[TimedFrame], reader: SignalReader, chosen: Sequence[int]
) -> Iterator[Sample]:
    """Rows of CAN frames, one by one."""
    maker = ColumnMaker(reader, chosen)
    for time_ns, parts in rows_of_frames(frames, reader):
        yield Sample(time_ns, tuple(column[0] for column in maker.columns([parts])))


def rows_of_frames(
    frames: Iterable[TimedFrame], reader: SignalReader
) -> Iterator[tuple[int, PartsOfRow]]:
    """Time and values of each row, as a listener on the bus has them: values hold while they are fresh."""
    view = View(reader)

    def row(time_ns: int) -> tuple[int, PartsOfRow]:
        return time_ns, tuple(view.of_parts)

    row_ns: int | None = None
    in_row: set[int] = set()
    last = -LATEST_NS
    keys = reader.keys
    for frame_ns, frame, _ in frames:
        if frame_ns > last:  # a log of several interfaces may not be in order
            last = frame_ns
        time_ns = last
        key = frame.key
        if key not in keys:
            continue
        if row_ns is not None and (key in in_row or time_ns - row_ns > SAME_ROW_NS):
            yield row(row_ns)
            row_ns = None
            in_row.clear()
        while (due := view.next_expiry) is not None and due < time_ns:  # a loss is a row of its own
            if view.expire(due + 1):
                row_ns = None
                in_row.clear()
                yield row(due + 1)
        if view.take(key, frame.data, time_ns) is None:
            continue
        in_row.add(key)
        if row_ns is None:
            row_ns = time_ns
    if row_ns is not None:
        yield row(row_ns)
