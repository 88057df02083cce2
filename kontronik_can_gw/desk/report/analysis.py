"""Analyses a recording: rows of values in; numbers, events and points to draw out. Pure, one pass, bounded memory.

Every value is found by its name, so any recording and any DBC will do. What they do not have is left out and named in ``missing``. A value
holds until the next row; two rows further apart than the time-out have a gap between them. Times are ns of the recording's clock.
"""

from collections.abc import Callable, Iterable, Sequence
from enum import IntEnum
from operator import itemgetter
from typing import TypeVar

from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.desk.recordings.fields import Field, column_of
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.recordings.samples import fields_of_log
from kontronik_can_gw.desk.report.decimate import Decimator, Number, Points
from kontronik_can_gw.desk.report.flight import (
    Event,
    Extreme,
    Facts,
    Flight,
    Kind,
    Line,
    PlotData,
    Segment,
    Summary,
)
from kontronik_can_gw.desk.report.ledger import Counter, Ledger
from kontronik_can_gw.desk.report.quantities import PLOTS, STATE_CLASSES, UNKNOWN_CLASS, class_of
from kontronik_can_gw.esc.kontronik.states import (
    ErrorBit,
    OperatingError,
    OperatingState,
    SelfTestError,
    device_text,
    state_text,
)
from kontronik_can_gw.esc.telemetry import MS, SECOND, EscSettings, LinkState
from kontronik_can_gw.gateway_status import GatewayState
from kontronik_can_gw.signals.unpacker import SignalReader, Value

CHUNK = 4096
"""Rows that are processed together."""
MAX_EVENTS = 5000
"""Limit for each kind of event (errors, states, link): more are only counted."""
MAX_SEGMENTS = 4000
"""Limit for the state segments of an ESC: beyond it, the shorter of two neighbours is left out."""


