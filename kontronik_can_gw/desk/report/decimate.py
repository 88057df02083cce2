"""Reduces many rows to few points that look the same in a plot. Pure, one pass, bounded memory.

Consecutive rows share a bucket, which keeps the minimum and the maximum of each column in the order in which they came. When there are
too many buckets, neighbours are merged and each holds twice as many rows. So every extreme is kept exactly, its time to within a bucket,
and with no more rows than points nothing is changed.

A bucket never mixes rows with and without a value of a column: where a column becomes available or not available a new bucket begins. So
each line ends at the last value before a gap and begins again at the first after it, even for a gap of one row. Only beyond MAX_RUNS such
places the closest of them are blurred: merged into mixed buckets, in which the values of a column with gaps are single points.
"""

from array import array
from collections.abc import Sequence
from itertools import pairwise

Number = int | float | None
MIN_POINTS = 8
MAX_RUNS = 4000
"""Limit for runs of rows with the same columns available that are kept separate, whatever the number of points."""
_MIXED = -1
_MIN_BLUR_NS = 1_000_000


class Points:
    """Points to draw: ``times`` (ns, never falling) and as many values of each column, None in a gap."""

    def __init__(self, times: list[int], columns: list[list[Number]]) -> None:
        self.times = times
        self.columns = columns


