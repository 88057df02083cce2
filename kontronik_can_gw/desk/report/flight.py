"""Evaluates a recorded flight: turns rows of values into numbers, events and points to draw.

Reads only the rows, in one pass, with bounded memory. Values are found by name, so any
recording and any DBC can be used. Missing values are left out. If two rows are further apart than
the timeout, there is a gap between them. Times are ns of the recording's clock.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import compress, islice, pairwise
from operator import ne
from typing import NamedTuple

from kontronik_can_gw.desk.quantities import COUNTERS, DRAWN, MAXIMA, MINIMA
from kontronik_can_gw.desk.recordings.fields import TableColumn, column_of
from kontronik_can_gw.desk.recordings.inputs import Input
from kontronik_can_gw.desk.recordings.recording import LATEST_NS, RowBlock
from kontronik_can_gw.desk.report.esc import DEVICE, LIVE, EscFlight, Number
from kontronik_can_gw.desk.report.events import FlightEvent, FlightEvents
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.protocols import PROTOCOLS
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.status import GatewayState
from kontronik_can_gw.times import MS, SECOND

LONGEST_GAP_NS = 86_400 * SECOND
"""Longer gaps are cut out.

Their cause is a clock that was set forward, or a recording with runs of different days.
"""
_GAP_LEFT_NS = 2 * SECOND
"""Length of a shortened gap, in addition to the shortest length of a gap."""
SAME_SPEED = 0.005
"""Share by which the maxima of equal speeds may differ.

