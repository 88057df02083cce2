"""What happens to one ESC, found in columns of values chunk by chunk: gaps, link, device, operating states, errors."""

from collections.abc import Hashable, Iterator, Mapping, Sequence
from typing import Any

from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.desk.report.flight import EscFlight, Event, Kind, Segment
from kontronik_can_gw.desk.report.quantities import STATE_CLASSES, UNKNOWN_CLASS, class_of
from kontronik_can_gw.esc.decoder import EscProtocol, State
from kontronik_can_gw.esc.telemetry import LinkState
from kontronik_can_gw.esc.values import VALUES

Columns = Mapping[str, Sequence[Any]]
"""Values of the rows of a chunk by source; None where not available."""
MAX_EVENTS = 5000
"""Limit for each kind of event: more are only counted."""
MAX_SEGMENTS = 4000
"""Limit for the state segments of an ESC: later ones are left out."""
_WORD_BITS = 32
_LINK_TEXTS = {
    LinkState.DEGRADED: "Link degraded: many bytes are damaged",
    LinkState.PORT_ERROR: "The port of the ESC cannot be used",
}


class Events:
    """Events of all ESCs. One that lasts is open under a key."""

    def __init__(self) -> None:
        self._kept: dict[Kind, list[Event]] = {"error": [], "state": [], "link": [], "device": []}
        self._open: dict[Hashable, Event] = {}
        self.left_out = 0

    def add(self, event: Event) -> None:
        """Add an event."""
        if len(self._kept[event.kind]) < MAX_EVENTS:
            self._kept[event.kind].append(event)
        else:
            self.left_out += 1

    def begin(self, key: Hashable, event: Event) -> None:
        """Add an event that lasts until its key is ended."""
        self.add(event)
        self._open[key] = event

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


