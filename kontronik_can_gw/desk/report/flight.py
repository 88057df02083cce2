"""A recorded flight: rows of values in; numbers, events and points to draw out. Pure, one pass, bounded memory.

Every value is found by its name, so any recording and any DBC will do; what they do not have is left out. Two rows further apart than the
time-out have a gap between them. Times are ns of the recording's clock.
"""

from collections.abc import Iterator, Sequence
from itertools import compress, islice, pairwise
from operator import ne
from typing import NamedTuple

from kontronik_can_gw.desk.recordings.fields import Field, column_of
from kontronik_can_gw.desk.recordings.recording import LATEST_NS, Block
from kontronik_can_gw.desk.report.esc import DEVICE, LIVE, EscFlight, Event, Events, Number
from kontronik_can_gw.desk.report.quantities import COUNTERS, DRAWN, MAXIMA, MINIMA
from kontronik_can_gw.esc.protocols import PROTOCOLS
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.status import GatewayState
from kontronik_can_gw.times import MS, SECOND

LONGEST_GAP_NS = 86_400 * SECOND
"""Longer gaps are cut out: the clock was set forward, or the recording holds runs of different days."""
_GAP_LEFT_NS = 2 * SECOND
"""What is left of them, beside the length from which a gap is one."""
SAME_SPEED = 0.005
"""Share that the maxima of equal speeds may differ by: in a CAN log they come in different messages."""
_ERRORS = {name for each in PROTOCOLS for name in (*each.errors, *each.bits)}
_SOURCES = {*DRAWN, *COUNTERS, *LIVE, *MAXIMA, *MINIMA, *DEVICE, *_ERRORS}
_SOURCES |= {"cell_count", "gateway_state"}


def needed_columns(fields: Sequence[Field]) -> list[int]:
    """The fields of a recording that a flight needs: of error words and their flags the words."""
    words = {field.source for field in fields} & {word for p in PROTOCOLS for word in p.errors}
    flags = {bit.text for p in PROTOCOLS for word in words for bit in p.errors.get(word, ())}
    return [i for i, field in enumerate(fields) if field.source in _SOURCES - flags]


class Cut(NamedTuple):
    """A long gap that was cut out. ``begin_ns``: the time of the row in front of it; ``length_ns``: how much is left out."""

    begin_ns: int
    length_ns: int


