"""A recorded flight: rows of values in; numbers, events and points to draw out. Pure, one pass, bounded memory.

Every value is found by its name, so any recording and any DBC will do; what they do not have is left out. Two rows further apart than the
time-out have a gap between them. Times are ns of the recording's clock.
"""

from collections.abc import Sequence
from itertools import pairwise

from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.desk.recordings.fields import Field, column_of
from kontronik_can_gw.desk.recordings.recording import Block
from kontronik_can_gw.desk.recordings.tables.rows import LATEST_NS
from kontronik_can_gw.desk.report.decimate import Decimator
from kontronik_can_gw.desk.report.esc import DEVICE, LIVE, EscFlight, Event, Events, Number
from kontronik_can_gw.desk.report.quantities import COUNTERS, DRAWN, MAXIMA, MINIMA
from kontronik_can_gw.esc.protocols import PROTOCOLS
from kontronik_can_gw.esc.telemetry import MS, SECOND, EscSettings
from kontronik_can_gw.gateway_status import GatewayState

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
        """Times of the recording's first row (time 0 of the page), and of the window's first and last."""
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
            self._has_begun, self.origin_ns = True, block.times[0]
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