class Decimator:
    """Takes rows of ``width`` columns; returns at most ``points`` points, and a few more for each gap."""

    def __init__(self, width: int, points: int, max_runs: int = MAX_RUNS) -> None:
        self._points = max(points, MIN_POINTS) // 4 * 4
        self._max_runs = max(max_runs, 2)
        self._rows = 1  # of a full bucket
        self._runs = 0
        self._blur_ns = _MIN_BLUR_NS
        self._begin = array("q")
        self._end = array("q")
        self._count = array("q")  # rows in it
        # a bit for each column that has no value in the bucket, or _MIXED
        self._gaps: list[int] = []
        self._first: list[list[Number]] = [[] for _ in range(width)]
        self._second: list[list[Number]] = [[] for _ in range(width)]
        self._mixed = [bytearray() for _ in range(width)]

    @property
    def rows_in_bucket(self) -> int:
        """Rows in a full bucket; 1: nothing was left out."""
        return self._rows

    def feed(self, times: Sequence[int], columns: Sequence[Sequence[Number]]) -> None:
        """Take rows as columns; ``times`` in ns, never falling."""
        for begin, end, gaps in _runs(columns, len(times)):
            if not self._gaps or self._gaps[-1] != gaps:
                self._runs += 1
                if self._runs > self._max_runs:
                    self._blur()
            at = begin
            while at < end:
                room = self._room(gaps)
                if room <= 0:
                    self._merge()
                    continue
                stop = min(end, at + room)
                self._take(times, columns, at, stop, gaps)
                at = stop

    def finish(self) -> Points:
        """The points of all rows so far."""
        times: list[int] = []
        for begin, end, count, gaps in zip(
            self._begin, self._end, self._count, self._gaps, strict=True
        ):
            if gaps == _MIXED:
                times += (begin, begin, begin, end, end)
            elif count == 1:
                times.append(begin)
            else:
                times += (begin, end)
        columns: list[list[Number]] = []
        for first, second, mixed in zip(self._first, self._second, self._mixed, strict=True):
            column: list[Number] = []
            for index, (a, b) in enumerate(zip(first, second, strict=True)):
                if mixed[index]:
                    column += (None, a, None, b, None)
                elif self._gaps[index] == _MIXED:
                    column += (a, a, a, b, b)
                elif self._count[index] == 1:
                    column.append(a)
                else:
                    column += (a, b)
            columns.append(column)
        return Points(times, columns)

    def _room(self, gaps: int) -> int:
        """Rows with these gaps that fit before buckets must be merged."""
        most = (self._points if self._rows == 1 else self._points // 2) + self._runs - 1
        is_open = self._gaps and self._gaps[-1] == gaps
        return (most - len(self._begin)) * self._rows + (
            max(0, self._rows - self._count[-1]) if is_open else 0
        )

    def _take(
        self,
        times: Sequence[int],
        columns: Sequence[Sequence[Number]],
        at: int,
        stop: int,
        gaps: int,
    ) -> None:
        """Take rows that all have the same gaps and fit."""
        rows = self._rows
        if rows == 1:
            self._begin.extend(times[at:stop])
            self._end.extend(times[at:stop])
            self._count.extend([1] * (stop - at))
            self._gaps += [gaps] * (stop - at)
            for first, second, mixed, values in zip(
                self._first, self._second, self._mixed, columns, strict=True
            ):
                part = values[at:stop]
                first += part
                second += part
                mixed += bytes(len(part))
            return
        if self._gaps and self._gaps[-1] == gaps and self._count[-1] < rows:
            end = min(stop, at + rows - self._count[-1])
            self._end[-1] = times[end - 1]
            self._count[-1] += end - at
            for first, second, values in zip(self._first, self._second, columns, strict=True):
                if first[-1] is not None:
                    first[-1], second[-1], _ = _join(
                        first[-1], second[-1], 0, *_reduce(values[at:end]), 0
                    )
            at = end
        if at == stop:
            return
        starts = range(at, stop, rows)
        self._begin.extend([times[start] for start in starts])
        self._end.extend([times[min(start + rows, stop) - 1] for start in starts])
        self._count.extend([min(start + rows, stop) - start for start in starts])
        self._gaps += [gaps] * len(starts)
        for first, second, mixed, values in zip(
            self._first, self._second, self._mixed, columns, strict=True
        ):
            mixed += bytes(len(starts))
            part = values[at:stop]
            if part.count(part[0]) == len(part):  # constant, as most columns most of the time
                first += [part[0]] * len(starts)
                second += [part[0]] * len(starts)
                continue
            for start in range(0, len(part), rows):
                a, b = _reduce(part[start : start + rows])
                first.append(a)
                second.append(b)

    def _merge(self) -> None:
        """Double the rows of a bucket: merge neighbours with the same gaps."""
        self._rows *= 2
        groups: list[list[int]] = []
        rows = 0
        for index, count in enumerate(self._count):
            gaps = self._gaps[index]
            if (
                groups
                and gaps != _MIXED
                and gaps == self._gaps[index - 1]
                and rows + count <= self._rows
            ):
                groups[-1].append(index)
                rows += count
            else:
                groups.append([index])
                rows = count
        self._regroup(groups)

    def _blur(self) -> None:
        """Merge the shortest neighbours, whatever their gaps, until half of the runs are left."""
        while True:
            groups: list[list[int]] = []
            for index, end in enumerate(self._end):
                if groups and end - self._begin[groups[-1][0]] <= self._blur_ns:
                    groups[-1].append(index)
                else:
                    groups.append([index])
            self._regroup(groups)
            self._rows = max(self._rows, 2)
            # with the next one
            self._runs = 2 + sum(a != b or b == _MIXED for a, b in pairwise(self._gaps))
            if self._runs <= self._max_runs // 2 or len(self._begin) == 1:
                return
            self._blur_ns *= 2

    def _regroup(self, groups: Sequence[Sequence[int]]) -> None:
        """Merge each group of neighbours into one bucket."""
        self._begin = array("q", [self._begin[group[0]] for group in groups])
        self._end = array("q", [self._end[group[-1]] for group in groups])
        count, gaps = self._count, self._gaps
        self._count = array("q", [sum(count[index] for index in group) for group in groups])
        self._gaps = [
            gaps[group[0]] if all(gaps[index] == gaps[group[0]] for index in group) else _MIXED
            for group in groups
        ]
        for column, (first, second, mixed) in enumerate(
            zip(self._first, self._second, self._mixed, strict=True)
        ):
            joined = []
            for group in groups:
                index = group[0]
                found = first[index], second[index], mixed[index]
                for index in group[1:]:
                    found = _join(*found, first[index], second[index], mixed[index])
                joined.append(found)
            self._first[column] = [a for a, _, _ in joined]
            self._second[column] = [b for _, b, _ in joined]
            self._mixed[column] = bytearray(m for _, _, m in joined)


def _runs(columns: Sequence[Sequence[Number]], count: int) -> list[tuple[int, int, int]]:
    """Runs of rows with the same columns missing: from, to, a bit for each missing column."""
    if not count:
        return []
    gaps = 0
    changes: dict[int, int] = {}
    for index, values in enumerate(columns):
        bit = 1 << index
        if values[0] is None:
            gaps |= bit
        if None not in values or values.count(None) == count:
            continue
        for at, (before, value) in enumerate(pairwise(values), 1):
            if (before is None) is not (value is None):
                changes[at] = changes.get(at, 0) ^ bit
    found = []
    begin = 0
    for at in sorted(changes):
        found.append((begin, at, gaps))
        begin, gaps = at, gaps ^ changes[at]
    found.append((begin, count, gaps))
    return found


def _reduce(part: Sequence[Number]) -> tuple[Number, Number]:
    """Minimum and maximum in the order in which they came; of values only or of None only."""
    if part[0] is None:
        return None, None
    low, high = min(part), max(part)  # type: ignore[type-var]  # no None here
    if low == high or part.index(low) < part.index(high):
        return low, high
    return high, low


def _join(
    a1: Number, a2: Number, a_mixed: int, b1: Number, b2: Number, b_mixed: int
) -> tuple[Number, Number, int]:
    """Minimum and maximum of two consecutive buckets, and whether the column has both values and gaps."""
    if a1 is None or a2 is None:
        return b1, b2, b_mixed or int(b1 is not None)
    if b1 is None or b2 is None:
        return a1, a2, 1
    mixed = a_mixed or b_mixed
    low_a, high_a = (a1, a2) if a1 <= a2 else (a2, a1)
    low_b, high_b = (b1, b2) if b1 <= b2 else (b2, b1)
    if low_a <= low_b and high_a >= high_b:
        return a1, a2, mixed
    if low_b < low_a and high_b > high_a:
        return b1, b2, mixed
    if low_a <= low_b:
        return low_a, high_b, mixed
    return high_a, low_b, mixed