class Analysis:
    """Takes the rows of a recording.

    ``window``: seconds after the first row, (from, to); None: no limit. ``fields``: of the rows; those of a CAN log if None.
    """

    def __init__(
        self,
        bus: BusLayout,
        points: int = 20_000,
        window: tuple[float | None, float | None] = (None, None),
        fields: Sequence[Field] | None = None,
    ) -> None:
        if fields is None:
            fields = fields_of_log(SignalReader(bus.layout), bus.escs)
        self._names = [settings.name for settings in bus.escs]
        low, high = window
        self._from_ns = None if low is None else round(low * SECOND)
        self._to_ns = None if high is None else round(high * SECOND)
        self._gap_ns = max(500 * MS, *(settings.timeout_ns + 250 * MS for settings in bus.escs))
        self._origin_ns: int | None = None
        self._start_ns = 0
        self._last_ns: int | None = None
        self._rows = 0
        self._times: list[int] = []
        self._pending: list[tuple[Value, ...]] = []
        self._picked: list[int] = []
        self._gateway_state = column_of(fields, "gateway_state", None)
        self._replayed = False
        self._events = _Events()
        self._escs = [
            _Esc(index, settings, fields, self._pick, self._events)
            for index, settings in enumerate(bus.escs)
        ]
        if self._gateway_state is not None:
            self._gateway_at: int | None = self._pick(self._gateway_state)
        else:
            self._gateway_at = None
        while len(self._picked) < 2:  # itemgetter of one item gives no tuple
            self._picked.append(0)
        self._getter: Callable[[Sequence[Value]], tuple[Value, ...]] = itemgetter(*self._picked)
        self._blank: tuple[Value, ...] = (None,) * len(self._picked)
        self._drawn = [(esc, source) for esc in self._escs for source in esc.drawn]
        self._decimator = Decimator(max(1, len(self._drawn)), points)

    @property
    def has_anything(self) -> bool:
        """True if the DBC has a value that can be drawn."""
        return bool(self._drawn)

    def _pick(self, column: int) -> int:
        if column not in self._picked:
            self._picked.append(column)
        return self._picked.index(column)

    def take(self, time_ns: int, values: Sequence[Value]) -> bool:
        """Take a row; False where it and all following rows are after the window."""
        if self._origin_ns is None:
            self._origin_ns = time_ns
        since = time_ns - self._origin_ns
        if self._from_ns is not None and since < self._from_ns:
            return True
        if self._to_ns is not None and since > self._to_ns:
            return False
        if self._last_ns is None:
            self._start_ns = time_ns
        elif time_ns - self._last_ns > self._gap_ns:
            self._times.append(self._last_ns)
            self._pending.append(self._blank)
        elif time_ns < self._last_ns:  # loggers' clocks can step back
            time_ns = self._last_ns
        self._last_ns = time_ns
        self._rows += 1
        self._times.append(time_ns)
        self._pending.append(self._getter(values))
        if len(self._times) >= CHUNK:
            self._flush()
        return True

    def finish(self) -> Flight:
        """Return the flight after the last row."""
        self._flush()
        start = self._start_ns
        end = start if self._last_ns is None else self._last_ns
        for esc in self._escs:
            esc.finish(end)
        points = self._decimator.finish() if self._drawn else Points([], [])
        missing = sorted({text for esc in self._escs for text in esc.missing})
        return Flight(
            origin_ns=start if self._origin_ns is None else self._origin_ns,
            start_ns=start,
            end_ns=end,
            rows=self._rows,
            names=self._names,
            summaries=[esc.summary for esc in self._escs],
            facts=[esc.facts for esc in self._escs],
            times=points.times,
            plots=self._plots(points),
            segments=[esc.segments for esc in self._escs],
            events=self._events.in_order(),
            left_out=self._events.left_out,
            missing=missing,
            rows_in_bucket=self._decimator.rows_in_bucket,
            replayed=self._replayed,
        )

    def _flush(self) -> None:
        if not self._times:
            return
        times = tuple(self._times)
        columns: list[tuple[Value, ...]] = list(zip(*self._pending, strict=True))
        self._times.clear()
        self._pending.clear()
        if self._gateway_at is not None and not self._replayed:
            self._replayed = any(
                _named(v, GatewayState) is GatewayState.REPLAY
                for v in set(columns[self._gateway_at])
            )
        numbers: list[Sequence[Number]] = []
        for esc in self._escs:
            numbers += esc.take(times, columns)
        if numbers:
            self._decimator.feed(times, numbers)

    def _same_speeds(self) -> set[str]:
        """Speeds that equal another one for all ESCs (one pole pair, no gear). Their extremes are removed, too."""
        same = set()
        for slow, fast in (
            ("output_speed", "motor_speed"),
            ("motor_speed", "electrical_speed"),
            ("output_speed", "electrical_speed"),
        ):
            pairs = [
                (e.get(f"max {slow}"), e.get(f"max {fast}"))
                for e in (esc.summary.extremes for esc in self._escs)
            ]
            tops = [(a.value, b.value) for a, b in pairs if a is not None and b is not None]
            # in a log the two come in different messages, so their maxima may differ a little
            if tops and all(abs(a - b) <= _SAME_SPEED * b for a, b in tops):
                same.add(slow)
        for esc in self._escs:
            for source in same:
                esc.summary.extremes.pop(f"max {source}", None)
        return same

    def _plots(self, points: Points) -> list[PlotData]:
        """The plots with data; a line that equals an earlier one is left out."""
        found = []
        same = self._same_speeds()
        by_key = {
            (esc.index, source): column
            for (esc, source), column in zip(self._drawn, points.columns, strict=False)
        }
        for number, plot in enumerate(PLOTS):
            lines: list[Line] = []
            for esc in self._escs:
                of_esc: list[Line] = []
                for index, quantity in enumerate(plot.lines):
                    values = by_key.get((esc.index, quantity.source))
                    if values is None or all(value is None for value in values):
                        continue
                    of_esc.append(Line(esc.index, index, quantity.source, values))
                if plot.key == "speed":
                    of_esc = [line for line in of_esc if line.source not in same]
                lines += of_esc
            if lines:
                used = sorted({line.quantity for line in lines})
                for line in lines:
                    line.quantity = used.index(line.quantity)
                found.append(PlotData(number, lines, [plot.lines[index].label for index in used]))
        return found


