"""Rows of a table out of a recording: which columns, from when to when."""

import fnmatch
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import chain
from typing import Any, TypeVar

from kontronik_can_gw.desk.recordings.fields import Field, Table
from kontronik_can_gw.desk.recordings.recording import Block, Input, between, time_at
from kontronik_can_gw.errors import UserError

LATEST_NS = 1 << 63
"""Later than any time of a recording."""
_DISORDER_NS = 1_000_000_000
"""How far frames of several interfaces may stand out of order."""
T = TypeVar("T")


@dataclass(frozen=True)
class Choice:
    """What of a recording is wanted. Times in ns since its start, ``end_ns`` included."""

    columns: Sequence[int]
    start_ns: int | None = None
    end_ns: int | None = None

    @classmethod
    def of(cls, fields: Sequence[Field], names: Sequence[str] = (), **times: Any) -> "Choice":
        """The fields with one of these names (with * and ?). UserError for a name that fits none.

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
        return cls([*chosen], **times)


def _plain(name: str) -> str:
    return name.lower().replace("_", "").replace(".", "")


def first_of(items: Iterator[T]) -> tuple[T | None, Iterator[T]]:
    """The first item, None where there is none, and all of them."""
    first = next(items, None)
    return first, items if first is None else chain((first,), items)


def cut(
    items: Iterator[Any], start_ns: int | None, end_ns: int | None, origin_ns: int
) -> Iterator[Any]:
    """What of Blocks, or of batches of frames, is from one time after ``origin_ns`` to another, both included; None: no limit."""
    low = -LATEST_NS if start_ns is None else start_ns + origin_ns
    high = LATEST_NS if end_ns is None else end_ns + origin_ns
    for some in items:
        if time_at(some, 0) > high + _DISORDER_NS:
            return
        yield from filter(len, (between(some, low, high),))


def rows_of(recording: Input, choice: Choice) -> tuple[Table | None, Iterator[Block]]:
    """The rows of a recording, and the table that describes them; None where the recording has nothing."""
    first, blocks = first_of(filter(len, recording.blocks(choice.columns)))
    if first is None:
        return None, blocks
    origin_ns = first.times[0]
    first, blocks = first_of(cut(blocks, choice.start_ns, choice.end_ns, origin_ns))
    if first is None:
        return None, blocks
    fields = [recording.fields[index] for index in choice.columns]
    has_utc = recording.wall_ns(origin_ns) is not None
    return Table(fields, has_utc, origin_ns, recording.provenance), blocks
