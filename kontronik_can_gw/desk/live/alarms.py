"""The errors and warnings of all ESCs since the start, with begin and end. Pure."""

from collections import deque
from collections.abc import Container, Iterable
from dataclasses import asdict
from typing import Any

from kontronik_can_gw.desk.member import Alarm
from kontronik_can_gw.desk.report.events import EventKind, FlightEvent
from kontronik_can_gw.times import MS, SECOND

_KEPT = 100
"""Number of ended alarms that are kept."""
_CONFIRMED_NS = 300 * MS
"""An alarm has ended after this time.

When telemetry is lost, the messages of an ESC report it one after the other. In between, error bits
seem to be off.
"""
_LOST = "its end is not known"


class AlarmLog:
    """Present and past alarms."""

    def __init__(self) -> None:
        self._open: dict[tuple[int, str], FlightEvent] = {}
        """The present alarms by ESC and name."""
        self._missing: dict[tuple[int, str], int] = {}
        """Since when a present alarm was no longer reported."""
        self._ended: deque[FlightEvent] = deque(maxlen=_KEPT)

    def update(self, esc: int, alarms: Iterable[Alarm], known: Container[str], now: int) -> None:
        """Set the present alarms of an ESC. ``known``: names whose state is known."""
        present = {(esc, alarm.text): alarm for alarm in alarms}
        for key in [key for key in self._open if key[0] == esc]:
            if key in present:
                self._missing.pop(key, None)
                continue
            since = self._missing.setdefault(key, now)
            if now - since < _CONFIRMED_NS:
                continue
            event = self._open.pop(key)
            event.end_ns = self._missing.pop(key)
            if key[1] not in known:
                event.note = _LOST
            self._ended.append(event)
        for key, alarm in present.items():
            if key not in self._open:
                kind: EventKind = "link" if alarm.text == "link" else "error"
                self._open[key] = FlightEvent(
                    kind, esc, now, "", alarm.severity.value, alarm.remedy
                )
            self._open[key].text = alarm.meaning  # it may contain a duration

    def document(self, now: int) -> list[dict[str, Any]]:
        """Return all alarms, newest first. ``from`` and ``to`` are seconds before ``now``."""
        events = sorted(
            [*self._open.values(), *self._ended], key=lambda event: event.begin_ns, reverse=True
        )
        found = []
        for event in events:
            content = asdict(event)
            content["from"] = _seconds(event.begin_ns - now)
            content["to"] = None if event.end_ns is None else _seconds(event.end_ns - now)
            found.append(content)
        return found


def _seconds(time_ns: int) -> float:
    return round(time_ns / SECOND, 1)
