"""Reduces many rows to few points that look the same in a plot. Pure, one pass, bounded memory.

Consecutive rows share a bucket, which keeps the minimum and the maximum of each column in the order in which they came. When there are
too many buckets, neighbours are merged and each holds twice as many rows. So every extreme is kept exactly, its time to within a bucket,
and with no more rows than points nothing is changed.

A bucket begins where a column becomes available or not available, so each line ends at the last value before a gap and begins again at
the first after it, even for a gap of one row.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise

from kontronik_can_gw.desk.report.flight import Number

Ends = tuple[Number, Number]
MIN_POINTS = 8


class Decimator:
    """Takes rows of ``width`` columns; returns at most ``points`` points, and a few more for each gap."""

    def __init__(self, width: int, points: int) -> None:
        self.rows_in_bucket = 1
        """Rows in a full bucket; 1: nothing was left out."""
        self._points = max(points, MIN_POINTS)
        self._begin: list[int] = []
        self._end: list[int] = []
        self._count: list[int] = []
        self._missing: list[int] = []  # a bit for each column that has no value in the bucket
        self._ends: list[list[Ends]] = [[] for _ in range(width)]

    def feed(self, times: Sequence[int], columns: Sequence[Sequence[Number]]) -> None:
        """Take rows as columns; ``times`` in ns, never falling."""
        size = self.rows_in_bucket
        for begin, end, missing in _runs(columns, len(times)):
            starts = range(begin, end, size)
            self._begin += times[begin:end:size]
            self._end += [times[min(at + size, end) - 1] for at in starts]
            self._count += [min(size, end - at) for at in starts]
            self._missing += [missing] * len(starts)
            for ends, values in zip(self._ends, columns, strict=True):
                if size == 1:
                    ends += zip(values[begin:end], values[begin:end], strict=True)
                else:
                    ends += [_ends_of(values[at : min(at + size, end)]) for at in starts]
        while self._is_full():
            self._merge()

    def finish(self) -> tuple[list[int], list[list[Number]]]:
        """Times and columns of the points of all rows so far; None in a gap."""
        times: list[int] = []
        columns: list[list[Number]] = [[] for _ in self._ends]
        for begin, end, count in zip(self._begin, self._end, self._count, strict=True):
            times += (begin, end)[:count]
        for column, ends in zip(columns, self._ends, strict=True):
            for first_second, count in zip(ends, self._count, strict=True):
                column += first_second[:count]
        return times, columns

    def _is_full(self) -> bool:
        limit = self._points if self.rows_in_bucket == 1 else self._points // 2
        if len(self._begin) <= limit:
            return False
        edges = sum(a != b for a, b in pairwise(self._missing))
        return len(self._begin) > limit + edges

    def _merge(self) -> None:
        """Double the rows of a bucket: merge neighbours without a gap between them."""
        self.rows_in_bucket *= 2
        groups: list[list[int]] = []
        rows = 0
        for index, count in enumerate(self._count):
            fits = bool(groups) and rows + count <= self.rows_in_bucket
            if fits and self._missing[index] == self._missing[index - 1]:
                groups[-1].append(index)
                rows += count
            else:
                groups.append([index])
                rows = count
        self._begin = [self._begin[group[0]] for group in groups]
        self._end = [self._end[group[-1]] for group in groups]
        self._count = [sum(self._count[index] for index in group) for group in groups]
        self._missing = [self._missing[group[0]] for group in groups]
        self._ends = [
            [_ends_of([value for index in group for value in ends[index]]) for group in groups]
            for ends in self._ends
        ]


def _runs(columns: Sequence[Sequence[Number]], count: int) -> Iterator[tuple[int, int, int]]:
    """Runs of rows in which the same columns are missing: from, to, a bit for each missing column."""
    changes = {0: 0}
    for index, values in enumerate(columns):
        is_missing = False
        for at, value in enumerate(values if None in values else ()):
            if (value is None) is not is_missing:
                changes[at] = changes.get(at, 0) ^ 1 << index
                is_missing = not is_missing
    missing = 0
    for begin, end in pairwise([*sorted(changes), count]):
        missing ^= changes[begin]
        yield begin, end, missing


def _ends_of(values: Sequence[Number]) -> Ends:
    """Minimum and maximum in the order in which they came; of values only, or of None only."""
    if values[0] is None:
        return None, None
    low, high = min(values), max(values)  # type: ignore[type-var]  # no None here
    return (low, high) if values.index(low) <= values.index(high) else (high, low)
