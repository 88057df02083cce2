"""What happens in a flight: errors, operating states, losses of telemetry, changes of the device. Times are ns of the recording's clock."""

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Literal, NamedTuple

Number = int | float | None
Kind = Literal["error", "state", "link", "device"]
MAX_EVENTS = 5000
"""Limit for each kind of event: more are only counted."""


class Extreme(NamedTuple):
    """A value and the time of its first occurrence."""

    value: float
    time_ns: int


@dataclass(slots=True)
class Event:
    """An event of an ESC. ``end_ns`` None: it lasts until the end; equal to ``begin_ns``: it has no length."""

    kind: Kind
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
        self._kept: dict[Kind, list[Event]] = {"error": [], "state": [], "link": [], "device": []}
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
