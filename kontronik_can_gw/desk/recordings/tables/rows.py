"""Rows of a table out of a recording: which columns, from when to when, how many a second."""

import fnmatch
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import chain
from operator import itemgetter
from typing import Any, NamedTuple, Protocol, TypeVar

from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.desk.recordings.samples import Sample
from kontronik_can_gw.desk.recordings.tables.fields import Table, fields_of, frame_fields
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.frames import EXTENDED
from kontronik_can_gw.signals.unpacker import Column, SignalReader, Value

SECOND_NS = 1_000_000_000
DISORDER_NS = SECOND_NS
"""Frames of several interfaces may stand in a log a little out of order."""
T = TypeVar("T")


class Row(NamedTuple):
    """A row. ``time_ns``: since the recording's start. ``wall_ns``: Unix time, None where unknown."""

    time_ns: int
    wall_ns: int | None
    values: tuple[Value, ...]


class Recording(Protocol):
    """What rows need of an Input."""

    provenance: dict[str, str]

    @property
    def reader(self) -> SignalReader: ...
    def frames(self) -> Iterator[TimedFrame]: ...
    def samples(self) -> Iterator[Sample]: ...
    def wall_ns(self, time_ns: int) -> int | None: ...


@dataclass(frozen=True)
class Choice:
    """What of a recording is wanted. Times in ns since its start, ``end_ns`` included; ``rate``: rows a second."""

    columns: Sequence[int]
    start_ns: int | None = None
    end_ns: int | None = None
    rate: float | None = None

    @classmethod
    def of(
        cls,
        columns: Sequence[Column],
        names: Sequence[str] = (),
        esc: int | None = None,
        **times: Any,
    ) -> "Choice":
        """The columns whose signal has one of these names (with * and ?), of one ESC. UserError for a name that fits none."""
        chosen: list[int] = []
        problems = []
        for name in names:
            found = [
                i
                for i, c in enumerate(columns)
                if fnmatch.fnmatchcase(c.name.lower(), name.lower())
            ]
            if not found:
                close = get_close_matches(name, [c.name for c in columns], 1, 0.5)
                problems.append(
                    f"--signals {name}: no such signal."
                    + (f" Did you mean {close[0]}?" if close else "")
                )
            chosen += [i for i in found if i not in chosen]
        if problems:
            raise UserError(*problems)
        if not names:
            chosen = list(range(len(columns)))
        if esc is not None:
            chosen = [i for i in chosen if columns[i].esc == esc]
        if not chosen:
            raise UserError("no signal is left: --esc and --signals leave out each other's")
        return cls(chosen, **times)


def first_of(items: Iterator[T]) -> tuple[T | None, Iterator[T]]:
    """The first item, None where there is none, and all of them."""
    first = next(items, None)
    return first, items if first is None else chain((first,), items)


class Rows:
    """The rows of a recording: iterate once.

    ``table`` describes them; None where the recording has nothing.
    """

    def __init__(self, recording: Recording, choice: Choice, by_frame: bool = False) -> None:
        self._recording = recording
        self._choice = choice
        self._names = _frame_names(recording.reader, choice)
        columns = recording.reader.columns
        fields = fields_of([columns[index] for index in choice.columns])
        items: Iterator[Row]
        self.table: Table | None = None
        self._rows: Iterator[Row] = iter(())
        if by_frame:
            first_frame, frames = first_of(recording.frames())
            origin_ns = None if first_frame is None else first_frame.time_ns
            items = self._of_frames(frames, origin_ns or 0)
            fields = [*frame_fields(self._names.values()), *fields]
        else:
            first, samples = first_of(recording.samples())
            origin_ns = None if first is None else first.time_ns
            items = self._of_samples(samples, origin_ns or 0)
        if origin_ns is None:
            return
        if choice.start_ns is not None or choice.end_ns is not None:
            items = _cut(items, choice.start_ns, choice.end_ns)
        if choice.rate is not None:
            items = thinned(items, choice.rate, (lambda row: row.values[1]) if by_frame else None)
        first_row, self._rows = first_of(items)
        if first_row is None:
            return
        wall_ns = recording.wall_ns(origin_ns)
        self.table = Table(fields, wall_ns is not None, by_frame, wall_ns, recording.provenance)

    def __iter__(self) -> Iterator[Row]:
        return self._rows

    def _of_samples(self, samples: Iterator[Sample], origin_ns: int) -> Iterator[Row]:
        pick = _picker(self._choice.columns)
        wall_ns = self._recording.wall_ns
        for time_ns, values in samples:
            yield Row(time_ns - origin_ns, wall_ns(time_ns), pick(values))

    def _of_frames(self, frames: Iterator[TimedFrame], origin_ns: int) -> Iterator[Row]:
        reader, names = self._recording.reader, self._names
        pick = _picker(self._choice.columns)
        wall_ns = self._recording.wall_ns
        count = len(reader.columns)
        for time_ns, frame, _ in frames:
            head = names.get(frame.key)
            if head is None or (chunks := reader.read(frame.key, frame.data)) is None:
                # shorter than its message
                continue
            values: list[Value] = [None] * count
            for first, new in chunks:
                values[first : first + len(new)] = new
            yield Row(time_ns - origin_ns, wall_ns(time_ns), head + pick(values))


def _frame_names(reader: SignalReader, choice: Choice) -> dict[int, tuple[str, str]]:
    """Id as candump writes it and message, of each message with a chosen signal."""
    found = {}
    for index in choice.columns:
        column = reader.columns[index]
        can_id = column.key & ~EXTENDED
        found[column.key] = (
            f"{can_id:08X}" if column.key & EXTENDED else f"{can_id:03X}",
            column.message,
        )
    return found


def _cut(rows: Iterator[Row], start_ns: int | None, end_ns: int | None) -> Iterator[Row]:
    for row in rows:
        if start_ns is not None and row.time_ns < start_ns:
            continue
        if end_ns is not None and row.time_ns > end_ns:
            if row.time_ns > end_ns + DISORDER_NS:
                return
            continue
        yield row


def thinned(
    rows: Iterator[Row], rate: float, by: Callable[[Row], object] | None = None
) -> Iterator[Row]:
    """At most ``rate`` rows a second, the newest of each period; ``by`` tells rows apart that do not stand for each other."""
    period = SECOND_NS / rate
    held: dict[object, Row] = {}
    now = None
    for row in rows:
        slot = int(row.time_ns // period)
        if slot != now:
            yield from sorted(held.values(), key=lambda one: one.time_ns)
            held.clear()
            now = slot
        held[None if by is None else by(row)] = row
    yield from sorted(held.values(), key=lambda one: one.time_ns)


def _picker(columns: Sequence[int]) -> Callable[[Sequence[Value]], tuple[Value, ...]]:
    if len(columns) == 1:
        only = columns[0]
        return lambda values: (values[only],)
    return itemgetter(*columns)