class Changes:
    """Where a column changes, over all chunks; ``last``: its value before the first row."""

    def __init__(self, last: Any = None) -> None:
        self._last = last

    def of(self, values: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        """Row and new value of each change."""
        for row, value in enumerate(values if values.count(self._last) != len(values) else ()):
            if value != self._last:
                self._last = value
                yield row, value


class Link:
    """Gaps in the telemetry, and what the link state says of the line."""

    def __init__(self, esc: int, found: EscFlight, events: Events) -> None:
        self._esc, self._found, self._events = esc, found, events
        self._presence, self._states = Changes(last=False), Changes()
        self._gap_ns: int | None = None

    def take(self, times: Sequence[int], present: Sequence[Any], columns: Columns) -> None:
        """Take rows; ``present``: None where telemetry is lost."""
        for row, is_present in self._presence.of([value is not None for value in present]):
            if is_present:
                self.finish(times[row])
                self._events.end((self._esc, "gap"), times[row])
            else:
                self._gap_ns = times[row]
                event = Event("link", self._esc, times[row], "No telemetry", "warning")
                self._events.begin((self._esc, "gap"), event)
        for row, value in self._states.of(columns.get("link_state", ())):
            self._events.end((self._esc, "link"), times[row])
            for state, text in _LINK_TEXTS.items():
                if value == state or normalize(str(value)) == normalize(state.name):
                    event = Event("link", self._esc, times[row], text, "warning")
                    self._events.begin((self._esc, "link"), event)

    def finish(self, time_ns: int) -> None:
        """Count the gap that ends, if there is one."""
        if self._gap_ns is not None:
            self._found.gaps += 1
            length_ns = time_ns - self._gap_ns
            self._found.longest_gap_ns = max(self._found.longest_gap_ns, length_ns)
            self._gap_ns = None


class Device:
    """Which device it is."""

    SOURCES = ("device", "device_raw", "variant", "firmware_main", "firmware_sub")

    def __init__(self, esc: int, found: EscFlight, events: Events) -> None:
        self._esc, self._found, self._events = esc, found, events
        self._changes, self._layouts = Changes(), Changes()

    def take(self, times: Sequence[int], columns: Columns) -> None:
        """Take rows."""
        for _, value in self._layouts.of(columns.get("layout", ())):
            text = str(VALUES["layout"].names.get(value, value))
            if value is not None and normalize(text) != "unknown":
                self._found.layout = text
        nothing = (None,) * len(times)
        parts = [columns.get(source, nothing) for source in self.SOURCES]
        for row, (device, raw, variant, main, sub) in self._changes.of(
            list(zip(*parts, strict=True))
        ):
            if device is None and raw is not None:
                device = self._found.protocol.devices.get(int(raw), f"device {raw}")
            if device is None:
                continue
            text = str(device) if variant is None else f"{device} {variant}"
            if main is not None and sub is not None:
                text += f", firmware {main}.{sub}"
            known = self._found.devices
            if known and known[-1] != text:
                now, change = times[row], f"Device changed from {known[-1]} to {text}"
                self._events.add(Event("device", self._esc, now, change, end_ns=now))
            if text not in known[-1:]:
                known.append(text)


class States:
    """Operating states: segments of each, and an event for each class of them."""

    def __init__(self, esc: int, found: EscFlight, events: Events) -> None:
        self._esc, self._found, self._events = esc, found, events
        self._states = found.protocol.states
        self._numbers = {normalize(state.text): number for number, state in self._states.items()}
        self._changes = Changes()
        self._state: int | None = None
        self._since_ns = 0
        self._group: int | None = None

    def take(self, times: Sequence[int], columns: Columns) -> None:
        """Take rows."""
        values = columns.get("operating_state_raw") or columns.get("operating_state", ())
        for row, value in self._changes.of(values):
            self.finish(times[row])
            if isinstance(value, str):
                value = self._numbers.get(normalize(value), -1)
            self._state = None if value is None else int(value)
            self._since_ns = times[row]
            self._change_class(self._state, times[row])

    def finish(self, time_ns: int) -> None:
        """Close the segment of the last state."""
        segments = self._found.segments
        if self._state is not None and len(segments) < MAX_SEGMENTS:
            segments.append(Segment(self._since_ns, time_ns, self._state))

    def _change_class(self, state: int | None, time_ns: int) -> None:
        group = None if state is None else class_of(state, self._states)
        if group == self._group and group != UNKNOWN_CLASS:
            return
        self._group = group
        self._events.end((self._esc, "state"), time_ns)
        if state is not None and group is not None:
            label = STATE_CLASSES[group]
            severity = "error" if label == "Fault" else "status"
            text = f"{label}: {state_name(state, self._states)}"
            event = Event("state", self._esc, time_ns, text, severity)
            self._events.begin((self._esc, "state"), event)


class Errors:
    """Bits of both error words, by the word or else by the flag of each bit."""

    def __init__(
        self, esc: int, sources: Mapping[str, int], events: Events, protocol: EscProtocol
    ) -> None:
        self._esc, self._events = esc, events
        self._bits = protocol.errors
        self._words = [(word, Changes()) for word in self._bits if word in sources]
        self._flags = [
            (word, bit, Changes())
            for word, bits in self._bits.items()
            for bit in bits
            if word not in sources and bit.text in sources
        ]
        self.is_known = bool(self._words or self._flags)
        self._set: set[tuple[int, str, int]] = set()

    def take(self, times: Sequence[int], present: Sequence[Any], columns: Columns) -> None:
        """Take rows; ``present``: None where telemetry is lost."""
        for word, changes in self._words:
            for row, value in changes.of(columns[word]):
                is_lost = value is None or present[row] is None
                for bit in range(_WORD_BITS):
                    self._change(word, bit, int(value or 0) >> bit & 1, times[row], lost=is_lost)
        for word, flag, changes in self._flags:
            for row, value in changes.of(columns[flag.text]):
                is_lost = value is None or present[row] is None
                self._change(word, int(flag), value, times[row], lost=is_lost)

    def _change(self, word: str, bit: int, value: Any, time_ns: int, *, lost: bool) -> None:
        key = (self._esc, word, bit)
        if not value and key in self._set:
            self._set.remove(key)
            self._events.end(key, time_ns, lost=lost)
        elif value and key not in self._set:
            known = next((one for one in self._bits[word] if one == bit), None)
            event = Event(
                "error", self._esc, time_ns, f"bit {bit}, unknown to this program", "error"
            )
            if known is not None:
                event.text, event.severity = known.meaning, known.severity.value
                event.remedy = known.remedy
                if word == "selftest_errors":
                    event.text = f"self-test: {known.meaning}"
            if known is None or not known.is_normal:
                self._set.add(key)
                self._events.begin(key, event)


def state_name(number: int, states: Mapping[int, State]) -> str:
    """A state's name as the protocol spells it, or the number."""
    if number in states:
        return states[number].text
    return f"state {number}" if number >= 0 else "unknown state"
