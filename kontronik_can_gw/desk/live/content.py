"""Makes JSON for browsers from CAN frames: figures, alarms and plots.

There are three kinds of messages. ``layout`` has everything that does not change. ``update`` has
the present figures and alarms. A ``step`` has the extremes of one second of all plotted lines.
"""

import json
from collections import deque
from collections.abc import Callable, Container, Iterable
from dataclasses import asdict
from operator import itemgetter
from typing import Any

from kontronik_can_gw import __version__
from kontronik_can_gw.desk.member import Alarm, alarms_of
from kontronik_can_gw.desk.monitor.model import Esc, Monitor
from kontronik_can_gw.desk.monitor.notices import link_of, notices, trouble_of
from kontronik_can_gw.desk.quantities import PLOTS, QUANTITIES, Plot, Quantity
from kontronik_can_gw.desk.report.events import EventKind, FlightEvent
from kontronik_can_gw.desk.sources import Source
from kontronik_can_gw.desk.words import words
from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.times import MS, SECOND

STEPS = 300
"""Number of steps, one a second, that the plots show."""
_SILENT_NS = SECOND
"""After this time without a frame the page reports that no gateway is heard."""
_LARGE = (
    "motor_speed",
    "output_speed",
    "electrical_speed",
    "battery_voltage",
    "battery_current",
    "battery_power",
    "energy_used",
    "power_stage_temperature",
    "bec_temperature",
)
"""The values in large figures, in their order. The first speed in the DBC replaces all speeds."""
_GOOD = {"gateway": "running", "CAN": "erroractive"}
"""The good states of gateway and controller."""
_MARKS = {"": "", "!": "warning", "!!": "error"}


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


