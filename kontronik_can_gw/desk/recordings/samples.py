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
from kontronik_can_gw.desk.recordings.columns import Section, Values
from kontronik_can_gw.desk.recordings.fields import Field, Kind, distinct, field_of_signal
from kontronik_can_gw.esc.decoder import Reading
from kontronik_can_gw.esc.telemetry import MS, EscSettings, EscStream, EscTelemetry, Event
from kontronik_can_gw.esc.values import VALUES, Group
from kontronik_can_gw.gateway_status import GatewayState, GatewayStatus
from kontronik_can_gw.output import Output
from kontronik_can_gw.signals import units
from kontronik_can_gw.signals.unpacker import Column, Part, SignalReader, Value

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
        listed = [(s.esc, s.group, index, s.read) for index, s in enumerate(sections)]
        self._by_esc = [
            [(index, read) for of, _, index, read in listed if of == esc]
            for esc in range(len(escs))
        ]
        self._with_live = [
            [
                (index, read)
                for of, group, index, read in listed
                if of == esc and group is not Group.INFO
            ]
            for esc in range(len(escs))
        ]
        self._of_gateway = [(index, read) for of, _, index, read in listed if of is None]
        self._ages = [(s.esc, index, s.read) for index, s in enumerate(sections) if s.ages]

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
        begun = self._last_ns if row_ns is None else row_ns
        if when < begun:  # rows do not go back
            when = begun
        if row_ns is not None:
            again = events & Event.LIVE and esc in self._in_row
            if again or when - row_ns > SAME_ROW_NS:
                self._close_row()
        parts = self._parts
        changed = self._by_esc if events & (Event.LINK | Event.INFO) else self._with_live
        for index, read in changed[esc]:
            parts[index] = read(state, when)
        for of, index, read in self._ages:
            if of is not None and of != esc:
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


class FoundTelemetry(EscStream):
    """Telemetry of bytes whose times are only known when their frames are found."""

    def find(self, data: bytes) -> Sequence[Reading]:
        """The readings of the next bytes; of none, what is left."""
        return self.decoder.feed(data) if data else self.decoder.flush()

    def take(self, reading: Reading, now: int) -> int:
        """A reading that came at a time; its events."""
        return self.accept(reading, now, now)


def samples_of_bytes(
    esc: FoundTelemetry,
    found: Iterable[tuple[int, bytes, Reading | None]],
    sections: Sequence[Section],
) -> Iterator[Sample]:
    """The rows of one ESC's frames (time, bytes, frame); a gateway runs from the first one on."""
    status = GatewayStatus(GatewayState.RUNNING, esc_count=1)
    maker = RowMaker(sections, [esc], status, 0)
    due = 0
    for now, _, frame in found:
        if frame is None:
            continue
        while due < now and (due := esc.next_deadline()) < now:
            maker.on_event(0, esc.advance(due), due)
        events = esc.take(frame, now)
        if events & Event.LINK:
            status.escs_ok = int(esc.up)
            due = 0
        maker.on_event(0, events, now)
        if maker.rows:
            yield from maker.take_rows()
    yield from maker.finish()


# --- from CAN frames


def fields_of_log(reader: SignalReader, escs: Sequence[EscSettings]) -> list[Field]:
    """A field for each signal of a layout, with the name and in the unit of the value that it is bound to."""
    found = []
    for column in reader.columns:
        field = field_of_signal(column)
        prefix = "" if column.esc is None or len(escs) == 1 else f"{escs[column.esc].name}."
        field = replace(field, name=prefix + column.source)
        unit, slope, shift = _to_value(column)
        if (slope, shift) != (1, 0):
            field = replace(field, kind=Kind.FLOAT, high=(field.high - shift) / slope)
        found.append(replace(field, unit=unit))
    return distinct(found)


def _to_value(column: Column) -> tuple[str, float, float]:
    """The unit of the value that a signal is bound to, and ``value = (signal - shift) / slope``."""
    unit = VALUES[column.source].unit
    factors = units.conversion(unit, column.unit)
    return (column.unit, 1, 0) if factors is None else (unit, float(factors[0]), float(factors[1]))


def _brought(column: Column) -> Callable[[Value], Value] | None:
    """From the signal to the value; None where both are the same."""
    _, slope, shift = _to_value(column)
    if (slope, shift) == (1, 0):
        return None
    return lambda value: (
        round((value - shift) / slope, _DIGITS) if isinstance(value, (int, float)) else value
    )


class _Run:
    """Neighbouring columns of a table that come in one part of a message."""

    def __init__(self, reader: SignalReader, columns: Sequence[int], part: Part) -> None:
        self.nothing: Values = (None,) * len(columns)
        self._places = [column - part.first for column in columns]
        self._changes = [_brought(reader.columns[column]) for column in columns]
        self._plain = not any(self._changes)

    def of(self, values: Sequence[Value]) -> Values:
        """The values of the columns out of those of the part."""
        picked = [values[place] for place in self._places]
        if not self._plain:
            both = zip(picked, self._changes, strict=True)
            picked = [value if change is None else change(value) for value, change in both]
        return tuple(picked)


def samples_of_frames(
    frames: Iterable[TimedFrame], reader: SignalReader, chosen: Sequence[int]
) -> Iterator[Sample]:
    """Rows of CAN frames, as a listener has them: values hold while they are fresh."""
    view = View(reader)
    part_of = [index for index, part in enumerate(reader.parts) for _ in range(part.count)]
    runs: list[tuple[Part, _Run]] = []
    for index, columns in groupby(chosen, lambda column: part_of[column]):
        runs.append((reader.parts[index], _Run(reader, list(columns), reader.parts[index])))
    by_first: dict[int, list[int]] = {}
    for at, (part, _) in enumerate(runs):
        by_first.setdefault(part.first, []).append(at)
    parts = [run.nothing for _, run in runs]
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
                parts = [run.of(view.values[p.first : p.first + p.count]) for p, run in runs]
                yield Sample(due + 1, tuple(parts))
        chunks = view.take(key, frame.data, time_ns)
        if chunks is None:
            continue
        for first, new in chunks:
            for at in by_first.get(first, ()):
                parts[at] = runs[at][1].of(new)
        in_row.add(key)
        if row_ns is None:
            row_ns = time_ns
    if row_ns is not None:
        yield Sample(row_ns, tuple(parts))
