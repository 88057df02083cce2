"""Rows of a table out of a recording: which columns, from when to when, how many a second."""

import fnmatch
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import chain, groupby
from operator import itemgetter
from typing import Any, NamedTuple, TypeVar

from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.desk.recordings.columns import Values
from kontronik_can_gw.desk.recordings.fields import (
    Field,
    Table,
    distinct,
    field_of_signal,
    frame_fields,
)
from kontronik_can_gw.desk.recordings.recording import Input
from kontronik_can_gw.desk.recordings.samples import Sample
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.frames import EXTENDED
from kontronik_can_gw.signals.unpacker import SignalReader, Value

SECOND_NS = 1_000_000_000
DISORDER_NS = SECOND_NS
"""Frames of several interfaces may stand in a log a little out of order."""
T = TypeVar("T")
Timed = TypeVar("Timed", "Row", TimedFrame)


class Row(NamedTuple):
    """A row. ``time_ns``: since the recording's start. ``wall_ns``: Unix time, None where unknown.

    ``parts``: values of neighbouring fields. A part that has not changed is the object that it was; None: it is of another frame.
    """

    time_ns: int
    wall_ns: int | None
    parts: tuple[Values | None, ...]


def fields_of_frames(recording: Input) -> list[Field]:
    """The fields of a table of CAN frames: the signals of the DBC."""
    return distinct([field_of_signal(column) for column in recording.reader.columns])


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
        fields: Sequence[Field],
        names: Sequence[str] = (),
        esc: int | None = None,
        **times: Any,
    ) -> "Choice":
        """The fields with one of these names (with * and ?), of one ESC. UserError for a name that fits none.

        Case, underscores and dots do not matter, nor ``Percent`` at the end. With several ESCs a name may be that of a value alone; of
        a CAN log it may be the signal's.
        """
        chosen: list[int] = []
        problems = []
        known = [
            {_plain(one.name), _plain(one.name.rpartition(".")[2]), _plain(one.signal)}
            for one in fields
        ]
        for name in names:
            wanted = _plain(name)
            found = [
                index
                for index, called in enumerate(known)
                if any(
                    fnmatch.fnmatchcase(one, form)
                    for one in called
                    for form in (wanted, wanted.removesuffix("percent"))
                    if one and form
                )
            ]
            if not found:
                shown = {_plain(one.name): one.name for one in reversed(fields)}
                close = get_close_matches(wanted, shown, 1, 0.5)
                more = f" Did you mean {shown[close[0]]}?" if close else ""
                problems.append(f"--signals {name}: no such signal.{more}")
            chosen += [index for index in found if index not in chosen]
        if problems:
            raise UserError(*problems)
        if not names:
            chosen = list(range(len(fields)))
        if esc is not None:
            chosen = [index for index in chosen if fields[index].esc == esc]
        if not chosen:
            raise UserError("no signal is left: --esc and --signals leave out each other's")
        return cls(chosen, **times)


def _plain(name: str) -> str:
    return name.lower().replace("_", "").replace(".", "")


def first_of(items: Iterator[T]) -> tuple[T | None, Iterator[T]]:
    """The first item, None where there is none, and all of them."""
    first = next(items, None)
    return first, items if first is None else chain((first,), items)


