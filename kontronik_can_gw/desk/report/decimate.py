"""Reduces many rows to few points that look the same in a plot. Pure, one pass, bounded memory.

Consecutive rows share a bucket, of which two points are kept: the minimum and the maximum of each column in the order in which they came.
When there are too many points, they are reduced again as rows were. So every extreme is kept exactly, its time to within a bucket, and with
no more rows than points nothing is changed.

A bucket begins where a column becomes available or not available, so each line ends at the last value before a gap and begins again at
the first after it, even for a gap of one row.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise

from kontronik_can_gw.desk.report.esc import Number

MIN_POINTS = 8
_MERGED = 4
"""Points that become two; as rows they are two buckets."""


class Decimator:
    """Takes rows of ``width`` columns; ``times`` and ``columns`` are at most ``points`` points, and a few more for each gap."""

    def __init__(self, width: int, points: int) -> None:
        self.rows_in_bucket = 1
        """Rows in a full bucket; 1: nothing was left out."""
        self.times: list[int] = []
        self.columns: list[list[Number]] = [[] for _ in range(width)]
        self._points = max(points, MIN_POINTS)

    def feed(self, times: Sequence[int], columns: Sequence[Sequence[Number]]) -> None:
        """Take rows as columns; ``times`` in ns, never falling."""
        self._append(times, columns, self.rows_in_bucket)
        while self._is_full():
            times, columns = self.times, self.columns
            self.times, self.columns = [], [[] for _ in columns]
            self.rows_in_bucket = max(_MERGED, 2 * self.rows_in_bucket)
            self._append(times, columns, _MERGED)

    def _is_full(self) -> bool:
        if (count := len(self.times)) <= self._points:
            return False
        gaps = sum(1 for _ in _runs(self.columns, count)) - 1
        return count > self._points + 2 * gaps

    def _append(self, times: Sequence[int], columns: Sequence[Sequence[Number]], size: int) -> None:
        """Add rows, of each ``size`` of them two points."""
        for begin, end in _runs(columns, len(times)):
            buckets = [(at, min(at + size, end)) for at in range(begin, end, size)]
            for first, past in buckets:
                self.times += (times[first], times[past - 1])[: past - first]
            for points, values in zip(self.columns, columns, strict=True):
                if size == 1:
                    points += values[begin:end]
                else:
                    for first, past in buckets:
                        points += _ends_of(values[first:past])[: past - first]


def _runs(columns: Sequence[Sequence[Number]], count: int) -> Iterator[tuple[int, int]]:
    """Runs of rows in which the same columns are missing: from, to."""
    edges = {0, count}
    for values in columns:
        if None in values:
            missing = [value is None for value in values]
            edges |= {at for at, (a, b) in enumerate(pairwise(missing), 1) if a is not b}
    yield from pairwise(sorted(edges))


def _ends_of(values: Sequence[Number]) -> tuple[Number, Number]:
    """Minimum and maximum in the order in which they came; of values only, or of None only."""
    if values[0] is None:
        return None, None
    low, high = min(values), max(values)  # type: ignore[type-var]  # no None here
    return (low, high) if values.index(low) <= values.index(high) else (high, low)
