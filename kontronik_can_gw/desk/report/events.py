"""The events of a flight: errors, operating states, losses of telemetry and changes of device."""

from collections.abc import Hashable
from dataclasses import dataclass
from operator import attrgetter
from typing import Literal

EventKind = Literal["error", "state", "link", "device"]
MAX_EVENTS = 5000
"""Number of events of each kind that are kept. Further events are only counted."""


@dataclass(slots=True)
class FlightEvent:
    """An event of an ESC."""

    kind: EventKind
    esc: int
    begin_ns: int
    text: str
    severity: str = "status"
    remedy: str = ""
    end_ns: int | None = None
    """None if the event lasts until the end. Equal to ``begin_ns`` if it has no duration."""
    note: str = ""
    """A remark about its end, if the end is not obvious."""
    phase: int | None = None
    """Index in PHASES of an operating state. None for other events."""


class FlightEvents:
    """The events of all ESCs. An event that lasts is stored under a key until it is ended."""

    def __init__(self) -> None:
        self._kept: dict[EventKind, list[FlightEvent]] = {
            "error": [],
            "state": [],
            "link": [],
            "device": [],
        }
        self._open: dict[Hashable, FlightEvent] = {}
        self.left_out = 0

    def begin(self, key: Hashable, event: FlightEvent) -> None:
        """Add an event that lasts until ``end`` is called with its key."""
        self._open[key] = event
        if len(self._kept[event.kind]) < MAX_EVENTS:
            self._kept[event.kind].append(event)
        else:
            self.left_out += 1

    def end(self, key: Hashable, time_ns: int, *, lost: bool = False) -> None:
        """End an event, if there is one under the key.

        ``lost``: the cause is a loss of telemetry, so the condition itself may continue.
        """
        event = self._open.pop(key, None)
        if event is None:
            return
        event.end_ns = time_ns
        if lost:
            event.note = "until telemetry was lost"

    def in_order(self) -> list[FlightEvent]:
        """Return all events, sorted by their begin."""
        found: list[FlightEvent] = []
        for events in self._kept.values():
            found += events
        return sorted(found, key=attrgetter("begin_ns", "esc"))
