"""One ESC of a flight, found in columns of values chunk by chunk: sums, extremes and events.

A value holds until the next row; while telemetry is lost nothing is counted. Times are ns of the recording's clock.
"""

from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import compress, pairwise, repeat
from math import isfinite
from operator import ne
from typing import Any, Literal, NamedTuple

from kontronik_can_gw.desk.recordings.fields import Field, Kind
from kontronik_can_gw.desk.report.quantities import (
    COMPUTED_FROM,
    COUNTERS,
    DRAWN,
    MAXIMA,
    MINIMA,
    PHASES,
    SPEEDS,
)
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.times import SECOND

HOUR_NS = 3600 * SECOND
REST_CURRENT = 1.0
"""A: up to this magnitude the battery is at rest."""
LOAD_CURRENT = 5.0
"""A: at or above it the battery is under load."""
LIVE = ("battery_voltage", *SPEEDS, "battery_current", "operating_state_raw", "operating_state")
"""The first of these that there is says whether there is telemetry."""
DEVICE = ("device", "device_raw", "variant", "firmware_main", "firmware_sub")
_WORD_BITS = 32

Columns = dict[str, Sequence[Any]]
"""Values of the rows of a chunk by source; None where not available."""
Number = int | float | None
EventKind = Literal["error", "state", "link", "device"]
MAX_EVENTS = 5000
"""Limit for each kind of event: more are only counted."""


class Extreme(NamedTuple):
    """A value and the time of its first occurrence."""

    value: float
    time_ns: int


@dataclass(slots=True)
class Event:
    """An event of an ESC. ``end_ns`` None: it lasts until the end; equal to ``begin_ns``: it has no length."""

    kind: EventKind
    esc: int
    begin_ns: int
    text: str
    severity: str = "status"
    remedy: str = ""
    end_ns: int | None = None
    note: str = ""
    """How it ended, where that is not obvious."""
    phase: int | None = None
    """Of an operating state: index in PHASES."""


class Events:
    """Events of all ESCs. One that lasts is open under a key."""

    def __init__(self) -> None:
        self._kept: dict[EventKind, list[Event]] = {
            "error": [],
            "state": [],
            "link": [],
            "device": [],
        }
        self._open: dict[Hashable, Event] = {}
        self.left_out = 0

    def begin(self, key: Hashable, event: Event) -> None:
        """Add an event that lasts until its key is ended."""
        self._open[key] = event
        if len(self._kept[event.kind]) < MAX_EVENTS:
            self._kept[event.kind].append(event)
        else:
            self.left_out += 1

    def end(self, key: Hashable, time_ns: int, *, lost: bool = False) -> None:
        """End an event, if it is open. ``lost``: telemetry was lost; what it says may continue."""
        event = self._open.pop(key, None)
        if event is not None:
            event.end_ns = time_ns
            event.note = "until telemetry was lost" if lost else ""

    def in_order(self) -> list[Event]:
        """All events by their begin."""
        every = [event for kept in self._kept.values() for event in kept]
        return sorted(every, key=lambda event: (event.begin_ns, event.esc))


