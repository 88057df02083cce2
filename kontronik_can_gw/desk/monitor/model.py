"""The model of the live screen: the ESCs and the gateway as their frames show them, with extremes and a short history. Pure."""

from collections import deque
from typing import Any, NamedTuple

from kontronik_can_gw.dbc.view import View
from kontronik_can_gw.desk.member import Alarm, Member
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.recordings.recording import LATEST_NS
from kontronik_can_gw.esc.decoder import Severity
from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.esc.values import VALUES
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.signals.unpacker import SignalReader
from kontronik_can_gw.times import SECOND

HISTORY_S = 60
"""Length of a history, one value each second."""
SILENCE_NS = 5 * SECOND
"""After this time without a frame the screen shows possible causes."""


class Quantity(NamedTuple):
    """A measured value by its source. Limits are lower ones if ``alarm`` is below ``warning``."""

    source: str
    label: str
    digits: int
    head: str = ""
    """Head of its column in the table of all ESCs; empty: only on an ESC's own page."""
    warning: float | None = None
    alarm: float | None = None

    @property
    def unit(self) -> str:
        return VALUES[self.source].unit

    def mark(self, value: float) -> str:
        """``!!`` or ``!`` for a value beyond its limit for an alarm or a warning."""
        if self.warning is None or self.alarm is None:
            return ""
        sign = 1 if self.alarm >= self.warning else -1
        return "!" * ((sign * value >= sign * self.warning) + (sign * value >= sign * self.alarm))


# The most important first: what does not fit on the screen is left out from the end.
# The ESC does not report its limits. A lithium polymer cell is nearly empty below 3.5 V under load, and damaged below 3.3 V.
QUANTITIES = (
    Quantity("motor_speed", "motor speed", 0, "1/min"),
    Quantity("battery_voltage", "battery voltage", 2, "V"),
    Quantity("battery_current", "battery current", 1, "A"),
    Quantity("power_stage_temperature", "power stage", 0, "°C", 80, 100),
    Quantity("battery_power", "power", 0, "W"),
    Quantity("mean_cell_voltage", "cell voltage", 2, "V cell", 3.5, 3.3),
    Quantity("throttle", "throttle", 0, "thr %"),
    Quantity("consumed_charge", "charge", 0, "mAh"),
    Quantity("bec_temperature", "BEC", 0, "BEC °C", 80, 100),
    Quantity("output_opening", "opening", 0, "open %"),
    Quantity("motor_current", "motor current", 1, "A motor"),
    Quantity("peak_current", "peak current", 1, "A peak"),
    Quantity("energy_used", "energy", 1, "Wh"),
    Quantity("output_speed", "output speed", 0),
    Quantity("electrical_speed", "electrical speed", 0),
    Quantity("bec_voltage", "BEC voltage", 2),
    Quantity("bec_current", "BEC current", 2),
)


class Track:
    """Minimum, maximum and history of a value; the history has None for seconds in which it was not available."""

    def __init__(self) -> None:
        self.low: float | None = None
        self.high: float | None = None
        self.history: deque[float | None] = deque(maxlen=HISTORY_S)

    def take(self, value: float) -> None:
        if self.low is None or value < self.low:
            self.low = value
        if self.high is None or value > self.high:
            self.high = value


class Esc(Member):
    """One ESC as seen on the bus. All values are those of the last ``Monitor.advance``."""

    tracks: dict[str, Track]

    @property
    def device_text(self) -> str:
        """Device, variant and firmware; empty where not available."""
        variant = self.number("variant")
        text = self.device or ""
        if text and variant is not None:
            text += f" {variant:.0f}"
        return f"{text}, firmware {self.firmware}" if text and self.firmware else text

    @property
    def active(self) -> list[Alarm]:
        """The bits that are set."""
        return [flag for word in self.protocol.errors for flag in self.flags(word) or ()]

    @property
    def units(self) -> dict[str, str]:
        """Unit of each source in the DBC, in the order of the sources, except flags and words of flags."""
        words = self.protocol.errors
        return {n: v.unit for n, v in VALUES.items() if n in self.no_flags and n not in words}

    def document(self) -> dict[str, Any]:
        """Everything as JSON; None for what is not available."""
        names: dict[Severity, list[str]] = {severity: [] for severity in Severity}
        for flag in self.active:
            names[flag.severity].append(flag.text)
        return {
            "name": self.name,
            "link": self.link,
            "state": self.state,
            "device": self.device_text or None,
            "errors": names[Severity.ERROR],
            "warnings": names[Severity.WARNING],
            "status": names[Severity.STATUS],
            "values": {name: self.value(name) for name in self.units},
        }


