"""Rows of a table out of a recording: which columns, from when to when, how many a second."""

import fnmatch
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from itertools import chain, groupby
from typing import Any, NamedTuple, TypeVar

from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.desk.recordings.blocks import DISORDER_NS, RowBlock
from kontronik_can_gw.desk.recordings.columns import Values
from kontronik_can_gw.desk.recordings.fields import (
    Field,
    Table,
    distinct,
    field_of_signal,
    frame_fields,
)
from kontronik_can_gw.desk.recordings.recording import Input
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.frames import EXTENDED
from kontronik_can_gw.signals.unpacker import Column, Value

SECOND_NS = 1_000_000_000
T = TypeVar("T")


class Row(NamedTuple):
    """A row. ``time_ns``: since the recording's start. ``wall_ns``: Unix time, None where unknown. ``values``: of each field."""

    time_ns: int
    wall_ns: int | None
    values: Values


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
        chosen: dict[int, None] = {} if names else dict.fromkeys(range(len(fields)))
        problems = []
        known = [
            {_plain(one.name), _plain(one.name.rpartition(".")[2]), _plain(one.signal)} - {""}
            for one in fields
        ]
        for name in names:
            wanted = _plain(name)
            forms = {wanted, wanted.removesuffix("percent")} - {""}
            found = [
                index
                for index, called in enumerate(known)
                if any(fnmatch.filter(called, form) for form in forms)
            ]
            if not found:
                shown = {_plain(one.name): one.name for one in reversed(fields)}
                close = get_close_matches(wanted, shown, 1, 0.5)
                more = f" Did you mean {shown[close[0]]}?" if close else ""
                problems.append(f"--signals {name}: no such signal.{more}")
            chosen |= dict.fromkeys(found)
        if problems:
            raise UserError(*problems)
        columns = [index for index in chosen if esc is None or fields[index].esc == esc]
        if not columns:
            raise UserError("no signal is left: --esc and --signals leave out each other's")
        return cls(columns, **times)


def _plain(name: str) -> str:
    return name.lower().replace("_", "").replace(".", "")


def first_of(items: Iterator[T]) -> tuple[T | None, Iterator[T]]:
    """The first item, None where there is none, and all of them."""
    first = next(items, None)
    return first, items if first is None else chain((first,), items)


def rows_of(
    recording: Input, choice: Choice, by_frame: bool = False
) -> tuple[Table | None, Iterator[Row | RowBlock]]:
    """The rows of a recording, and the table that describes them; None where the recording has nothing."""
    if not by_frame and choice.rate is None:
        blocks = recording.blocks(choice.columns)
        if blocks is not None:
            return _in_blocks(recording, choice, blocks)
    wall_ns = recording.wall_ns
    every = fields_of_frames(recording) if by_frame else recording.fields
    fields = [every[index] for index in choice.columns]
    items: Iterator[Row]
    if by_frame:
        first_frame, frames = first_of(recording.frames())
        if first_frame is None:
            return None, iter(())
        origin_ns = first_frame.time_ns
        columns = recording.reader.columns
        names = {columns[at].key: _frame_name(columns[at]) for at in choice.columns}
        items = _of_frames(recording, frames, origin_ns, names, choice.columns)
        fields = [*frame_fields(names.values()), *fields]
    else:
        first, samples = first_of(recording.samples(choice.columns))
        if first is None:
            return None, iter(())
        origin_ns = first.time_ns
        items = (Row(at - origin_ns, wall_ns(at), values) for at, values in samples)
    if choice.start_ns is not None or choice.end_ns is not None:
        items = _cut(items, choice.start_ns, choice.end_ns)
    if choice.rate is not None:
        items = thinned(items, choice.rate, (lambda row: row.values[:2]) if by_frame else None)
    first_row, items = first_of(items)
    if first_row is None:
        return None, iter(())
    wall = wall_ns(origin_ns)
    return Table(fields, wall is not None, by_frame, wall, recording.provenance), items


def _in_blocks(
    recording: Input, choice: Choice, blocks: Iterator[RowBlock]
) -> tuple[Table | None, Iterator[RowBlock]]:
    first, blocks = first_of(filter(len, blocks))
    if first is None:
        return None, blocks
    origin_ns = first.times[0]
    wall = recording.wall_ns(origin_ns)
    first, blocks = first_of(_cut_blocks(blocks, choice, origin_ns))
    if first is None:
        return None, blocks
    fields = [recording.fields[index] for index in choice.columns]
    return Table(fields, wall is not None, False, wall, recording.provenance), blocks


def _cut_blocks(blocks: Iterator[RowBlock], choice: Choice, origin_ns: int) -> Iterator[RowBlock]:
    for block in blocks:
        end_ns = choice.end_ns
        if end_ns is not None and block.times[0] - origin_ns > end_ns + DISORDER_NS:
            return
        found = replace(block, origin_ns=origin_ns).between(choice.start_ns, end_ns)
        if len(found):
            yield found


def rows_of_block(block: RowBlock) -> Iterator[Row]:
    """The rows of a block one by one."""
    origin_ns, wall_ns = block.origin_ns, block.wall_ns
    for at, values in block.values():
        yield Row(at - origin_ns, None if wall_ns is None else at + wall_ns, values)


def _of_frames(
    recording: Input,
    frames: Iterator[TimedFrame],
    origin_ns: int,
    names: dict[int, tuple[str, str]],
    chosen: Sequence[int],
) -> Iterator[Row]:
    """A row for each frame of a message in ``names``: its columns, and None for those of other messages."""
    reader, wall_ns = recording.reader, recording.wall_ns
    nothing: list[Value] = [None] * len(reader.columns)
    for time_ns, frame, _ in frames:
        key = frame.key
        head = names.get(key)
        if head is None or (chunks := reader.read(key, frame.data)) is None:
            # shorter than its message
            continue
        values = nothing.copy()
        for first, new in chunks:
            values[first : first + len(new)] = new
        row = (*head, *(values[index] for index in chosen))
        yield Row(time_ns - origin_ns, wall_ns(time_ns), row)


def _frame_name(column: Column) -> tuple[str, str]:
    """Id as candump writes it, and message."""
    can_id = column.key & ~EXTENDED
    return f"{can_id:08X}" if column.key & EXTENDED else f"{can_id:03X}", column.message


def _cut(rows: Iterator[Row], start_ns: int | None, end_ns: int | None) -> Iterator[Row]:
    """The rows from one time to another; ``end_ns`` included."""
    for row in rows:
        since = row.time_ns
        if end_ns is not None and since > end_ns + DISORDER_NS:
            return
        if (start_ns is None or since >= start_ns) and (end_ns is None or since <= end_ns):
            yield row


def thinned(
    rows: Iterator[Row], rate: float, by: Callable[[Row], object] | None = None
) -> Iterator[Row]:
    """At most ``rate`` rows a second, the newest of each period; ``by`` separates rows that do not replace each other."""
    period = SECOND_NS / rate
    for _, in_slot in groupby(rows, lambda row: row.time_ns // period):
        newest = {None if by is None else by(row): row for row in in_slot}
        yield from sorted(newest.values(), key=lambda row: row.time_ns)
