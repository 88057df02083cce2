"""Computes sums, extremes and events of one ESC in a flight from columns of values.

A value is valid until the next row. Nothing is counted while telemetry is lost. Times are ns of the
recording's clock.
"""

from collections.abc import Container, Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import compress, repeat
from math import isfinite
from operator import ne
from typing import Any, NamedTuple

from kontronik_can_gw.desk.quantities import (
    COMPUTED_FROM,
    COUNTERS,
    DRAWN,
    MAXIMA,
    MINIMA,
    PHASES,
    SPEEDS,
)
from kontronik_can_gw.desk.recordings.fields import ColumnType, TableColumn
from kontronik_can_gw.desk.report.events import FlightEvent, FlightEvents
from kontronik_can_gw.esc.decoder import EscProtocol
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.times import SECOND

HOUR_NS = 3600 * SECOND
REST_CURRENT = 1.0
"""A. The battery is at rest up to this magnitude."""
LOAD_CURRENT = 5.0
"""A. The battery is under load at or above this current."""
LIVE = (
    "battery_voltage",
    *SPEEDS,
    "battery_current",
    "operating_state_raw",
    "operating_state",
)
"""The first of these in the recording shows whether telemetry is present."""
DEVICE = ("device", "device_raw", "variant", "firmware_main", "firmware_sub")
_WORD_BITS = 32
_NO_TELEMETRY = "Check plug and cable, and the power of the ESC. Its values are unknown meanwhile."

Columns = dict[str, Sequence[Any]]
"""Values of the rows of a chunk by source. None: not available."""
Number = int | float | None


class Extreme(NamedTuple):
    """A value and the time of its first occurrence."""

    value: float
    time_ns: int


class _ErrorColumn(NamedTuple):
    """A column with an error word or a flag."""

    source: str
    word: str
    bits: Iterable[int]
    """Bits of the word that the column contains."""
    shift: int
    """Left shift that turns the column's value into the word's."""