class Content:
    """The page's data. One thread passes frames and time."""

    def __init__(self, source: Source, disk: Callable[[], str] = str) -> None:
        """``disk`` returns a line about the disk of the captures if its space is short, or ""."""
        self.source = source
        self._disk = disk
        self.monitor = Monitor(source.bus)
        self._alarms = AlarmLog()
        self._ended: deque[str] = deque(maxlen=STEPS)
        """Steps that have ended and were not taken yet."""
        self._step_ns: int | None = None
        """Begin of the present step."""
        known = [
            each for each in QUANTITIES if any(esc.has(each.source) for esc in self.monitor.escs)
        ]
        hidden = [each.source for each in known if each.unit == "1/min"][1:]
        self._large = {name: place for place, name in enumerate(_LARGE) if name not in hidden}
        self._quantities = sorted(known, key=lambda each: self._large.get(each.source, len(_LARGE)))
        """The quantities in the DBC, those in large figures first."""
        self._plots: list[dict[str, Any]] = []
        self._lines: list[tuple[Esc, Quantity]] = []
        """The lines of all plots, in the order of a step's values."""
        for plot in PLOTS:
            lines = [each for each in known if each.source in plot.lines.keys() - hidden]
            self._add_plot(plot, lines[: plot.live_lines])

    def _add_plot(self, plot: Plot, lines: list[Quantity]) -> None:
        """Add a plot with a line for each quantity of each ESC."""
        series = []
        for line, quantity in enumerate(lines):
            for esc in self.monitor.escs:
                if esc.has(quantity.source):
                    series.append({"esc": esc.index, "line": line})
                    self._lines.append((esc, quantity))
        if series:
            self._plots.append(
                {
                    "key": plot.key,
                    "title": plot.title,
                    "unit": lines[0].unit,
                    "digits": plot.digits,
                    "lines": [plot.lines[quantity.source] for quantity in lines],
                    "series": series,
                }
            )

    def take(self, frame: CanFrame, now: int) -> None:
        """Evaluate a frame that was received at ``now``."""
        self._end_steps(now)  # a recording may be played much faster than steps are taken
        self.monitor.take(frame, now)

    def steps(self, now: int) -> list[str]:
        """Set the time, and return the steps that have ended since the last call."""
        now = self.monitor.advance(now)
        for index, esc in enumerate(self.monitor.escs):
            flags = list(esc.active)
            trouble = trouble_of(esc)
            if trouble is not None:
                flags.insert(0, trouble)
            self._alarms.update(
                index,
                alarms_of(flags),
                _known_alarms(esc),
                now,
            )
        self._end_steps(now)
        ended = list(self._ended)
        self._ended.clear()
        return ended

    def _end_steps(self, now: int) -> None:
        """Add the steps that have ended by ``now``. Those without any call are gaps."""
        if self._step_ns is None:
            self._step_ns = now
        count = (now - self._step_ns) // SECOND
        if count < 1:
            return
        self.monitor.advance(now)
        self._step_ns += count * SECOND
        values: list[float | None] = []
        for esc, quantity in self._lines:
            track = esc.tracks[quantity.source]
            for value in track.take_step(esc.number(quantity.source)):
                values.append(_round(value, quantity.digits + 1))
        if count > 1:
            self._ended.extend([_json([None] * len(values))] * min(count - 1, STEPS))
        self._ended.append(_json(values))

    def layout(self) -> str:
        """Return everything that does not change."""
        source = self.source
        quantities = [
            quantity._asdict()
            | {
                "unit": quantity.unit,
                "isLarge": quantity.source in self._large,
                "isUpper": quantity.unit != "V",
                "has": [esc.has(quantity.source) for esc in self.monitor.escs],
            }
            for quantity in self._quantities
        ]
        return _json(
            {
                "version": __version__,
                "name": source.name,
                "origin": "recording" if source.is_file else source.simulation,
                "escs": [esc.name for esc in self.monitor.escs],
                "quantities": quantities,
                "plots": self._plots,
                "stepCount": STEPS,
            }
        )

    def update(self, now: int, sent_s: float) -> str:
        """Return the present figures and alarms, and the state of gateway and bus.

        ``sent_s`` is a monotonic time, with which a page detects late updates.
        """
        monitor = self.monitor
        told = [(kind.value, text) for text, kind in notices(monitor, self.source)]
        if disk := self._disk():
            told.append(("hint", disk))
        return _json(
            {
                "time": round(sent_s, 3),
                "notices": told,
                "state": self._state(),
                "progress": self.source.progress,
                "escs": [self._esc(esc, now) for esc in monitor.escs],
                "alarms": self._alarms.document(now),
            }
        )

    def _state(self) -> tuple[str, str]:
        """Return the state of gateway and bus in one line, and its severity."""
        monitor = self.monitor
        if self.source.problem:
            return "error", "no connection to the CAN bus"
        if monitor.silent_ns >= _SILENT_NS and not self.source.is_file:
            return "error", f"no gateway heard for {monitor.silent_ns // SECOND} s"
        severity = "ok"
        parts = []
        for name, good in _GOOD.items():
            state = monitor.gateway.text(f"{name.lower()}_state")
            if state is None or normalize(state) == "unknown":
                continue
            parts.append(f"{name} {words(state)}")
            if normalize(state) != good:
                severity = "warning"
        if monitor.frame_rate is not None:
            parts.append(f"{monitor.frame_rate:.0f} frames/s")
        return severity, ", ".join(parts) or "waiting for frames"

    def _esc(self, esc: Esc, now: int) -> dict[str, Any]:
        link, text = link_of(esc)
        device = esc.device_text
        cells = esc.number("cell_count")
        if cells:
            device += f", {cells:.0f} cells"
        return {
            "state": "-" if esc.state is None else words(esc.state),
            "link": text,
            "isGood": link == "ok",
            "device": device,
            "values": [self._value(esc, quantity, now) for quantity in self._quantities],
        }

    def _value(self, esc: Esc, quantity: Quantity, now: int) -> tuple[Any, ...] | None:
        """Return value, age if it is not available, minimum, maximum and severity of its mark.

        The age is in seconds, and the value then is the last known one. None if the ESC does not
        have the quantity or if it was not received yet.
        """
        track = esc.tracks[quantity.source]
        value = esc.number(quantity.source)
        age_s = None
        mark = ""
        if value is not None:
            mark = _MARKS[quantity.mark(value)]
        elif track.last is not None:
            value = track.last
            age_s = round((now - track.last_ns) / SECOND, 1)
        else:
            return None
        digits = quantity.digits
        return (
            round(value, digits),
            age_s,
            _round(track.low, digits),
            _round(track.high, digits),
            mark,
        )


def _known_alarms(esc: Esc) -> set[str]:
    """Return the names of the alarms whose present state is known."""
    known = set()
    if esc.link is not None:
        known.add("link")
    for word, bits in esc.protocol.errors.items():
        if esc.flags(word) is not None:
            known |= {bit.text for bit in bits}
    return known


def _round(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)


def _json(content: Any) -> str:
    return json.dumps(content, separators=(",", ":"), allow_nan=False)