They differ in a CAN log, because the speeds are in different messages.
"""
_SOURCES = {
    *DRAWN,
    *COUNTERS,
    *LIVE,
    *MAXIMA,
    *MINIMA,
    *DEVICE,
    "cell_count",
    "gateway_state",
}
"""Names of the values that a flight needs, with the errors of all protocols."""
for _protocol in PROTOCOLS:
    _SOURCES.update(_protocol.errors, _protocol.bits)


def needed_columns(fields: Sequence[TableColumn]) -> list[int]:
    """Return the indices of the fields that a flight needs.

    Flags are not needed if the recording has the error word that contains them.
    """
    present = {field.source for field in fields}
    needed = set(_SOURCES)
    for protocol in PROTOCOLS:
        for word, bits in protocol.errors.items():
            if word in present:
                needed -= {bit.text for bit in bits}
    return [index for index, field in enumerate(fields) if field.source in needed]


class Cut(NamedTuple):
    """A long gap that was cut out."""

    begin_ns: int
    """Time of the row before the gap."""
    length_ns: int
    """Length of the part that is left out."""


class Flight:
    """Evaluates the rows of a recording, which are given in blocks.

    ``window``: first and last time in seconds after the first row. None means no limit.
    """

    def __init__(
        self,
        escs: Sequence[EscSettings],
        fields: Sequence[TableColumn],
        points: int = 20_000,
        window: tuple[float | None, float | None] = (None, None),
    ) -> None:
        low_s, high_s = window
        self._from_ns = round((low_s or 0) * SECOND)
        self._to_ns = LATEST_NS if high_s is None else round(high_s * SECOND)
        longest_timeout_ns = max(settings.timeout_ns for settings in escs)
        self._gap_ns = max(500 * MS, longest_timeout_ns + 250 * MS)
        """Two rows further apart than this have a gap between them."""
        self._blank = ((None,),) * len(fields)
        self._gateway_state = column_of(fields, "gateway_state", None)
        self.seen = FlightEvents()
        self._has_begun = False
        self.origin_ns = 0
        """Time of the recording's first row, which is time 0 of the page."""
        self.start_ns = 0
        """Time of the window's first row, without long gaps."""
        self.end_ns = 0
        """Time of the window's last row, without long gaps."""
        self.cuts: list[Cut] = []
        """Long gaps, which are cut out of all times."""
        self._cut_ns = 0
        """Total length of the cuts."""
        self._last_ns = 0
        """Time of the last row in the recording."""
        self.rows = 0
        self.is_replayed = False
        self.escs: list[EscFlight] = []
        self._drawn: list[tuple[int, str]] = []
        """ESC and source of each line."""
        for index, settings in enumerate(escs):
            esc = EscFlight(index, settings, fields, self.seen)
            self.escs.append(esc)
            self._drawn += [(index, source) for source in esc.drawn]
        self.points = Decimator(len(self._drawn), points)
        """Times and columns of all lines."""
        self.lines: dict[tuple[int, str], list[Number]] = {}
        """The points to draw, by ESC and source. Complete after ``finish``."""
        self.events: list[FlightEvent] = []
        """All events, sorted by their begin. Complete after ``finish``."""

    @property
    def energy_wh(self) -> float | None:
        """The energy of all ESCs. None if it is not known of any."""
        known = [esc.energy_wh for esc in self.escs if esc.energy_wh is not None]
        return sum(known) if known else None

    @property
    def has_anything(self) -> bool:
        """True if the fields have a value that can be drawn."""
        return bool(self._drawn)

    def evaluate(self, block: RowBlock) -> bool:
        """Evaluate rows. Return False if all later rows are after the window."""
        if not self._has_begun:
            self._has_begun = True
            self.origin_ns = block.times[0]
            self._last_ns = block.times[0]
        block = self._without_long_gaps(block)
        high = self.origin_ns + self._to_ns
        rows = block.between(self.origin_ns + self._from_ns, high)
        begin = 0
        for row, time_ns in enumerate(rows.times):
            if not self.rows and not row:
                self.start_ns = time_ns
            elif time_ns - self.end_ns > self._gap_ns:
                blank_row = RowBlock([self.end_ns], self._blank, None)
                self._analyse(rows.part(begin, row))
                self._analyse(blank_row)
                begin = row
            self.end_ns = time_ns
        self.rows += len(rows)
        self._analyse(rows.part(begin, len(rows)))
        return block.times[-1] <= high

    def _without_long_gaps(self, block: RowBlock) -> RowBlock:
        """Return the rows with their times on the page."""
        times: Sequence[int] = block.times
        last_ns = self._last_ns
        self._last_ns = times[-1]
        if times[-1] - last_ns <= LONGEST_GAP_NS and not self._cut_ns:
            return block
        moved = []
        for time_ns in times:
            gap_ns = time_ns - last_ns
            if gap_ns > LONGEST_GAP_NS:
                begin_ns = last_ns - self._cut_ns
                length_ns = gap_ns - _GAP_LEFT_NS - self._gap_ns
                self.cuts.append(Cut(begin_ns, length_ns))
                self._cut_ns += length_ns
            moved.append(time_ns - self._cut_ns)
            last_ns = time_ns
        return RowBlock(moved, block.columns, None)

    def finish(self) -> "Flight":
        """Make ``lines`` and ``events``. Must be called after the last row."""
        for key, line in zip(self._drawn, self.points.columns, strict=True):
            if line.count(None) < len(line):
                self.lines[key] = line
        speeds = ("output_speed", "motor_speed", "electrical_speed")
        for slow, fast in pairwise(speeds):
            if not self._has_same_speeds(slow, fast):
                continue
            for index, esc in enumerate(self.escs):
                self.lines.pop((index, slow), None)
                esc.extremes.pop(slow, None)
        self.events = self.seen.in_order()
        return self

    def _has_same_speeds(self, slow: str, fast: str) -> bool:
        """Return True if two speeds are equal, because there is no gear or only one pole pair."""
        has_both = False
        for esc in self.escs:
            if slow not in esc.extremes or fast not in esc.extremes:
                continue
            has_both = True
            slow_top = esc.extremes[slow].value
            fast_top = esc.extremes[fast].value
            if abs(slow_top - fast_top) > SAME_SPEED * fast_top:
                return False
        return has_both

    def _analyse(self, rows: RowBlock) -> None:
        if not len(rows):
            return
        times = rows.times
        columns = rows.columns
        if self._gateway_state is not None:
            replay = {GatewayState.REPLAY, normalize(GatewayState.REPLAY.name)}
            states = set(columns[self._gateway_state])
            if not replay.isdisjoint(states | {normalize(str(state)) for state in states}):
                self.is_replayed = True
        drawn: list[Sequence[Number]] = []
        for esc in self.escs:
            drawn += esc.evaluate(times, columns)
        self.points.feed(times, drawn)


