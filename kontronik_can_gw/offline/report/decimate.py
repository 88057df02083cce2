"""Many rows -> few points that look the same. Pure, one pass, bounded memory.

Rows that follow each other share a bucket; a bucket keeps, of each column, its least and its greatest value in the order in which they
came. When there are too many buckets, neighbours are merged and each holds twice as many rows. So every extreme survives exactly, its time
to within a bucket, and as long as there are not more rows than points nothing is changed at all.

A bucket in which a column is partly None is set off by gaps on both sides: what was not available is never joined by a line, though
the gap may be drawn as much as one bucket beside its place.
"""

from array import array
from collections.abc import Sequence

Number = int | float | None
LEAST_POINTS = 8


class Points:
    """What is drawn: ``times`` (ns, never falling) and for each column as many values, None in a gap."""

    def __init__(self, times: list[int], columns: list[list[Number]]) -> None:
        self.times = times
        self.columns = columns


class Decimator:
    """Rows of ``width`` columns in, at most ``points`` points out (and up to as many again where gaps must be shown)."""

    def __init__(self, width: int, points: int) -> None:
        self._points = max(points, LEAST_POINTS) // 4 * 4
        self._rows = 1  # of a full bucket
        self._fill = 0  # rows in the last bucket
        self._begin = array("q")
        self._end = array("q")
        self._first: list[list[Number]] = [[] for _ in range(width)]
        self._second: list[list[Number]] = [[] for _ in range(width)]
        self._mixed = [bytearray() for _ in range(width)]

    @property
    def rows_in_bucket(self) -> int:
        """1: nothing was left out."""
        return self._rows

    def feed(self, times: Sequence[int], columns: Sequence[Sequence[Number]]) -> None:
        """Take rows, given as columns; ``times`` in ns, never falling."""
        at, count = 0, len(times)
        while at < count:
            room = self._room()
            if not room:
                self._merge()
                continue
            stop = min(count, at + room)
            self._take(times, columns, at, stop)
            at = stop

    def finish(self) -> Points:
        """The points of all rows so far."""
        if self._rows == 1:
            return Points(list(self._begin), [list(column) for column in self._first])
        times: list[int] = []
        columns: list[list[Number]] = [[] for _ in self._first]
        mixed_any = bytes(map(max, *self._mixed)) if len(self._mixed) > 1 else bytes(self._mixed[0])
        for index, (begin, end) in enumerate(zip(self._begin, self._end, strict=True)):
            times += (begin, begin, end, end) if mixed_any[index] else (begin, end)
        for column, first, second, mixed in zip(columns, self._first, self._second, self._mixed, strict=True):
            for index, (a, b) in enumerate(zip(first, second, strict=True)):
                if mixed[index]:
                    column += (None, a, b, None)
                elif mixed_any[index]:
                    column += (a, a, b, b)
                else:
                    column += (a, b)
        return Points(times, columns)

    def _room(self) -> int:
        """Rows that can be taken before buckets must be merged."""
        most = self._points if self._rows == 1 else self._points // 2
        open_rows = self._rows - self._fill if self._begin else 0
        return (most - len(self._begin)) * self._rows + open_rows

    def _take(self, times: Sequence[int], columns: Sequence[Sequence[Number]], at: int, stop: int) -> None:
        rows = self._rows
        if rows == 1:
            self._begin.extend(times[at:stop])
            self._end.extend(times[at:stop])
            self._fill = 1
            for first, second, mixed, values in zip(self._first, self._second, self._mixed, columns, strict=True):
                part = values[at:stop]
                first += part
                second += part
                mixed += bytes(len(part))
            return
        if self._begin and self._fill < rows:
            end = min(stop, at + rows - self._fill)
            self._end[-1] = times[end - 1]
            self._fill += end - at
            for first, second, mixed, values in zip(self._first, self._second, self._mixed, columns, strict=True):
                a, b, m = _join(first[-1], second[-1], mixed[-1], *_reduce(values[at:end]))
                first[-1], second[-1], mixed[-1] = a, b, m
            at = end
        if at == stop:
            return
        starts = range(at, stop, rows)
        self._begin.extend([times[start] for start in starts])
        self._end.extend([times[min(start + rows, stop) - 1] for start in starts])
        self._fill = stop - starts[-1]
        for first, second, mixed, values in zip(self._first, self._second, self._mixed, columns, strict=True):
            part = values[at:stop]
            if part.count(part[0]) == len(part):  # nothing moves: most columns, most of the time
                first += [part[0]] * len(starts)
                second += [part[0]] * len(starts)
                mixed += bytes(len(starts))
            elif None in part:
                for start in range(0, len(part), rows):
                    a, b, m = _reduce(part[start : start + rows])
                    first.append(a)
                    second.append(b)
                    mixed.append(m)
            else:
                for start in range(0, len(part), rows):
                    bucket = part[start : start + rows]
                    low, high = min(bucket), max(bucket)  # type: ignore[type-var]  # no None here
                    if low == high or bucket.index(low) < bucket.index(high):
                        first.append(low)
                        second.append(high)
                    else:
                        first.append(high)
                        second.append(low)
                mixed += bytes(len(starts))

    def _merge(self) -> None:
        """Two neighbours each become one. Called when all buckets are full and their number is even."""
        self._rows *= 2
        self._fill = self._rows
        self._begin = self._begin[::2]
        self._end = self._end[1::2]
        for index, (first, second, mixed) in enumerate(zip(self._first, self._second, self._mixed, strict=True)):
            joined = [
                _join(first[i], second[i], mixed[i], first[i + 1], second[i + 1], mixed[i + 1])
                for i in range(0, len(first), 2)
            ]
            self._first[index] = [a for a, _, _ in joined]
            self._second[index] = [b for _, b, _ in joined]
            self._mixed[index] = bytearray(m for _, _, m in joined)


def _reduce(part: Sequence[Number]) -> tuple[Number, Number, int]:
    """Least and greatest in the order in which they came, and whether some but not all are None."""
    known = [value for value in part if value is not None]
    if not known:
        return None, None, 0
    low, high = min(known), max(known)
    mixed = len(known) != len(part)
    if known.index(low) <= known.index(high):
        return low, high, mixed
    return high, low, mixed


def _join(a1: Number, a2: Number, a_mixed: int, b1: Number, b2: Number, b_mixed: int) -> tuple[Number, Number, int]:
    """The same for two that follow each other."""
    if a1 is None or a2 is None:
        return b1, b2, b_mixed or b1 is not None
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