class EscFlight:
    """The results of one ESC. A number is None if the recording does not have it."""

    def __init__(
        self, index: int, settings: EscSettings, fields: Sequence[TableColumn], events: FlightEvents
    ) -> None:
        self.name = settings.name
        self.telemetry_ns = 0
        """Time with telemetry."""
        self.turning_ns = 0
        """Time during which the motor turned."""
        self.counted: dict[str, float] = {}
        """Increase of each counter, by source."""
        self.extremes: dict[str, Extreme] = {}
        """Maximum or minimum, by source."""
        self.cells = settings.cell_count or None
        self.rest_voltage: float | None = None
        """Battery voltage in V before the first load."""
        self.load_voltage: Extreme | None = None
        """Lowest battery voltage in V under load."""
        self.gaps = 0
        self.devices: list[str] = []
        """Descriptions of all devices that were seen, usually one."""
        self._index = index
        self._events = events
        self._protocol = protocol_named(settings.protocol)
        self._columns: dict[str, int] = {}
        """Index of the first field of each source."""
        for place, field in enumerate(fields):
            if field.esc == index:
                self._columns.setdefault(field.source, place)
        own_fields = [fields[place] for place in self._columns.values()]
        self.computed = _values_to_compute(own_fields)
        """Values that the recording has less often than the values from which they follow."""
        self._floats = {
            field.source for field in fields if field.signal and field.kind is ColumnType.FLOAT
        }
        """Values in CAN frames that may be infinite, which means not available."""
        self._live = next((source for source in LIVE if source in self._columns), None)
        self._words = _error_columns(self._protocol, self._columns)
        known = set(self._columns)
        for source, parts in COMPUTED_FROM.items():
            if known.issuperset(parts):
                known.add(source)
        self.drawn = [source for source in DRAWN if source in known]
        self.has_errors = bool(self._words)
        self.has_power = "battery_power" in known
        self.has_speed = not known.isdisjoint(SPEEDS)
        states = self._protocol.states.values()
        self._state_of_name = {normalize(state.text): state for state in states}
        self._last: dict[str, Any] = {"gap": True}
        """The last value of each column whose changes are followed."""
        self._counts: dict[str, float] = {}
        """The last value of each counter."""
        self._set: set[tuple[int, str, int]] = set()
        """Keys of the error bits that are set."""
        self._held: tuple[int, bool, float, Number] = (0, False, 0, 0)
        """Time, presence of telemetry, power and speed of the last row."""
        self._energy = 0.0  # W ns

    @property
    def energy_wh(self) -> float | None:
        """The integral of the positive power in Wh."""
        if not self.has_power:
            return None
        return self._energy / HOUR_NS

    def evaluate(
        self, times: Sequence[int], chunk: Sequence[Sequence[Any]]
    ) -> list[Sequence[int | float | None]]:
        """Evaluate rows that are given as columns. Return the columns to draw."""
        columns: Columns = {source: chunk[place] for source, place in self._columns.items()}
        for source in columns.keys() & self._floats:
            columns[source] = _finite(columns[source])
        self._derive(columns)
        nothing = (None,) * len(times)
        present = columns.get(self._live or "", nothing)
        self._find_gaps(times, present)
        self._find_devices(times, columns)
        states = columns.get("operating_state", ())
        for row, state in self._changes("state", columns.get("operating_state_raw", states)):
            self._change_state(times[row], state)
        for error_column in self._words:
            self._find_errors(times, present, columns, error_column)
        self._count(columns)
        self._find_extremes(times, columns)
        self._add_up(times, present, columns)
        return [columns[source] for source in self.drawn]

    def _changes(self, key: str, values: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        """Yield row and new value of each change of a column, also between chunks."""
        last = self._last.get(key)
        if values.count(last) == len(values):
            return
        for row, value in enumerate(values):
            if value != last:
                last = value
                self._last[key] = value
                yield row, value

    def _derive(self, columns: Columns) -> None:
        """Add values that follow from others, if they are missing or less frequent."""
        voltage = columns.get("battery_voltage")
        current = columns.get("battery_current")
        cells = self._cells_of_rows(columns.get("cell_count", ()))
        if voltage is None:
            return
        if self._is_computed("mean_cell_voltage", columns):
            sent = columns.get("mean_cell_voltage", repeat(None))
            columns["mean_cell_voltage"] = [*map(_mean_cell, voltage, cells, sent)]
        if current is not None and self._is_computed("battery_power", columns):
            columns["battery_power"] = [*map(_power, voltage, current)]

    def _cells_of_rows(self, counts: Sequence[Any]) -> Iterable[int | None]:
        """Return the known number of cells at each row."""
        if counts.count(self.cells) == len(counts):
            return repeat(self.cells)
        found = []
        for count in counts:
            if count:
                self.cells = round(count)
            found.append(self.cells)
        return found

    def _is_computed(self, source: str, columns: Columns) -> bool:
        return source in self.computed or source not in columns

    # --- events

    def _find_devices(self, times: Sequence[int], columns: Columns) -> None:
        nothing = (None,) * len(times)
        parts = [columns.get(source, nothing) for source in DEVICE]
        devices = list(zip(*parts, strict=True))
        for row, about in self._changes("device", devices):
            self._name_device(times[row], *about)

    def _find_errors(
        self,
        times: Sequence[int],
        present: Sequence[Any],
        columns: Columns,
        column: _ErrorColumn,
    ) -> None:
        for row, value in self._changes(column.source, columns[column.source]):
            is_lost = value is None or present[row] is None
            word_value = int(value or 0) << column.shift
            for bit in column.bits:
                is_set = bool(word_value >> bit & 1)
                self._change_bit(
                    times[row],
                    column.word,
                    bit,
                    is_set,
                    is_lost,
                )

    def _find_gaps(self, times: Sequence[int], present: Sequence[Any]) -> None:
        """Begin and end the events of lost telemetry."""
        key = (self._index, "gap")
        missing = [value is None for value in present]
        for row, is_lost in self._changes("gap", missing):
            now = times[row]
            self._events.end(key, now)
            if is_lost:
                self.gaps += 1
                event = FlightEvent(
                    "link", self._index, now, "No telemetry", "warning", _NO_TELEMETRY
                )
                self._events.begin(key, event)

    def _name_device(self, now: int, device: Any, raw: Any, variant: Any, *version: Any) -> None:
        if device is None and raw is not None:
            device = self._protocol.devices.get(int(raw), f"device {raw}")
        if device is None:
            return
        text = str(device)
        if variant is not None:
            text += f" {variant}"
        if None not in version:
            text += ", firmware {}.{}".format(*version)
        if text in self.devices[-1:]:
            return
        if self.devices:
            key = (self._index, "device")
            change = f"Device changed from {self.devices[-1]} to {text}"
            event = FlightEvent("device", self._index, now, change)
            self._events.begin(key, event)
            self._events.end(key, now)
        self.devices.append(text)

    def _change_state(self, now: int, value: Any) -> None:
        key = (self._index, "state")
        self._events.end(key, now)
        if value is None:
            return
        if isinstance(value, str):
            state = self._state_of_name.get(normalize(value))
        else:
            state = self._protocol.states.get(value)
        phase = PHASES[-1]
        text = f"state {value}"
        if state is not None:
            text = state.text
            if state.phase in PHASES:
                phase = state.phase
        event = FlightEvent(
            "state",
            self._index,
            now,
            text,
            phase=PHASES.index(phase),
        )
        if phase == "Fault":
            event.severity = "error"
        self._events.begin(key, event)

    def _change_bit(self, now: int, word: str, bit: int, is_set: bool, is_lost: bool) -> None:
        key = (self._index, word, bit)
        if is_set == (key in self._set):
            return
        if not is_set:
            self._set.remove(key)
            self._events.end(key, now, lost=is_lost)
            return
        event = FlightEvent(
            "error",
            self._index,
            now,
            f"unknown bit {bit}",
            "error",
        )
        for known in self._protocol.errors[word]:
            if known != bit:
                continue
            if known.is_normal:
                return
            event.text = known.meaning
            if word == "selftest_errors":
                event.text = f"self-test: {known.meaning}"
            event.severity = known.severity.value
            event.remedy = known.remedy
        self._set.add(key)
        self._events.begin(key, event)

    # --- numbers

    def _count(self, columns: Columns) -> None:
        """Add the increases of counters. A counter that begins again adds its new value."""
        for source in COUNTERS:
            known = [value for value in columns.get(source, ()) if value is not None]
            if not known:
                continue
            last = self._counts.get(source, known[0])
            increases = []
            # most values are equal to the one before, and are skipped
            has_changed = map(ne, known, (last, *known))
            for value in compress(known, has_changed):
                increase = value
                if value >= last:
                    increase = value - last
                increases.append(increase)
                last = value
            before = self.counted.get(source, 0)
            self.counted[source] = before + sum(increases)
            self._counts[source] = last

    def _find_extremes(self, times: Sequence[int], columns: Columns) -> None:
        for quantities, best in ((MAXIMA, max), (MINIMA, min)):
            for source in quantities.keys() & columns.keys():
                values = columns[source]
                known = values
                if None in values:
                    known = [value for value in values if value is not None]
                if not known:
                    continue
                value = best(known)
                before = self.extremes.get(source)
                if before is None or best(value, before.value) != before.value:
                    self.extremes[source] = Extreme(value, times[values.index(value)])

    def _add_up(self, times: Sequence[int], present: Sequence[Any], columns: Columns) -> None:
        """Add times and energy, and find the battery's voltages at rest and under load."""
        nothing = (None,) * len(times)
        powers = columns.get("battery_power", nothing)
        voltages = columns.get("battery_voltage", nothing)
        currents = columns.get("battery_current", nothing)
        speeds = next((columns[source] for source in SPEEDS if source in columns), nothing)
        since_ns, has_telemetry, last_power, last_speed = self._held
        rows = zip(
            times,
            present,
            powers,
            voltages,
            currents,
            speeds,
            strict=True,
        )
        for now, live, power, voltage, current, speed in rows:
            if has_telemetry:
                length_ns = now - since_ns
                self.telemetry_ns += length_ns
                if last_speed:
                    self.turning_ns += length_ns
                self._energy += last_power * length_ns
            since_ns = now
            has_telemetry = live is not None
            last_power = max(power or 0, 0)
            last_speed = speed
            if voltage is None or current is None:
                continue
            if current >= LOAD_CURRENT:
                if self.load_voltage is None or voltage < self.load_voltage.value:
                    self.load_voltage = Extreme(voltage, now)
            elif self.load_voltage is None and abs(current) <= REST_CURRENT and voltage > 0:
                self.rest_voltage = voltage
        self._held = (since_ns, has_telemetry, last_power, last_speed)


def _error_columns(protocol: EscProtocol, columns: Container[str]) -> list[_ErrorColumn]:
    """Return the columns with errors.

    A column is a whole error word, or a flag if the recording does not have the word.
    """
    found = []
    for word, bits in protocol.errors.items():
        if word in columns:
            found.append(_ErrorColumn(word, word, range(_WORD_BITS), 0))
            continue
        for bit in bits:
            if bit.text in columns:
                column = _ErrorColumn(bit.text, word, (int(bit),), int(bit))
                found.append(column)
    return found


def _finite(values: Sequence[Number]) -> Sequence[Number]:
    """Return the values with None for infinite values."""
    if isfinite(sum(filter(None, values))):
        return values
    return [value if value is None or isfinite(value) else None for value in values]


@lru_cache(4096)
def _mean_cell(voltage: Number, cells: int | None, sent: Number) -> Number:
    """Return the mean cell voltage, or the sent value if the number of cells is unknown."""
    if voltage is None:
        return None
    if not cells:
        return sent
    return round(voltage / cells, 3)


def _power(voltage: Number, current: Number) -> Number:
    if voltage is None or current is None:
        return None
    return round(voltage * current, 3)


def _values_to_compute(fields: Sequence[TableColumn]) -> set[str]:
    """Return the values in CAN frames that are less frequent than the values they follow from."""
    periods = {field.source: field.period_ns for field in fields}
    found = set()
    for source, parts in COMPUTED_FROM.items():
        own = periods.get(source)
        if own is None:
            continue
        part_periods = [periods.get(part) for part in parts]
        if all(period is not None and period < own for period in part_periods):
            found.add(source)
    return found