class Flight:
    """Takes the rows of a recording in blocks. ``window``: seconds after the first row, (from, to); None: no limit."""

    def __init__(
        self,
        escs: Sequence[EscSettings],
        fields: Sequence[Field],
        points: int = 20_000,
        window: tuple[float | None, float | None] = (None, None),
    ) -> None:
        low, high = window
        self._from_ns = 0 if low is None else round(low * SECOND)
        self._to_ns = None if high is None else round(high * SECOND)
        self._gap_ns = max(500 * MS, *(settings.timeout_ns + 250 * MS for settings in escs))
        self._blank = ((None,),) * len(fields)
        self._gateway_state = column_of(fields, "gateway_state", None)
        self.seen = Events()
        self._has_begun = False
        self.origin_ns = self.start_ns = self.end_ns = 0
        """Times of the recording's first row (time 0 of the page), and of the window's first and last, without long gaps."""
        self.cuts: list[Cut] = []
        """Long gaps, which are cut out of all times."""
        self._cut_ns = self._last_ns = 0
        self.rows = 0
        self.replayed = False
        self.escs = [EscFlight(i, each, fields, self.seen) for i, each in enumerate(escs)]
        self._drawn = [(i, source) for i, esc in enumerate(self.escs) for source in esc.drawn]
        self.points = Decimator(len(self._drawn), points)
        """Times and columns of all lines."""
        self.lines: dict[tuple[int, str], list[Number]] = {}
        """After ``finish``: the points to draw, by ESC and source."""
        self.events: list[Event] = []
        """After ``finish``: all events by their begin."""

    @property
    def has_anything(self) -> bool:
        """True if the fields have a value that can be drawn."""
        return bool(self._drawn)

    def take(self, block: Block) -> bool:
        """Take rows; False where all that follow are after the window."""
        if not self._has_begun:
            self._has_begun = True
            self.origin_ns = self._last_ns = block.times[0]
        block = self._without_long_gaps(block)
        high = LATEST_NS if self._to_ns is None else self.origin_ns + self._to_ns
        rows = block.between(self.origin_ns + self._from_ns, high)
        begin = 0
        for row, time_ns in enumerate(rows.times):
            if not self.rows and not row:
                self.start_ns = time_ns
            elif time_ns - self.end_ns > self._gap_ns:
                self._analyse(rows.part(begin, row))
                self._analyse(Block([self.end_ns], self._blank, None))
                begin = row
            self.end_ns = time_ns
        self.rows += len(rows)
        self._analyse(rows.part(begin, len(rows)))
        return block.times[-1] <= high

    def _without_long_gaps(self, block: Block) -> Block:
        """The rows with their times on the page."""
        times: Sequence[int] = block.times
        last_ns, self._last_ns = self._last_ns, times[-1]
        if times[-1] - last_ns <= LONGEST_GAP_NS and not self._cut_ns:
            return block
        moved = []
        for time_ns in times:
            if time_ns - last_ns > LONGEST_GAP_NS:
                length_ns = time_ns - last_ns - _GAP_LEFT_NS - self._gap_ns
                self.cuts.append(Cut(last_ns - self._cut_ns, length_ns))
                self._cut_ns += length_ns
            moved.append(time_ns - self._cut_ns)
            last_ns = time_ns
        return Block(moved, block.columns, None)

    def finish(self) -> "Flight":
        """Have ``lines`` and ``events`` made after the last row."""
        lines = zip(self._drawn, self.points.columns, strict=True)
        self.lines = {key: line for key, line in lines if line.count(None) < len(line)}
        for slow, fast in pairwise(("output_speed", "motor_speed", "electrical_speed")):
            found = [esc.extremes for esc in self.escs]
            tops = [(e[slow].value, e[fast].value) for e in found if slow in e and fast in e]
            if tops and all(
                abs(a - b) <= SAME_SPEED * b for a, b in tops
            ):  # no gear, one pole pair
                for index, extremes in enumerate(found):
                    self.lines.pop((index, slow), None)
                    extremes.pop(slow, None)
        self.events = self.seen.in_order()
        return self

    def _analyse(self, rows: Block) -> None:
        if not len(rows):
            return
        times, columns = rows.times, rows.columns
        if self._gateway_state is not None:
            replay = GatewayState.REPLAY
            for value in set(columns[self._gateway_state]):
                self.replayed |= value == replay or normalize(str(value)) == normalize(replay.name)
        drawn = [column for esc in self.escs for column in esc.take(times, columns)]
        self.points.feed(times, drawn)


# --- points to draw

MIN_POINTS = 8
_MERGED = 4
"""Points that become two; as rows they are two buckets."""


class Decimator:
    """Reduces many rows to few points that look the same in a plot; one pass, bounded memory.

    Consecutive rows share a bucket, of which two points are kept: the minimum and the maximum of each column in the order in which
    they came. When there are too many points, they are reduced again as rows were. So every extreme is kept exactly, its time to
    within a bucket, and with no more rows than points nothing is changed. A bucket begins where a column becomes available or not
    available, so each line ends at the last value before a gap and begins again at the first after it, even for a gap of one row.
    ``times`` and ``columns``, of which there are ``width``, have at most ``points`` points, and a few more for each gap.
    """

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
            whole = end - (end - begin) % size
            if size == 1:
                self.times += times[begin:end]
            else:
                for first in range(begin, end, size):
                    past = min(first + size, end)
                    self.times += (times[first], times[past - 1])[: past - first]
            for points, values in zip(self.columns, columns, strict=True):
                if size == 1:
                    points += values[begin:end]
                    continue
                if values[begin] is None:  # all of the run are
                    points += [None] * (len(self.times) - len(points))
                    continue
                for bucket in zip(*[iter(values[begin:whole])] * size, strict=True):
                    points += _ends_of(bucket)
                if whole < end:
                    points += _ends_of(values[whole:end])[: end - whole]


def _runs(columns: Sequence[Sequence[Number]], count: int) -> Iterator[tuple[int, int]]:
    """Runs of rows in which the same columns are missing: from, to."""
    edges = {0, count}
    for values in columns:
        if None in values:
            missing = [value is None for value in values]
            edges.update(compress(range(1, count), map(ne, missing, islice(missing, 1, None))))
    yield from pairwise(sorted(edges))


def _ends_of(values: Sequence[Number]) -> tuple[Number, Number]:
    """Minimum and maximum in the order in which they came; none of the values is None."""
    low = min(values)  # type: ignore[type-var]
    high = max(values)  # type: ignore[type-var]
    return (low, high) if values.index(low) <= values.index(high) else (high, low)
