"""Reads a log of the kernel's target dm-log-writes, and makes the states after a power loss.

The kernel logs completed writes when the next flush begins, and writes with FUA (forced unit
access) when they are durable. After a power loss at position ``p`` of the log, a device that
keeps its promises has

1. all writes before the last flush that precedes ``p``,
2. all writes with FUA before ``p``. If the last write has FUA, it may be incomplete.
3. any part of the other writes before ``p``, in sectors of 512 bytes.

Times and actions of the test are in the log as marks: ``now=NS``, ``storing=N`` and ``stored=N``.
Everything here is pure.
"""

import random
import struct
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from typing import NamedTuple

SECTOR = 512
_HEAD = struct.Struct("<QQQQ")
_FLUSH = 1
_FUA = 2
_DISCARD = 4
_MARK = 8


class Entry(NamedTuple):
    """A write, a flush or a mark. ``data`` is the content or the mark's text."""

    sector: int = 0
    data: bytes = b""
    is_flush: bool = False
    is_durable: bool = False
    """A write with FUA."""
    is_mark: bool = False

    @property
    def is_barrier(self) -> bool:
        return self.is_flush or self.is_durable

    @property
    def is_write(self) -> bool:
        return bool(self.data) and not self.is_mark


Write = tuple[int, bytes]
"""Sector and content."""


def read_entries(log: memoryview, at: int = SECTOR) -> tuple[list[Entry], int]:
    """Return the entries from a position on, and the position behind them.

    A sector of zeros ends the log. A discarded range becomes zeros. A flush that carries data is
    a flush of the earlier writes, followed by a write.
    """
    entries = []
    while at + SECTOR <= len(log):
        sector, count, flags, length = _HEAD.unpack_from(log, at)
        if not flags and not count:
            break
        body = at + SECTOR
        if flags & _MARK:
            text = bytes(log[at + _HEAD.size : at + _HEAD.size + length])
            entries.append(Entry(data=text, is_mark=True))
            at = body
            continue
        if flags & _FLUSH:
            entries.append(Entry(is_flush=True))
        size = count * SECTOR
        if flags & _DISCARD:
            entries.append(Entry(sector, bytes(size)))
            at = body
            continue
        if size:
            data = bytes(log[body : body + size])
            entries.append(Entry(sector, data, is_durable=bool(flags & _FUA)))
        at = body + size
    return entries, at


def entries_before(log: memoryview, at: int, mark: Entry) -> tuple[list[Entry], int] | None:
    """Return the entries from a position to a mark, and the position behind the mark.

    None if the kernel has not written the mark yet. The kernel writes the head of an entry earlier
    than its content, but all of it before the next entry. So the entries are read a second time
    when the mark is there.
    """
    entries, _ = read_entries(log, at)
    if mark not in entries:
        return None
    entries, behind = read_entries(log, at)
    return entries[: entries.index(mark)], behind


class State(NamedTuple):
    """The content of the device after a power loss behind entry ``at``.

    The device has all writes before entry ``base``, and then these ``writes``.
    """

    base: int
    at: int
    writes: tuple[Write, ...]
    kind: str = "prefix"
    """``prefix``, ``dropped`` or ``torn``."""


class Log:
    """The entries of a log, and the facts about each position in it.

    A write reaches the device in units of ``unit`` bytes.
    """

    def __init__(self, entries: Sequence[Entry], unit: int = SECTOR) -> None:
        self.entries = list(entries)
        self._unit = unit
        self._flushes = [i for i, each in enumerate(entries) if each.is_flush]
        self._barriers = [i for i, each in enumerate(entries) if each.is_barrier]
        self._marks: dict[str, tuple[list[int], list[int]]] = {}
        for index, each in enumerate(entries):
            if each.is_mark:
                word, _, number = each.data.decode().partition("=")
                places, numbers = self._marks.setdefault(word, ([], []))
                places.append(index)
                numbers.append(int(number))

    def base(self, at: int) -> int:
        """Return the position behind the last flush before a position."""
        found = bisect_left(self._flushes, at)
        return self._flushes[found - 1] + 1 if found else 0

    def _latest(self, at: int) -> int:
        """Return the position of the next barrier. Power is lost before it has completed."""
        found = bisect_left(self._barriers, at)
        return self._barriers[found] if found < len(self._barriers) else len(self.entries)

    def latest_ns(self, at: int) -> int:
        """Return the first marked time after power was lost at a position."""
        places, times = self._marks.get("now", ([], []))
        found = bisect_right(places, self._latest(at))
        return times[min(found, len(times) - 1)]

    def stored(self, at: int) -> int:
        """Return the number of the last parameters whose storing was confirmed. 0: none."""
        return self._number("stored", at)

    def requested(self, at: int) -> int:
        """Return the number of the last parameters that a master had asked to store. 0: none."""
        return self._number("storing", self._latest(at))

    def _number(self, word: str, at: int) -> int:
        places, numbers = self._marks.get(word, ([], []))
        found = bisect_left(places, at)
        return numbers[found - 1] if found else 0

    def positions(self) -> list[int]:
        """Return the positions with different contents: behind each write, and at the start."""
        return [0] + [i + 1 for i, each in enumerate(self.entries) if each.is_write]

    def prefix(self, at: int) -> State:
        """Return the state with all writes before a position."""
        base = self.base(at)
        writes = [(e.sector, e.data) for e in self.entries[base:at] if e.is_write]
        return State(base, at, tuple(writes))

    def variant(self, at: int, generator: random.Random) -> State:
        """Return a state at a position in which unflushed writes are missing or torn."""
        base = self.base(at)
        candidates = [e for e in self.entries[base:at] if e.is_write]
        under_way = candidates[-1] if candidates else None
        share = generator.choice((0.1, 0.5, 0.9))
        tears = generator.random() < 0.5
        writes: list[Write] = []
        for each in candidates:
            if each.is_durable and each is not under_way:
                writes.append((each.sector, each.data))
            elif tears and generator.random() < 0.5:
                writes += torn(each, self._unit, generator)
            elif generator.random() >= share:
                writes.append((each.sector, each.data))
        if under_way is not None and under_way.is_durable:
            at -= 1  # it has not completed
        return State(base, at, tuple(writes), "torn" if tears else "dropped")

    def states(self, count: int, generator: random.Random) -> list[State]:
        """Return about ``count`` states in the order of the log: all prefixes, and variants.

        If that is too many, a quarter of the states are prefixes, chosen at random. The first state
        of each base has exactly the flushed writes.
        """
        positions = self.positions()
        if len(positions) > count // 2:
            prefixes = sorted(generator.sample(positions, max(1, count // 4)))
        else:
            prefixes = positions
        chosen = [self.prefix(at) for at in prefixes]
        bases = {self.base(at) for at in prefixes}
        near = [at for at in positions if self.base(at) in bases and self.base(at) < at]
        while near and len(chosen) < count:
            chosen.append(self.variant(generator.choice(near), generator))
        flushed = [State(base, base, ()) for base in bases if base not in prefixes]
        return sorted(flushed + chosen, key=lambda state: (state.base, state.at))


def torn(entry: Entry, unit: int, generator: random.Random) -> list[Write]:
    """Return the units of a write that reached the device: its beginning, or any of them."""
    count = -(-len(entry.data) // unit)
    reached = list(range(generator.randrange(count + 1)))
    if generator.random() < 0.5:
        reached = [each for each in range(count) if generator.random() < 0.5]
    sectors = unit // SECTOR
    return [
        (entry.sector + each * sectors, entry.data[each * unit : (each + 1) * unit])
        for each in reached
    ]