class _Events:
    """Events of all ESCs; each kind up to MAX_EVENTS."""

    def __init__(self) -> None:
        self._kept: dict[Kind, list[Event]] = {"error": [], "state": [], "link": [], "device": []}
        self.left_out: dict[Kind, int] = {}

    def add(self, event: Event) -> Event:
        kept = self._kept[event.kind]
        if len(kept) < MAX_EVENTS:
            kept.append(event)
        else:
            self.left_out[event.kind] = self.left_out.get(event.kind, 0) + 1
        return event

    def in_order(self) -> list[Event]:
        return sorted(
            (event for kept in self._kept.values() for event in kept),
            key=lambda e: (e.begin_ns, e.esc),
        )


_NUMBERS = ("consumed_charge", "energy_used", "losses", "crc_errors", "dropped_bytes", "cell_count")
_FACTS = (
    "device",
    "device_raw",
    "variant",
    "firmware_main",
    "firmware_sub",
    "layout",
    "link_state",
)
_LIVE = (
    "battery_voltage",
    "electrical_speed",
    "motor_speed",
    "output_speed",
    "battery_current",
    "operating_state",
    "operating_state_raw",
)
_SPEEDS = ("electrical_speed", "motor_speed", "output_speed")
_MAXIMA = (
    *_SPEEDS,
    *("battery_power", "battery_current", "motor_current", "peak_current", "battery_voltage"),
    *("power_stage_temperature", "bec_temperature", "bec_current", "throttle", "output_opening"),
)
_MINIMA = ("battery_voltage", "mean_cell_voltage", "bec_voltage", "battery_current")
_UNNAMED_BITS = 32
_SAME_SPEED = 0.005


