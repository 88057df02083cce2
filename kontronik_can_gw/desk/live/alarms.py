"""The errors and warnings of all ESCs since the start, with begin and end. Pure."""

from collections import deque
from collections.abc import Container, Iterable
from dataclasses import asdict
from operator import itemgetter
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
        """The present alarms by ESC and name. Their end is the time of the first missing report."""
        self._ended: deque[FlightEvent] = deque(maxlen=_KEPT)

    def update(self, esc: int, alarms: Iterable[Alarm], known: Container[str], now: int) -> None:
        """Set the present alarms of an ESC. ``known``: names whose state is known."""
        reported = set()
        for alarm in alarms:
            key = esc, alarm.text
            reported.add(key)
            event = self._open.get(key)
            if event is None:
                kind: EventKind = "link" if alarm.text == "link" else "error"
                event = FlightEvent(
                    kind=kind,
                    esc=esc,
                    begin_ns=now,
                    text="",
                    severity=alarm.severity.value,
                    remedy=alarm.remedy,
                )
                self._open[key] = event
            event.text = alarm.meaning  # it may contain a duration
            event.end_ns = None
        for key, event in list(self._open.items()):
            if event.esc != esc or key in reported:
                continue
            if event.end_ns is None:
                event.end_ns = now
            if now - event.end_ns >= _CONFIRMED_NS:
                if key[1] not in known:
                    event.note = _LOST
                self._ended.append(event)
                del self._open[key]

    def document(self, now: int) -> list[dict[str, Any]]:
        """Return all alarms, newest first. ``from`` and ``to`` are seconds before ``now``."""
        found = []
        for event in self._open.values():
            found.append(asdict(event) | {"to": None})
        for event in self._ended:
            found.append(asdict(event) | {"to": _seconds(event.end_ns or 0, now)})
        for content in found:
            content["from"] = _seconds(content["begin_ns"], now)
        return sorted(found, key=itemgetter("begin_ns"), reverse=True)


def _seconds(time_ns: int, now: int) -> float:
    return round((time_ns - now) / SECOND, 1)