class EscFlight:
    """What is known of one ESC. None: not in the recording."""

    def __init__(
        self, index: int, settings: EscSettings, fields: Sequence[Field], events: Events
    ) -> None:
        self.name = settings.name
        self.telemetry_ns = self.turning_ns = 0
        """Time with telemetry, and with the motor turning."""
        self.counted: dict[str, float] = {}
        """By source: what a counter went up by."""
        self.extremes: dict[str, Extreme] = {}
        """By source."""
        self.cells = settings.cell_count or None
        self.rest_voltage: float | None = None
        """V of the battery before the first load."""
        self.load_voltage: Extreme | None = None
        """V of the battery, minimum under load."""
        self.gaps = 0
        self.devices: list[str] = []
        """Every device seen, in words; usually one."""
        self._index, self._events, self._protocol = index, events, protocol_named(settings.protocol)
        self._at = at = {f.source: i for i, f in reversed([*enumerate(fields)]) if f.esc == index}
        self.computed = _values_to_compute([fields[place] for place in at.values()])
        """Values that the recording has, but less often than the values from which they follow."""
        self._floats = {f.source for f in fields if f.signal and f.kind is Kind.FLOAT}
        """Values of CAN frames, which may be infinite: that is no value."""
        self._live = next((source for source in LIVE if source in at), None)
        self._words: list[tuple[str, str, Iterable[int], int]] = []
        """Error words and flags: source, word, bits in it, and by how much its value is shifted."""
        for word, bits in self._protocol.errors.items():
            flags = [(bit.text, word, (int(bit),), int(bit)) for bit in bits if bit.text in at]
            self._words += [(word, word, range(_WORD_BITS), 0)] if word in at else flags
        known = set(at)
        if "battery_voltage" in at:
            known.add("mean_cell_voltage")
            if "battery_current" in at:
                known.add("battery_power")
        self.drawn = [source for source in DRAWN if source in known]
        self.has_errors, self.has_power = bool(self._words), "battery_power" in known
        self.has_speed = not known.isdisjoint(SPEEDS)
        self._names = {normalize(state.text): state for state in self._protocol.states.values()}
        self._last: dict[str, Any] = {"gap": True}
        self._counts: dict[str, float] = {}
        self._set: set[tuple[int, str, int]] = set()
        self._held: tuple[int, bool, float, Number] = (0, False, 0, 0)
        """Time, presence of telemetry, power and speed of the last row."""
        self._energy = 0.0  # W ns

    @property
    def energy_wh(self) -> float | None:
        """Wh, the integral of the positive power."""
        return self._energy / HOUR_NS if self.has_power else None

    def take(
        self, times: Sequence[int], chunk: Sequence[Sequence[Any]]
    ) -> list[Sequence[int | float | None]]:
        """Take rows as columns; return those to draw."""
        columns = {source: chunk[at] for source, at in self._at.items()}
        for source in columns.keys() & self._floats:
            columns[source] = _finite(columns[source])
        self._derive(columns)
        nothing = (None,) * len(times)
        present = nothing if self._live is None else columns[self._live]
        for row, is_lost in self._changes("gap", [value is None for value in present]):
            self._events.end((self._index, "gap"), times[row])
            if is_lost:
                self.gaps += 1
                event = Event("link", self._index, times[row], "No telemetry", "warning")
                self._events.begin((self._index, "gap"), event)
        parts = [columns.get(source, nothing) for source in DEVICE]
        for row, about in self._changes("device", [*zip(*parts, strict=True)]):
            self._name_device(times[row], *about)
        for row, state in self._changes("state", columns.get(_state_of(columns), ())):
            self._change_state(times[row], state)
        for source, word, bits, shift in self._words:
            for row, value in self._changes(source, columns[source]):
                is_lost = value is None or present[row] is None
                for bit in bits:
                    is_set = (int(value or 0) << shift) >> bit & 1
                    self._change_bit(times[row], word, bit, is_set, is_lost)
        self._count(columns)
        self._find_extremes(times, columns)
        self._add_up(times, present, columns)
        return [columns[source] for source in self.drawn]

    def _changes(self, key: str, values: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        """Row and new value of each change of a column, over all chunks."""
        last = self._last.get(key)
        for row, value in enumerate(values if values.count(last) != len(values) else ()):
            if value != last:
                last = self._last[key] = value
                yield row, value

    def _derive(self, columns: Columns) -> None:
        """Add values that follow from others, if the recording lacks them or has them less often."""
        voltage, current = columns.get("battery_voltage"), columns.get("battery_current")
        cells = self._cells_of_rows(columns.get("cell_count", ()))
        if voltage is None:
            return
        if self._is_computed("mean_cell_voltage", columns):
            sent = columns.get("mean_cell_voltage", repeat(None))
            columns["mean_cell_voltage"] = [*map(_mean_cell, voltage, cells, sent)]
        if current is not None and self._is_computed("battery_power", columns):
            columns["battery_power"] = [
                None if v is None or i is None else round(v * i, 3)
                for v, i in zip(voltage, current, strict=True)
            ]

    def _cells_of_rows(self, counts: Sequence[Any]) -> Iterable[int | None]:
        """The number of cells as it is known at each row."""
        if counts.count(self.cells) == len(counts):
            return repeat(self.cells)
        found = []
        for count in counts:
            self.cells = round(count) if count else self.cells
            found.append(self.cells)
        return found

    def _is_computed(self, source: str, columns: Columns) -> bool:
        return source in self.computed or source not in columns

    # --- events

    def _name_device(self, now: int, device: Any, raw: Any, variant: Any, *version: Any) -> None:
        if device is None and raw is not None:
            device = self._protocol.devices.get(int(raw), f"device {raw}")
        if device is None:
            return
        text = str(device) if variant is None else f"{device} {variant}"
        if None not in version:
            text += ", firmware {}.{}".format(*version)
        if text not in self.devices[-1:]:
            if self.devices:
                change = f"Device changed from {self.devices[-1]} to {text}"
                event = Event("device", self._index, now, change)
                self._events.begin((self._index, "device"), event)
                self._events.end((self._index, "device"), now)
            self.devices.append(text)

    def _change_state(self, now: int, value: Any) -> None:
        key = (self._index, "state")
        self._events.end(key, now)
        if value is None:
            return
        if isinstance(value, str):
            state = self._names.get(normalize(value))
        else:
            state = self._protocol.states.get(value)
        phase = PHASES[-1] if state is None or state.phase not in PHASES else state.phase
        text = f"state {value}" if state is None else state.text
        severity = "error" if phase == "Fault" else "status"
        event = Event("state", self._index, now, text, severity, phase=PHASES.index(phase))
        self._events.begin(key, event)

    def _change_bit(self, now: int, word: str, bit: int, is_set: int, is_lost: bool) -> None:
        key = (self._index, word, bit)
        if not is_set and key in self._set:
            self._set.remove(key)
            self._events.end(key, now, lost=is_lost)
        elif is_set and key not in self._set:
            event = Event("error", self._index, now, f"bit {bit}, unknown to this program", "error")
            known = next((one for one in self._protocol.errors[word] if one == bit), None)
            if known is not None:
                if known.is_normal:
                    return
                place = "self-test: " if word == "selftest_errors" else ""
                event.text, event.severity = place + known.meaning, known.severity.value
                event.remedy = known.remedy
            self._set.add(key)
            self._events.begin(key, event)

    # --- numbers

    def _count(self, columns: Columns) -> None:
        """Add what counters went up by. One that begins again, or overflows, adds its new value."""
        for source in COUNTERS:
            known = [value for value in columns.get(source, ()) if value is not None]
            if known:
                before = self._counts.get(source, known[0])
                # most values are equal to the one before
                changed = [before, *compress(known, map(ne, known, (before, *known)))]
                more = sum(b - a if b >= a else b for a, b in pairwise(changed))
                self.counted[source] = self.counted.get(source, 0) + more
                self._counts[source] = known[-1]

    def _find_extremes(self, times: Sequence[int], columns: Columns) -> None:
        for quantities, best in ((MAXIMA, max), (MINIMA, min)):
            for source in quantities.keys() & columns.keys():
                values = columns[source]
                known = [v for v in values if v is not None] if None in values else values
                value = best(known, default=None)
                before = self.extremes.get(source)
                if value is not None and (
                    before is None or best(value, before.value) != before.value
                ):
                    self.extremes[source] = Extreme(value, times[values.index(value)])

    def _add_up(self, times: Sequence[int], present: Sequence[Any], columns: Columns) -> None:
        """Add times and energy; weigh the battery."""
        nothing = (None,) * len(times)
        load = [columns.get(f"battery_{name}", nothing) for name in ("power", "voltage", "current")]
        speeds = next((columns[source] for source in SPEEDS if source in columns), nothing)
        since, was_there, held_power, turned = self._held
        for now, live, power, voltage, current, speed in zip(
            times, present, *load, speeds, strict=True
        ):
            if was_there:
                length = now - since
                self.telemetry_ns += length
                self.turning_ns += length if turned else 0
                self._energy += held_power * length
            since, was_there, held_power, turned = now, live is not None, max(power or 0, 0), speed
            if voltage is None or current is None:
                continue
            if current >= LOAD_CURRENT:
                if self.load_voltage is None or voltage < self.load_voltage.value:
                    self.load_voltage = Extreme(voltage, now)
            elif self.load_voltage is None and abs(current) <= REST_CURRENT and voltage > 0:
                self.rest_voltage = voltage
        self._held = since, was_there, held_power, turned


def _finite(values: Sequence[Number]) -> Sequence[Number]:
    """The values without infinite ones."""
    if isfinite(sum(filter(None, values))):
        return values
    return [value if value is None or isfinite(value) else None for value in values]


@lru_cache(4096)
def _mean_cell(voltage: Number, cells: int | None, sent: Number) -> Number:
    if voltage is None:
        return None
    return round(voltage / cells, 3) if cells else sent


def _values_to_compute(fields: Sequence[Field]) -> set[str]:
    """Values in CAN frames that are sent less often than all values from which they follow."""
    periods = {field.source: field.period_ns for field in fields}
    found = set()
    for source, parts in COMPUTED_FROM.items():
        own = periods.get(source)
        of_parts = [periods.get(part) for part in parts]
        if own is not None and all(period is not None and period < own for period in of_parts):
            found.add(source)
    return found


def _state_of(columns: Columns) -> str:
    return "operating_state_raw" if "operating_state_raw" in columns else "operating_state"