class Rows:
    """The rows of a recording: iterate once.

    ``table`` describes them; None where the recording has nothing.
    """

    def __init__(self, recording: Input, choice: Choice, by_frame: bool = False) -> None:
        self._recording = recording
        self._choice = choice
        every = fields_of_frames(recording) if by_frame else recording.fields
        fields = [every[index] for index in choice.columns]
        items: Iterator[Row]
        self.table: Table | None = None
        self._rows: Iterator[Row] = iter(())
        if by_frame:
            names = _frame_names(recording.reader, choice)
            first_frame, frames = first_of(recording.frames())
            origin_ns = None if first_frame is None else first_frame.time_ns
            runs = self._runs()
            items = self._of_frames(frames, origin_ns or 0, names, runs)
            widths = [2, *(len(columns) for _, columns in runs)]
            fields = [*frame_fields(names.values()), *fields]
        else:
            first, samples = first_of(recording.samples(choice.columns))
            origin_ns = None if first is None else first.time_ns
            items = self._of_samples(samples, origin_ns or 0)
            widths = [] if first is None else list(map(len, first.parts))
        if origin_ns is None:
            return
        if choice.start_ns is not None or choice.end_ns is not None:
            items = cut(items, choice.start_ns, choice.end_ns)
        if choice.rate is not None:
            items = thinned(items, choice.rate, (lambda row: row.parts[0]) if by_frame else None)
        first_row, self._rows = first_of(items)
        if first_row is None:
            return
        wall_ns = recording.wall_ns(origin_ns)
        has_utc, provenance = wall_ns is not None, recording.provenance
        self.table = Table(fields, has_utc, by_frame, wall_ns, provenance, widths)

    def __iter__(self) -> Iterator[Row]:
        return self._rows

    def _of_samples(self, samples: Iterator[Sample], origin_ns: int) -> Iterator[Row]:
        wall_ns = self._recording.wall_ns
        for time_ns, parts in samples:
            yield Row(time_ns - origin_ns, wall_ns(time_ns), parts)

    def _runs(self) -> list[tuple[int, list[int]]]:
        """Neighbouring columns of one message, and its id."""
        columns = self._recording.reader.columns
        runs = groupby(self._choice.columns, lambda index: columns[index].key)
        return [(key, list(indices)) for key, indices in runs]

    def _of_frames(
        self,
        frames: Iterator[TimedFrame],
        origin_ns: int,
        names: Mapping[int, tuple[str, str]],
        runs: Sequence[tuple[int, Sequence[int]]],
    ) -> Iterator[Row]:
        reader, wall_ns = self._recording.reader, self._recording.wall_ns
        picks = [(key, _picker(indices)) for key, indices in runs]
        count = len(reader.columns)
        for time_ns, frame, _ in frames:
            key = frame.key
            head = names.get(key)
            if head is None or (chunks := reader.read(key, frame.data)) is None:
                # shorter than its message
                continue
            values: list[Value] = [None] * count
            for first, new in chunks:
                values[first : first + len(new)] = new
            parts = [pick(values) if of == key else None for of, pick in picks]
            yield Row(time_ns - origin_ns, wall_ns(time_ns), (head, *parts))


def _frame_names(reader: SignalReader, choice: Choice) -> dict[int, tuple[str, str]]:
    """Id as candump writes it and message, of each message with a chosen signal."""
    found = {}
    for index in choice.columns:
        column = reader.columns[index]
        can_id = column.key & ~EXTENDED
        name = f"{can_id:08X}" if column.key & EXTENDED else f"{can_id:03X}"
        found[column.key] = name, column.message
    return found


def cut(
    items: Iterator[Timed], start_ns: int | None, end_ns: int | None, origin_ns: int = 0
) -> Iterator[Timed]:
    """The items from one time to another, both after ``origin_ns``; ``end_ns`` included."""
    for item in items:
        since = item.time_ns - origin_ns
        if start_ns is not None and since < start_ns:
            continue
        if end_ns is not None and since > end_ns:
            if since > end_ns + DISORDER_NS:
                return
            continue
        yield item


def thinned(
    rows: Iterator[Row], rate: float, by: Callable[[Row], object] | None = None
) -> Iterator[Row]:
    """At most ``rate`` rows a second, the newest of each period; ``by`` separates rows that do not replace each other."""
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


def _picker(columns: Sequence[int]) -> Callable[[Sequence[Value]], Values]:
    if len(columns) == 1:
        only = columns[0]
        return lambda values: (values[only],)
    return itemgetter(*columns)