class _Esc:
    """The analysis of one ESC."""

    def __init__(
        self,
        index: int,
        settings: EscSettings,
        fields: Sequence[Field],
        pick: Callable[[int], int],
        events: _Events,
    ) -> None:
        self.index = index
        self.summary = Summary()
        self.facts = Facts()
        self.missing: list[str] = []
        self._events = events
        self._inputs: dict[str, int] = {}
        self._counters: dict[str, Counter] = {}

        def bind(source: str) -> int | None:
            found = column_of(fields, source, index)
            return None if found is None else pick(found)

        for source in dict.fromkeys((*(q.source for plot in PLOTS for q in plot.lines), *_NUMBERS)):
            found = column_of(fields, source, index)
            if found is None:
                continue
            self._inputs[source] = pick(found)
            if source in _NUMBERS[:5]:
                self._counters[source] = Counter(fields[found].high)
        self._facts_at = {source: at for source in _FACTS if (at := bind(source)) is not None}
        states = [
            (at, source)
            for source in ("operating_state", "operating_state_raw")
            if (at := bind(source)) is not None
        ]
        self._state_at = states[0][0] if states else None
        self._state_numbers: dict[Value, int] = {}
        if states and states[0][1] == "operating_state":
            found = column_of(fields, "operating_state", index)
            assert found is not None
            named = {normalize(state.text): int(state) for state in OperatingState}
            self._state_numbers = {
                text: named.get(normalize(text), -1) for _, text in fields[found].texts
            }
        self._live_at = next((at for source in _LIVE if (at := bind(source)) is not None), None)
        self._flags: list[tuple[int, ErrorBit, Value, Event | None]] = []
        self._words: list[tuple[int, type[ErrorBit], Value, dict[int, Event]]] = []
        for names, word in (
            (OperatingError, "operating_errors"),
            (SelfTestError, "selftest_errors"),
        ):
            word_at = bind(word)
            if word_at is not None:
                self._words.append((word_at, names, None, {}))
                continue
            for bit in names:
                if (
                    bit is not OperatingError.PROGRAMMING_ALLOWED
                    and (at := bind(bit.text)) is not None
                ):
                    self._flags.append((at, bit, None, None))
        self._derive_power = (
            "battery_power" not in self._inputs
            and {"battery_voltage", "battery_current"} <= self._inputs.keys()
        )
        self._derive_cell = (
            "mean_cell_voltage" not in self._inputs and "battery_voltage" in self._inputs
        )
        self.drawn = [
            quantity.source
            for plot in PLOTS
            for quantity in plot.lines
            if quantity.source in self._inputs
            or (quantity.source == "battery_power" and self._derive_power)
            or (quantity.source == "mean_cell_voltage" and self._derive_cell)
        ]
        self._cells: Number = settings.cell_count or None
        self.missing += [
            plot.title
            for plot in PLOTS
            if not any(quantity.source in self.drawn for quantity in plot.lines)
        ]
        if self._state_at is None:
            self.missing.append("Operating states")
        if not self._flags and not self._words:
            self.missing.append("Errors")
        self._ledger = Ledger(self.summary)
        self.segments: list[Segment] = []
        self._shortest_ns = 0
        self._state: tuple[int, int] | None = None  # number, since
        self._class_event: Event | None = None
        self._up: bool | None = None
        self._link: Value = None
        self._gap: Event | None = None
        self._seen_up = False
        self._identity: tuple[Value, ...] | None = None

    # --- rows

    def take(
        self, times: tuple[int, ...], columns: Sequence[tuple[Value, ...]]
    ) -> list[Sequence[Number]]:
        """Take a chunk of rows; return the columns to draw."""
        # no texts: these values are numbers
        numbers: dict[str, Sequence[Number]] = {
            source: columns[at]  # type: ignore[misc]
            for source, at in self._inputs.items()
        }
        if "cell_count" in numbers:
            known = next((value for value in reversed(numbers["cell_count"]) if value), None)
            self._cells = known or self._cells
        if self._derive_power:
            numbers["battery_power"] = [
                None if v is None or i is None else round(v * i, 3)
                for v, i in zip(numbers["battery_voltage"], numbers["battery_current"], strict=True)
            ]
        if self._derive_cell:
            cells = self._cells
            numbers["mean_cell_voltage"] = [
                None if v is None or not cells else round(v / cells, 3)
                for v in numbers["battery_voltage"]
            ]
        present: Sequence[Value] = (
            (None,) * len(times) if self._live_at is None else columns[self._live_at]
        )
        self._follow_link(times, present, columns)
        self._follow_facts(times, columns)
        self._follow_states(times, columns)
        self._follow_errors(times, present, columns)
        self._find_extremes(times, numbers)
        nothing: Sequence[Number] = (None,) * len(times)
        speed = next((numbers[source] for source in _SPEEDS if source in numbers), nothing)
        self._ledger.take(
            times,
            present,
            numbers.get("battery_voltage", nothing),
            numbers.get("battery_current", nothing),
            numbers.get("battery_power", nothing),
            speed,
        )
        for source, counter in self._counters.items():
            counter.take(numbers[source])
        return [numbers[source] for source in self.drawn]

    def finish(self, end_ns: int) -> None:
        """Close open events and segments after the last row."""
        if self._state is not None:
            self._add_segment(Segment(self._state[1], end_ns, self._state[0]))
        if self._gap is not None:
            self._count_gap(end_ns - self._gap.begin_ns)
        summary, counters = self.summary, self._counters
        self._ledger.finish(
            end_ns,
            has_power="battery_power" in self.drawn,
            has_speed=any(s in self._inputs for s in _SPEEDS),
        )
        if (energy := counters.get("energy_used")) is not None and energy.seen:
            summary.energy_counter = energy.total
        if (charge := counters.get("consumed_charge")) is not None and charge.seen:
            summary.charge, summary.charge_resets = charge.total, charge.resets
        for source in ("losses", "crc_errors", "dropped_bytes"):
            if (counter := counters.get(source)) is not None and counter.seen:
                setattr(summary, source, round(counter.total))
        if self._cells:
            summary.cells = round(self._cells)

    # --- link and device

    def _follow_link(
        self, times: Sequence[int], present: Sequence[Value], columns: Sequence[tuple[Value, ...]]
    ) -> None:
        lost = present.count(None)
        if not (lost == 0 and self._up) and not (lost == len(present) and not self._up):
            for time_ns, value in zip(times, present, strict=True):
                up = value is not None
                if up is self._up:
                    continue
                if up:
                    if self._gap is not None:
                        self._gap.end_ns = time_ns
                        self._count_gap(time_ns - self._gap.begin_ns)
                        self._gap = None
                    self._seen_up = True
                elif self._seen_up:
                    self._gap = self._events.add(
                        Event(
                            "link",
                            self.index,
                            time_ns,
                            None,
                            "telemetry_lost",
                            "No telemetry",
                            "warning",
                        )
                    )
                self._up = up
        at = self._facts_at.get("link_state")
        if at is None or columns[at].count(self._link) == len(times):
            return
        for time_ns, value in zip(times, columns[at], strict=True):
            if value == self._link:
                continue
            now, before = _named(value, LinkState), _named(self._link, LinkState)
            if now in (LinkState.DEGRADED, LinkState.PORT_ERROR):
                text = (
                    "Link degraded: many bytes are damaged"
                    if now is LinkState.DEGRADED
                    else "The port of the ESC cannot be used"
                )
                self._events.add(
                    Event(
                        "link", self.index, time_ns, None, str(now), text, "warning", momentary=True
                    )
                )
            elif before is LinkState.DEGRADED and now is LinkState.OK:
                self._events.add(
                    Event(
                        "link",
                        self.index,
                        time_ns,
                        None,
                        "OK",
                        "Link ok again",
                        momentary=True,
                    )
                )
            self._link = value

    def _count_gap(self, length_ns: int) -> None:
        self.summary.gaps += 1
        self.summary.longest_gap_ns = max(self.summary.longest_gap_ns, length_ns)

    def _follow_facts(self, times: Sequence[int], columns: Sequence[tuple[Value, ...]]) -> None:
        at = [self._facts_at.get(source) for source in _FACTS[:6]]
        if all(a is None or columns[a].count(columns[a][0]) == len(times) for a in at):
            times = times[:1]
        last: tuple[Value, ...] | None = None
        for row, time_ns in enumerate(times):
            now = tuple(None if a is None else columns[a][row] for a in at)
            if now == last:
                continue
            last = now
            device, raw, variant, main, sub, layout = now
            if isinstance(layout, str) and normalize(layout) != "unknown":
                self.facts.layout = layout
            elif layout in (1, 2):
                self.facts.layout = "V4" if layout == 1 else "Legacy"
            if device is None and isinstance(raw, int):
                device = device_text(raw) or f"device {raw}"
            if device is None:
                continue
            identity = (device, variant, main, sub)
            if identity == self._identity:
                continue
            was, self._identity = self._identity, identity
            before = _device_words(self.facts)
            self.facts.device = str(device)
            self.facts.variant = variant if isinstance(variant, int) else None
            self.facts.firmware = (
                f"{main}.{sub}" if isinstance(main, int) and isinstance(sub, int) else None
            )
            self.facts.devices.append((time_ns, _device_words(self.facts)))
            del self.facts.devices[MAX_EVENTS:]
            if was is not None:
                text = f"Device changed from {before} to {_device_words(self.facts)}"
                self._events.add(
                    Event("device", self.index, time_ns, None, "device", text, momentary=True)
                )

    # --- states

    def _follow_states(self, times: Sequence[int], columns: Sequence[tuple[Value, ...]]) -> None:
        if self._state_at is None:
            return
        values = columns[self._state_at]
        last: object = self  # no value
        for time_ns, value in zip(times, values, strict=True):
            if value is last or value == last:
                continue
            last = value
            number = self._state_numbers.get(value, -1) if isinstance(value, str) else value
            if not isinstance(number, int):
                number = None if number is None else int(number)
            before = self._state
            if before is not None and before[0] == number:
                continue
            if before is not None:
                self._add_segment(Segment(before[1], time_ns, before[0]))
            self._state = None if number is None else (number, time_ns)
            self._change_class(number, time_ns)

    def _change_class(self, number: int | None, time_ns: int) -> None:
        event = self._class_event
        if number is None:
            if event is not None:
                event.end_ns = time_ns
            self._class_event = None
            return
        group = STATE_CLASSES[class_of(number)]
        if event is not None:
            if event.name == group.key and group.key != STATE_CLASSES[UNKNOWN_CLASS].key:
                return
            event.end_ns = time_ns
        severity = "error" if group.key == "fault" else "status"
        text = f"{group.label}: {state_name(number)}"
        self._class_event = self._events.add(
            Event("state", self.index, time_ns, None, group.key, text, severity)
        )

    def _add_segment(self, segment: Segment) -> None:
        if segment.end_ns - segment.begin_ns < self._shortest_ns:
            return
        self.segments.append(segment)
        while len(self.segments) > MAX_SEGMENTS:
            self._shortest_ns = max(MS, 2 * self._shortest_ns)
            self.segments = [s for s in self.segments if s.end_ns - s.begin_ns >= self._shortest_ns]

    # --- errors

    def _follow_errors(
        self, times: Sequence[int], present: Sequence[Value], columns: Sequence[tuple[Value, ...]]
    ) -> None:
        count = len(times)
        for index, (at, bit, last, event) in enumerate(self._flags):
            values = columns[at]
            if values.count(last) == count:
                continue
            for time_ns, value, live in zip(times, values, present, strict=True):
                if value == last:
                    continue
                if value:
                    event = self._begin(bit, bit.text, time_ns)
                elif event is not None:
                    _end(event, time_ns, lost=value is None or live is None)
                    event = None
                last = value
            self._flags[index] = at, bit, last, event
        for index, (at, names, word, events) in enumerate(self._words):
            values = columns[at]
            if values.count(word) == count:
                continue
            known = {int(bit): bit for bit in names}
            for time_ns, value, live in zip(times, values, present, strict=True):
                if value == word:
                    continue
                now = value if isinstance(value, int) else 0
                for number in range(_UNNAMED_BITS):
                    is_set, was = now >> number & 1, events.get(number)
                    if is_set and was is None:
                        found = known.get(number)
                        if found is not OperatingError.PROGRAMMING_ALLOWED:
                            events[number] = self._begin(found, f"bit{number}", time_ns)
                    elif was is not None and not is_set:
                        _end(was, time_ns, lost=value is None or live is None)
                        del events[number]
                word = value
            self._words[index] = at, names, word, events

    def _begin(self, bit: ErrorBit | None, name: str, time_ns: int) -> Event:
        if bit is None:
            return self._events.add(
                Event("error", self.index, time_ns, None, name, "unknown to this program", "error")
            )
        text = bit.meaning
        if isinstance(bit, SelfTestError):
            text = f"self-test: {text}"
        remedy = str(getattr(bit, "remedy", "") or "")
        return self._events.add(
            Event("error", self.index, time_ns, None, bit.text, text, bit.severity.value, remedy)
        )

    # --- extremes

    def _find_extremes(self, times: Sequence[int], numbers: dict[str, Sequence[Number]]) -> None:
        found = self.summary.extremes
        for sign, listed in (("max", _MAXIMA), ("min", _MINIMA)):
            pick: Callable[[Iterable[int | float]], int | float] = max if sign == "max" else min
            for source in listed:
                values = numbers.get(source)
                if values is None:
                    continue
                known = (
                    [value for value in values if value is not None] if None in values else values
                )
                if not known:
                    continue
                value = pick(known)  # type: ignore[arg-type]  # no None here
                best = found.get(f"{sign} {source}")
                if best is None or (value > best.value if sign == "max" else value < best.value):
                    found[f"{sign} {source}"] = Extreme(value, times[values.index(value)])


_Named = TypeVar("_Named", bound=IntEnum)


def _named(value: Value, names: type[_Named]) -> _Named | None:
    """The member of an enumeration for a value, given as any spelling of its name or as a number."""
    if isinstance(value, str):
        return next((name for name in names if normalize(name.name) == normalize(value)), None)
    return next((name for name in names if name == value), None)


def _end(event: Event, time_ns: int, *, lost: bool) -> None:
    """End an event. ``lost``: telemetry was lost (flags are 0 then); the error itself may continue."""
    event.end_ns = time_ns
    if lost:
        event.note = "until telemetry was lost"


def state_name(number: int) -> str:
    """A state's name as the data sheet spells it, or the number."""
    return state_text(number) or (f"state {number}" if number >= 0 else "unknown state")


def _device_words(facts: Facts) -> str:
    words = [facts.device or "unknown device"]
    if facts.variant is not None:
        words.append(str(facts.variant))
    if facts.firmware is not None:
        words.append(f"firmware {facts.firmware}")
    return " ".join(words)