class Monitor:
    """The ESCs and the gateway of a layout. ``now``: nanoseconds on the clock of the frames."""

    def __init__(self, bus: BusLayout) -> None:
        self.file = bus.layout.file.rpartition("/")[2]
        """Name of the DBC in use."""
        self.view = View(SignalReader(bus.layout))
        self.gateway = Member(self.view, None, None)
        self.escs = tuple(Esc(self.view, each, index) for index, each in enumerate(bus.escs))
        self.frame_rate: float | None = None
        """Frames of the layout in the last second; None during the first one."""
        self._start: int | None = None
        self._now = -LATEST_NS
        """Times before the trigger of a log are negative."""
        self._second = (0, 0)
        """Begin of the present second, and the number of frames then."""
        parts = self.view.reader.parts
        cyclic = {part.first for part in parts if part.plan.cycle_ns}
        self._missing = cyclic or {part.first for part in parts}
        self.reset()

    @property
    def is_complete(self) -> bool:
        """True once every cyclic message has come."""
        return not self._missing

    def take(self, frame: CanFrame, now: int) -> None:
        """Take a frame that came at ``now``; frames outside the layout are ignored."""
        if frame.remote:
            return
        for first, values in self.view.take(frame.key, frame.data, self.advance(now)) or ():
            self._missing.discard(first)
            for column, raw in enumerate(values, first):
                if column in self._tracked:
                    esc, source = self._tracked[column]
                    value = esc.converted(source, raw)
                    if isinstance(value, (int, float)):
                        esc.tracks[source].take(value)

    def advance(self, now: int) -> int:
        """Advance the time: values of missing messages become not available. Return the time, which never goes back."""
        self._now = now = max(now, self._now)
        if self._start is None:
            self._start, self._second = now, (now, self.view.frames)
        self.view.expire(now)
        begin, frames = self._second
        if seconds := (now - begin) // SECOND:
            self.frame_rate = (self.view.frames - frames) * SECOND / (now - begin)
            self._second = (begin + seconds * SECOND, self.view.frames)
            for esc in self.escs:
                for source, track in esc.tracks.items():
                    track.history.extend([esc.number(source)] * min(seconds, HISTORY_S))
        return now

    def reset(self) -> None:
        """Restart extremes and history."""
        for esc in self.escs:
            esc.tracks = {quantity.source: Track() for quantity in QUANTITIES}
        self._tracked = {
            esc.columns[source]: (esc, source)
            for esc in self.escs
            for source in esc.tracks
            if esc.has(source)
        }

    @property
    def silent_ns(self) -> int:
        """Time since the last frame, or since the start before the first one."""
        last = self.view.last_ns if self.view.last_ns is not None else self._start
        return 0 if last is None else max(0, self._now - last)

    @property
    def is_replay(self) -> bool:
        """True where the gateway reports that it plays a recording."""
        return normalize(self.gateway.text("gateway_state") or "") == "replay"

    def document(self) -> dict[str, Any]:
        """Everything as JSON: source names, values and their units; None for what is not available."""
        return {
            "frames": self.view.frames,
            "gateway": {
                "state": self.gateway.text("gateway_state"),
                "can_state": self.gateway.text("can_state"),
                "uptime_s": self.gateway.number("uptime"),
            },
            "units": {name: unit for esc in self.escs for name, unit in esc.units.items() if unit},
            "escs": [esc.document() for esc in self.escs],
        }
