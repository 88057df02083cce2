"""Analyses a recording: rows of values in; numbers, events and points to draw out. Pure, one pass, bounded memory.

Every value is found by its name, so any recording and any DBC will do. What they do not have is left out and named in ``missing``. A value
holds until the next row; two rows further apart than the time-out have a gap between them. Times are ns of the recording's clock.
"""

from collections.abc import Sequence
from itertools import chain, pairwise
from math import isfinite
from typing import Any

from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.desk.recordings.fields import Field, column_of
from kontronik_can_gw.desk.recordings.recording import Block
from kontronik_can_gw.desk.recordings.tables.rows import LATEST_NS
from kontronik_can_gw.desk.report.decimate import Decimator
from kontronik_can_gw.desk.report.flight import EscFlight, Extreme, Flight
from kontronik_can_gw.desk.report.ledger import Counter, Ledger, Load
from kontronik_can_gw.desk.report.quantities import MAXIMA, MINIMA, PLOTS
from kontronik_can_gw.desk.report.trackers import Device, Errors, Events, Link, States
from kontronik_can_gw.esc.protocols import PROTOCOLS, protocol_named
from kontronik_can_gw.esc.telemetry import MS, SECOND, EscSettings
from kontronik_can_gw.gateway_status import GatewayState

COUNTERS = ("consumed_charge", "energy_used", "losses", "crc_errors", "dropped_bytes")
SPEEDS = ("electrical_speed", "motor_speed", "output_speed")
SAME_SPEED = 0.005
"""Share that the maxima of equal speeds may differ by."""
LIVE = ("battery_voltage", *SPEEDS, "battery_current", "operating_state_raw", "operating_state")
"""The first of these that there is says whether there is telemetry."""
_DRAWN = tuple(source for plot in PLOTS for source in plot.lines)


_FLAGS = {
    bit.text: word for each in PROTOCOLS for word, bits in each.errors.items() for bit in bits
}
_WORDS = frozenset(_FLAGS.values())
_SOURCES = {
    *(*_DRAWN, *COUNTERS, *LIVE, *MAXIMA, *MINIMA, *Device.SOURCES, *_WORDS),
    *("cell_count", "layout", "link_state", "gateway_state"),
}


def needed_columns(fields: Sequence[Field]) -> list[int]:
    """The fields of a recording that an analysis needs."""
    words = {field.source for field in fields} & _WORDS
    wanted = _SOURCES | {flag for flag, word in _FLAGS.items() if word not in words}
    return [index for index, field in enumerate(fields) if field.source in wanted]


class Analysis:
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
        self._origin_ns: int | None = None
        self._start_ns: int | None = None
        self._last_ns = 0
        self._rows = 0
        self._blank = ((None,),) * len(fields)
        self._gateway_state = column_of(fields, "gateway_state", None)
        self._replayed = False
        self._events = Events()
        self._escs = [_Esc(i, settings, fields, self._events) for i, settings in enumerate(escs)]
        self._drawn = [(esc.index, source) for esc in self._escs for source in esc.drawn]
        self._decimator = Decimator(len(self._drawn), points)

    @property
    def has_anything(self) -> bool:
        """True if the fields have a value that can be drawn."""
        return bool(self._drawn)

    def take(self, block: Block) -> bool:
        """Take rows; False where all that follow are after the window."""
        if self._origin_ns is None:
            self._origin_ns = block.times[0]
        high = LATEST_NS if self._to_ns is None else self._origin_ns + self._to_ns
        rows = block.between(self._origin_ns + self._from_ns, high)
        begin = 0
        for row, time_ns in enumerate(rows.times):
            if self._start_ns is None:
                self._start_ns = self._last_ns = time_ns
            elif time_ns - self._last_ns > self._gap_ns:
                self._analyse(rows.part(begin, row))
                self._analyse(Block([self._last_ns], self._blank, None))
                begin = row
            self._last_ns = time_ns
        self._rows += len(rows)
        self._analyse(rows.part(begin, len(rows)))
        return block.times[-1] <= high

    def finish(self) -> Flight:
        """Return the flight after the last row."""
        for esc in self._escs:
            esc.finish(self._last_ns)
        lines = {}
        for key, column in zip(self._drawn, self._decimator.columns, strict=True):
            # a float signal may be infinite
            finite = [value if value is None or isfinite(value) else None for value in column]
            if any(value is not None for value in finite):
                lines[key] = finite
        for source in self._equal_speeds():
            for esc in self._escs:
                lines.pop((esc.index, source), None)
                esc.found.maxima.pop(source, None)
        start_ns = self._start_ns or 0
        return Flight(
            origin_ns=start_ns if self._origin_ns is None else self._origin_ns,
            start_ns=start_ns,
            end_ns=self._last_ns,
            rows=self._rows,
            escs=[esc.found for esc in self._escs],
            times=self._decimator.times,
            lines=lines,
            events=self._events.in_order(),
            left_out=self._events.left_out,
            missing=sorted({text for esc in self._escs for text in esc.missing}),
            rows_in_bucket=self._decimator.rows_in_bucket,
            replayed=self._replayed,
        )

    def _equal_speeds(self) -> list[str]:
        """Speeds that equal another one for all ESCs: no gear, one pole pair."""
        found = []
        for slow, fast in pairwise(("output_speed", "motor_speed", "electrical_speed")):
            maxima = [esc.found.maxima for esc in self._escs]
            tops = [(m[slow].value, m[fast].value) for m in maxima if slow in m and fast in m]
            # in a log they come in different messages, so their maxima may differ a little
            if tops and all(abs(a - b) <= SAME_SPEED * b for a, b in tops):
                found.append(slow)
        return found

    def _analyse(self, rows: Block) -> None:
        if not len(rows):
            return
        times, columns = rows.times, rows.columns
        if self._gateway_state is not None:
            replay = GatewayState.REPLAY
            for value in set(columns[self._gateway_state]):
                self._replayed |= value == replay or normalize(str(value)) == normalize(replay.name)
        numbers = [esc.take(times, columns) for esc in self._escs]
        self._decimator.feed(times, list(chain.from_iterable(numbers)))


