"""Rows of values by name: from bytes of ESCs through telemetry.py, in full resolution, or from CAN frames as far as these hold them.

A row holds each value as it is known at the row's time; None where it is not available. From bytes a row comes with each telemetry
frame, and with its loss; from CAN frames with each group of messages that belong together. What comes of another ESC, or in another
message, within 5 ms goes into the same row.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain, groupby
from typing import NamedTuple

from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.dbc.view import View
from kontronik_can_gw.desk.recordings.columns import Read, Section, Values
from kontronik_can_gw.desk.recordings.fields import Field, Kind, distinct, field_of_signal
from kontronik_can_gw.esc.telemetry import MS, EscSettings, EscTelemetry, Event
from kontronik_can_gw.esc.values import VALUES, Group
from kontronik_can_gw.gateway_status import GatewayStatus
from kontronik_can_gw.output import Output
from kontronik_can_gw.signals import units
from kontronik_can_gw.signals.unpacker import Column, Part, SignalReader, Value

Pick = Callable[[Sequence[Value]], Values]
SAME_ROW_NS = 5 * MS
GATEWAY_NS = 100 * MS
"""The gateway's own values are read so often."""
_DIGITS = 9
"""Decimals of a value that was in another unit."""


class Sample(NamedTuple):
    """A row. ``parts``: values of neighbouring columns; one that has not changed is the object that it was."""

    time_ns: int
    parts: tuple[Values, ...]

    @property
    def values(self) -> Values:
        """In the order of the columns."""
        return tuple(chain.from_iterable(self.parts))


# --- from bytes


class RowMaker(Output):
    """Makes rows of what ESCs say. They gather in ``rows``, which the owner empties; ``finish`` gives the last."""

    def __init__(
        self,
        sections: Sequence[Section],
        escs: Sequence[EscTelemetry],
        status: GatewayStatus,
        now: int,
    ) -> None:
        super().__init__()
        self.rows: list[Sample] = []
        self._escs = escs
        self._status = status
        self._parts: list[Values] = [section.nothing for section in sections]
        self._row_ns: int | None = None
        self._last_ns = 0
        self._in_row: set[int] = set()
        self._gateway_ns = now - GATEWAY_NS

        def readers(esc: int | None, *but: Group) -> list[tuple[int, Read]]:
            every = enumerate(sections)
            return [(i, s.read) for i, s in every if s.esc == esc and s.group not in but]

        self._by_esc = [readers(esc) for esc in range(len(escs))]
        self._with_live = [readers(esc, Group.INFO) for esc in range(len(escs))]
        self._of_gateway = readers(None)
        self._ages = [
            (s.esc, index, s.read)
            for index, s in enumerate(sections)
            if s.ages and s.esc is not None
        ]

    def take_rows(self) -> Sequence[Sample]:
        """The rows that are complete."""
        if not self.rows:
            return ()
        rows, self.rows = self.rows, []
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
        parts = self._parts
        changed = self._by_esc if events & (Event.LINK | Event.INFO) else self._with_live
        for index, read in changed[esc]:
            parts[index] = read(state, when)
        for of, index, read in self._ages:
            if of != esc:
                parts[index] = read(self._escs[of], when)
        if when - self._gateway_ns >= GATEWAY_NS or events & Event.LINK:
            self._gateway_ns = when
            for index, read in self._of_gateway:
                parts[index] = read(self._status, when)
        if events & Event.LIVE:
            self._in_row.add(esc)
            if self._row_ns is None:
                self._row_ns = when

    def _close_row(self) -> None:
        if self._row_ns is not None:
            self.rows.append(Sample(self._row_ns, tuple(self._parts)))
            self._last_ns = self._row_ns
            self._row_ns = None
            self._in_row.clear()


# --- from CAN frames


def fields_of_log(reader: SignalReader, escs: Sequence[EscSettings]) -> list[Field]:
    """A field for each signal of a layout, with the name and in the unit of the value that it is bound to."""
    found = []
    for column in reader.columns:
        field = field_of_signal(column)
        prefix = "" if column.esc is None or len(escs) == 1 else f"{escs[column.esc].name}."
        unit, slope, shift = _to_value(column)
        if (slope, shift) != (1, 0):
            field = replace(field, kind=Kind.FLOAT, high=(field.high - shift) / slope)
        found.append(replace(field, name=prefix + column.source, unit=unit))
    return distinct(found)


def _to_value(column: Column) -> tuple[str, float, float]:
    """The unit of the value that a signal is bound to, and ``value = (signal - shift) / slope``."""
    unit = VALUES[column.source].unit
    factors = units.conversion(unit, column.unit)
    return (column.unit, 1, 0) if factors is None else (unit, float(factors[0]), float(factors[1]))


def _picker(columns: Sequence[Column], first: int, chosen: Sequence[int]) -> Pick:
    """What takes the chosen columns out of the values of their part of a message, which begins with the column ``first``."""
    places = []
    for index in chosen:
        _, slope, shift = _to_value(columns[index])
        places.append((index - first, slope, shift, (slope, shift) == (1, 0)))

    def pick(values: Sequence[Value]) -> Values:
        found = []
        for place, slope, shift, is_same in places:
            value = values[place]
            if not is_same and isinstance(value, (int, float)):
                value = round((value - shift) / slope, _DIGITS)
            found.append(value)
        return tuple(found)

    return pick


def samples_of_frames(
    frames: Iterable[TimedFrame], reader: SignalReader, chosen: Sequence[int]
) -> Iterator[Sample]:
    """Rows of CAN frames, as a listener has them: values hold while they are fresh."""
    view = View(reader)
    part_of = [part for part in reader.parts for _ in range(part.count)]
    runs: list[tuple[Part, Pick]] = []
    by_first: dict[int, list[int]] = {}
    for part, neighbours in groupby(chosen, lambda column: part_of[column]):
        by_first.setdefault(part.first, []).append(len(runs))
        runs.append((part, _picker(reader.columns, part.first, list(neighbours))))

    def parts_now() -> list[Values]:
        return [pick(view.values[part.first : part.first + part.count]) for part, pick in runs]

    parts = parts_now()
    row_ns: int | None = None
    in_row: set[int] = set()
    last = 0
    for frame_ns, frame, _ in frames:
        last = time_ns = max(frame_ns, last)  # a log of several interfaces may not be in order
        key = frame.key
        if key not in reader.keys:
            continue
        if row_ns is not None and (key in in_row or time_ns - row_ns > SAME_ROW_NS):
            yield Sample(row_ns, tuple(parts))
            row_ns = None
            in_row.clear()
        while (due := view.next_expiry) is not None and due < time_ns:  # a loss is a row of its own
            if view.expire(due + 1):
                row_ns = None
                in_row.clear()
                parts = parts_now()
                yield Sample(due + 1, tuple(parts))
        chunks = view.take(key, frame.data, time_ns)
        if chunks is None:
            continue
        for first, new in chunks:
            for at in by_first.get(first, ()):
                parts[at] = runs[at][1](new)
        in_row.add(key)
        if row_ns is None:
            row_ns = time_ns
    if row_ns is not None:
        yield Sample(row_ns, tuple(parts))
