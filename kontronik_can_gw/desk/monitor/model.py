"""The model of the live screen: values of gateway and ESCs, extremes and a short history.

All values are read from CAN frames. Pure: no I/O, no clock.
"""

from collections import deque
from typing import Any

from kontronik_can_gw.desk.member import Alarm, Member
from kontronik_can_gw.desk.quantities import QUANTITIES
from kontronik_can_gw.desk.receiver.unpacker import SignalReader
from kontronik_can_gw.desk.receiver.view import View
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.recordings.recording import LATEST_NS
from kontronik_can_gw.esc.decoder import Severity
from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.esc.values import VALUES
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.times import SECOND

HISTORY_S = 60
"""Length of a history, which has one value for each second."""
SILENCE_NS = 5 * SECOND
"""After this time without a frame the screen shows possible causes."""


_QUIET = "Quiet"


class Track:
    """Minimum, maximum and history of a value.

    The history has None for each second in which the value was not available.
    """

    def __init__(self) -> None:
        self.low: float | None = None
        self.high: float | None = None
        self.last: float | None = None
        """The newest value, also after it has expired."""
        self.last_ns = 0
        """The time at which ``last`` was received."""
        self.history: deque[float | None] = deque(maxlen=HISTORY_S)
        self._step: tuple[float, float] | None = None
        """Extremes since the last call of ``take_step``, in the order of their times."""

    def add(self, value: float, now: int) -> None:
        self.last = value
        self.last_ns = now
        if self.low is None or value < self.low:
            self.low = value
        if self.high is None or value > self.high:
            self.high = value
        first, second = self._step or (value, value)
        if value < min(first, second):
            self._step = (max(first, second), value)
        elif value > max(first, second) or self._step is None:
            self._step = (min(first, second), value)

    def take_step(self, value: float | None) -> tuple[float | None, float | None]:
        """Return the extremes since the last call in the order of their times.

        If no value was added, they are the present ``value``.
        """
        step = self._step or (value, value)
        self._step = None
        return step


class Esc(Member):
    """One ESC as seen on the bus. Its values are updated by ``Monitor.advance``."""

    tracks: dict[str, Track]

    @property
    def device_text(self) -> str:
        """Device, variant and firmware. Empty if they are not available."""
        if not self.device:
            return ""
        text = self.device
        variant = self.number("variant")
        if variant is not None:
            text += f" {variant:.0f}"
        if self.firmware:
            text += f", firmware {self.firmware}"
        return text

    @property
    def active(self) -> list[Alarm]:
        """The error bits that are set."""
        return [flag for word in self.protocol.errors for flag in self.flags(word) or ()]

    @property
    def units(self) -> dict[str, str]:
        """Unit of each source in the DBC, except flags and error words."""
        names = self.no_flags.keys() - self.protocol.errors.keys()
        return {name: value.unit for name, value in VALUES.items() if name in names}

    def document(self) -> dict[str, Any]:
        """Return all data as JSON. Values that are not available are None."""
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
    """The gateway and the ESCs of a layout. Times are in ns on the clock of the frames."""

    def __init__(self, bus: BusLayout) -> None:
        self.file = bus.layout.file.rpartition("/")[2]
        """Name of the DBC in use."""
        self.view = View(SignalReader(bus.layout))
        self.gateway = Member(self.view, None, None)
        escs = [Esc(self.view, settings, index) for index, settings in enumerate(bus.escs)]
        self.escs = tuple(escs)
        self.frame_rate: float | None = None
        """Frames of the layout in the last second. None during the first second."""
        self.is_quiet = False
        """True after the gateway's last state was Quiet: it sends nothing until an ESC is heard."""
        self._start: int | None = None
        self._now = -LATEST_NS
        """The present time. Times before the trigger of a log are negative."""
        self._second_ns = 0
        """Begin of the present second."""
        self._second_frames = 0
        """Number of frames at the begin of the present second."""
        parts = self.view.reader.parts
        cyclic = {part.first for part in parts if part.plan.cycle_ns}
        self._missing = cyclic or {part.first for part in parts}
        """First columns of the messages that were not received yet."""
        self.reset()

    @property
    def is_complete(self) -> bool:
        """True after each cyclic message was received."""
        return not self._missing

    def take(self, frame: CanFrame, now: int) -> None:
        """Evaluate a frame that was received at ``now``, if it is in the layout."""
        if frame.remote:
            return
        now = self.advance(now)
        decoded = self.view.take(frame.key, frame.data, now)
        if decoded:
            self.is_quiet = normalize(self.gateway.text("gateway_state") or "") == "quiet"
        for first, values in decoded or ():
            self._missing.discard(first)
            for column, raw in enumerate(values, first):
                if column not in self._tracked:
                    continue
                esc, source = self._tracked[column]
                value = esc.converted(source, raw)
                if isinstance(value, (int, float)):
                    esc.tracks[source].add(value, now)

    def advance(self, now: int) -> int:
        """Set the time and expire the values of missing messages.

        Returns the time, which never decreases.
        """
        now = max(now, self._now)
        self._now = now
        frames = self.view.frames
        if self._start is None:
            self._start = now
            self._second_ns = now
            self._second_frames = frames
        self.view.expire(now)
        elapsed_ns = now - self._second_ns
        seconds = elapsed_ns // SECOND
        if seconds:
            self.frame_rate = (frames - self._second_frames) * SECOND / elapsed_ns
            self._second_ns += seconds * SECOND
            self._second_frames = frames
            repeats = min(seconds, HISTORY_S)
            for esc in self.escs:
                for source, track in esc.tracks.items():
                    track.history.extend([esc.number(source)] * repeats)
        return now

    def restart_extremes(self) -> None:
        """Restart minimum and maximum, and keep the history."""
        for esc in self.escs:
            for track in esc.tracks.values():
                track.low = None
                track.high = None

    def reset(self) -> None:
        """Restart extremes and history."""
        self._tracked: dict[int, tuple[Esc, str]] = {}
        """ESC and source of each column that has a track."""
        for esc in self.escs:
            esc.tracks = {quantity.source: Track() for quantity in QUANTITIES}
            for source in esc.tracks:
                if esc.has(source):
                    self._tracked[esc.columns[source]] = (esc, source)

    @property
    def silent_ns(self) -> int:
        """Time since the last frame. Before the first frame, the time since the start."""
        last_ns = self.view.last_ns
        if last_ns is None:
            last_ns = self._start
        return 0 if last_ns is None else max(0, self._now - last_ns)

    @property
    def gateway_state(self) -> str | None:
        """The gateway's state. A quiet gateway does not repeat it."""
        return _QUIET if self.is_quiet else self.gateway.text("gateway_state")

    @property
    def is_replay(self) -> bool:
        """True if the gateway reports that it plays a recording."""
        return normalize(self.gateway.text("gateway_state") or "") == "replay"

    def document(self) -> dict[str, Any]:
        """Return all data as JSON: sources, values and units. None means not available."""
        units: dict[str, str] = {}
        for esc in self.escs:
            units |= {name: unit for name, unit in esc.units.items() if unit}
        return {
            "frames": self.view.frames,
            "gateway": {
                "state": self.gateway_state,
                "can_state": self.gateway.text("can_state"),
                "uptime_s": self.gateway.number("uptime"),
            },
            "units": units,
            "escs": [esc.document() for esc in self.escs],
        }