class _Esc:
    """The analysis of one ESC."""

    def __init__(
        self, index: int, settings: EscSettings, fields: Sequence[Field], events: Events
    ) -> None:
        self.index = index
        protocol = protocol_named(settings.protocol)
        self.found = EscFlight(settings.name, protocol)
        at = {f.source: i for i, f in reversed(list(enumerate(fields))) if f.esc == index}
        self._at = at
        self._cells = settings.cell_count or None
        self._counters = {
            source: Counter(fields[at[source]].high) for source in COUNTERS if source in at
        }
        self._link = Link(index, self.found, events)
        self._device = Device(index, self.found, events)
        self._states = States(index, self.found, events)
        self._errors = Errors(index, at, events, protocol)
        self._ledger = Ledger(self.found)
        self._live = next((source for source in LIVE if source in at), None)
        known = set(at)
        if "battery_voltage" in at:
            known.add("mean_cell_voltage")
            if "battery_current" in at:
                known.add("battery_power")
        self.drawn = [source for source in _DRAWN if source in known]
        self.missing = [plot.title for plot in PLOTS if not known & plot.lines.keys()]
        if not known & {"operating_state", "operating_state_raw"}:
            self.missing.append("Operating states")
        if not self._errors.is_known:
            self.missing.append("Errors")

    def take(
        self, times: Sequence[int], chunk: Sequence[Sequence[Any]]
    ) -> list[Sequence[int | float | None]]:
        """Take rows as columns; return those to draw."""
        columns = {source: chunk[at] for source, at in self._at.items()}
        self._derive(columns)
        nothing = (None,) * len(times)
        present = nothing if self._live is None else columns[self._live]
        self._link.take(times, present, columns)
        self._device.take(times, columns)
        self._states.take(times, columns)
        self._errors.take(times, present, columns)
        for source, counter in self._counters.items():
            counter.take(columns[source])
        self._find_extremes(times, columns)
        load = (columns.get(f"battery_{name}", nothing) for name in ("voltage", "current", "power"))
        speed = next((columns[source] for source in SPEEDS if source in columns), nothing)
        self._ledger.take(times, map(Load._make, zip(present, *load, speed, strict=True)))
        return [columns[source] for source in self.drawn]

    def finish(self, end_ns: int) -> None:
        """Close what is open after the last row."""
        self._states.finish(end_ns)
        self._link.finish(end_ns)
        self._ledger.finish(
            end_ns,
            has_power="battery_power" in self.drawn,
            has_speed=bool(self._at.keys() & set(SPEEDS)),
        )
        found = self.found
        found.counted = {name: one.total for name, one in self._counters.items() if one.seen}
        if "consumed_charge" in self._counters:
            found.charge_resets = self._counters["consumed_charge"].resets
        found.cells = self._cells

    def _derive(self, columns: dict[str, Sequence[Any]]) -> None:
        """Add what follows from other values, where the recording does not have it."""
        counts = [count for count in columns.get("cell_count", ()) if count]
        self._cells = round(counts[-1]) if counts else self._cells
        voltage, current = columns.get("battery_voltage"), columns.get("battery_current")
        if voltage is not None and "mean_cell_voltage" not in columns:
            cells = self._cells
            columns["mean_cell_voltage"] = [
                None if v is None or not cells else round(v / cells, 3) for v in voltage
            ]
        if voltage is not None and current is not None and "battery_power" not in columns:
            columns["battery_power"] = [
                None if v is None or i is None else round(v * i, 3)
                for v, i in zip(voltage, current, strict=True)
            ]

    def _find_extremes(self, times: Sequence[int], columns: dict[str, Sequence[Any]]) -> None:
        kinds = (MAXIMA, self.found.maxima, max), (MINIMA, self.found.minima, min)
        for quantities, found, best in kinds:
            for source in quantities.keys() & columns.keys():
                values = columns[source]
                value = best((v for v in values if v is not None), default=None)
                before = found.get(source)
                if value is not None and (
                    before is None or best(value, before.value) != before.value
                ):
                    found[source] = Extreme(value, times[values.index(value)])