def flight_of(
    recording: Input,
    window: tuple[float | None, float | None] = (None, None),
    watch: Callable[[Iterable[RowBlock]], Iterable[RowBlock]] = iter,
) -> Flight:
    """Return the flight after all rows of the window. All blocks pass through ``watch``.

    Raises UserError if nothing can be shown.
    """
    chosen = needed_columns(recording.fields)
    fields = [recording.fields[index] for index in chosen]
    flight = Flight(recording.bus.escs, fields, window=window)
    if not flight.has_anything:
        raise UserError(
            f"{recording.bus.layout.file}: has no signal that a report shows. Give another --dbc."
        )
    for block in watch(filter(len, recording.blocks(chosen))):
        if not flight.evaluate(block):
            break
    return flight.finish()


# --- points to draw

MIN_POINTS = 8
_MERGED = 4
"""Number of points that are merged into two. They come from two buckets of rows."""


class Decimator:
    """Reduces many rows to few points that look the same in a plot.

    It needs one pass and bounded memory.

    1. Consecutive rows share a bucket. Two points of it are kept: the minimum and the maximum of
       each column, in the order of their times.
    2. If there are too many points, they are reduced again in the same way.
    3. So every extreme value is exact, and its time is exact to within a bucket. Nothing is changed
       if there are at most as many rows as points.
    4. A new bucket begins when a column becomes available or not available. So a line ends at the
       last value before a gap and begins again at the first value after it, even if the gap has
       only one row.

    There are ``width`` columns. ``times`` and ``columns`` have at most ``points`` points, and a few
    more for each gap.
    """

    def __init__(self, width: int, points: int) -> None:
        self.rows_in_bucket = 1
        """Number of rows in a full bucket. 1: nothing was left out."""
        self.times: list[int] = []
        self.columns: list[list[Number]] = [[] for _ in range(width)]
        self._points = max(points, MIN_POINTS)

    def feed(self, times: Sequence[int], columns: Sequence[Sequence[Number]]) -> None:
        """Add rows that are given as columns. ``times`` are in ns and do not decrease."""
        self._append(times, columns, self.rows_in_bucket)
        while self._is_full():
            times = self.times
            columns = self.columns
            self.times = []
            self.columns = [[] for _ in columns]
            self.rows_in_bucket = max(_MERGED, 2 * self.rows_in_bucket)
            self._append(times, columns, _MERGED)

    def _is_full(self) -> bool:
        count = len(self.times)
        if count <= self._points:
            return False
        gaps = len(_runs(self.columns, count)) - 1
        return count > self._points + 2 * gaps

    def _append(self, times: Sequence[int], columns: Sequence[Sequence[Number]], size: int) -> None:
        """Add rows. Two points are kept of each ``size`` rows."""
        for begin, end in _runs(columns, len(times)):
            if size == 1:
                self.times += times[begin:end]
                for points, values in zip(self.columns, columns, strict=True):
                    points += values[begin:end]
                continue
            for first in range(begin, end, size):
                last = min(first + size, end) - 1
                self.times.append(times[first])
                if last > first:
                    self.times.append(times[last])
            for points, values in zip(self.columns, columns, strict=True):
                if values[begin] is None:  # then all values of the run are None
                    points += [None] * (len(self.times) - len(points))
                else:
                    _append_extremes(points, values[begin:end], size)


def _append_extremes(points: list[Number], values: Sequence[Number], size: int) -> None:
    """Add minimum and maximum of each ``size`` values. The last bucket may be shorter."""
    rest = len(values) % size
    whole = len(values) - rest
    for begin in range(0, whole, size):
        points += _extremes_of(values[begin : begin + size])
    if rest:
        last = _extremes_of(values[whole:])
        points += last[:rest]


def _runs(columns: Sequence[Sequence[Number]], count: int) -> list[tuple[int, int]]:
    """Return begin and end of each run of rows in which the same columns are missing."""
    edges = {0, count}
    for values in columns:
        if None in values:
            missing = [value is None for value in values]
            has_changed = map(ne, missing, islice(missing, 1, None))
            edges.update(compress(range(1, count), has_changed))
    return list(pairwise(sorted(edges)))


def _extremes_of(values: Sequence[Number]) -> tuple[Number, Number]:
    """Return minimum and maximum in the order of their times. No value may be None."""
    low = min(values)  # type: ignore[type-var]
    high = max(values)  # type: ignore[type-var]
    if values.index(low) <= values.index(high):
        return low, high
    return high, low
