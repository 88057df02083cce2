"""Rows of a table out of a recording: which columns, from when to when, how many a second."""

import fnmatch
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import chain
from typing import Any, TypeVar

from kontronik_can_gw.desk.recordings.fields import Field, Table
from kontronik_can_gw.desk.recordings.recording import Block, Input
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import SECOND

LATEST_NS = 1 << 63
"""Later than any time of a recording."""
T = TypeVar("T")


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


def limits(start_ns: int | None, end_ns: int | None, origin_ns: int) -> tuple[int, int]:
    """Two times after ``origin_ns`` on the recording's clock; None: no limit."""
    low = -LATEST_NS if start_ns is None else start_ns + origin_ns
    return low, LATEST_NS if end_ns is None else end_ns + origin_ns


def rows_of(recording: Input, choice: Choice) -> tuple[Table | None, Iterator[Block]]:
    """The rows of a recording, and the table that describes them; None where the recording has nothing."""
    first, blocks = first_of(filter(len, recording.blocks(choice.columns)))
    if first is None:
        return None, blocks
    origin_ns = first.times[0]
    blocks = _cut(blocks, *limits(choice.start_ns, choice.end_ns, origin_ns))
    if choice.rate is not None:
        blocks = thinned(blocks, choice.rate, origin_ns)
    first, blocks = first_of(blocks)
    if first is None:
        return None, blocks
    fields = [recording.fields[index] for index in choice.columns]
    has_utc = recording.wall_ns(origin_ns) is not None
    return Table(fields, has_utc, origin_ns, recording.provenance), blocks


def _cut(blocks: Iterator[Block], low_ns: int, high_ns: int) -> Iterator[Block]:
    for block in blocks:
        if block.times[0] > high_ns:
            return
        yield from filter(len, (block.between(low_ns, high_ns),))


def thinned(blocks: Iterator[Block], rate: float, origin_ns: int) -> Iterator[Block]:
    """At most ``rate`` rows a second: the newest of each period."""
    period = SECOND / rate
    held: tuple[float, Block] | None = None
    for block in blocks:
        slots = [(time_ns - origin_ns) // period for time_ns in block.times]
        if held is not None and held[0] != slots[0]:
            yield held[1]
        last = len(slots) - 1
        if newest := [row for row in range(last) if slots[row] != slots[row + 1]]:
            yield block.pick(newest)
        held = slots[last], block.pick([last])
    if held is not None:
        yield held[1]
