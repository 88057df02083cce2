"""The model of the live screen: the ESCs and the gateway as their frames show them. Pure; time is an argument."""

from typing import Any

from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.dbc.view import View
from kontronik_can_gw.desk.member import Member
from kontronik_can_gw.desk.monitor.esc_monitor import EscMonitor
from kontronik_can_gw.desk.monitor.quantities import HISTORY_S
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.signals.unpacker import SignalReader

SILENCE_NS = 5 * SECOND
"""After this time without a frame the screen shows possible causes."""


class Monitor:
    """The ESCs and the gateway of a layout. ``now``: nanoseconds on the clock of the frames."""

    def __init__(self, bus: BusLayout) -> None:
        self.bus = bus
        self.view = View(SignalReader(bus.layout))
        self.gateway = Member(self.view, None, None)
        self.escs = tuple(
            EscMonitor(settings, index, self.view) for index, settings in enumerate(bus.escs)
        )
        self.frame_rate: float | None = None
        """Frames of the layout in the last second; None during the first one."""
        self._start: int | None = None
        self._now = 0
        self._second = (0, 0)
        """Begin of the present second, and the number of frames then."""
        self._tracked = {
            esc.columns[source]: (esc, source, track)
            for esc in self.escs
            for source, track in esc.tracks.items()
            if esc.has(source)
        }
        parts = self.view.reader.parts
        cyclic = {part.first for part in parts if part.plan.cycle_ns}
        self._missing = cyclic or {part.first for part in parts}

    @property
    def is_complete(self) -> bool:
        """True once every cyclic message has come."""
        return not self._missing

    @property
    def frames(self) -> int:
        return self.view.frames

    def take(self, frame: CanFrame, now: int) -> None:
        """Take a frame that came at ``now``; frames outside the layout are ignored."""
        if frame.remote:
            return
        chunks = self.view.take(frame.key, frame.data, self.advance(now)) or ()
        for first, values in chunks:
            self._missing.discard(first)
            for column, raw in enumerate(values, first):
                if column in self._tracked:
                    esc, source, track = self._tracked[column]
                    value = esc.converted(source, raw)
                    if isinstance(value, (int, float)):
                        track.take(value)

    def advance(self, now: int) -> int:
        """Advance the time: values of missing messages become not available. Return the time, which never goes back."""
        self._now = now = max(now, self._now)
        if self._start is None:
            self._start, self._second = now, (now, self.frames)
        self.view.expire(now)
        begin, frames = self._second
        seconds = (now - begin) // SECOND
        if seconds:
            self.frame_rate = (self.frames - frames) * SECOND / (now - begin)
            self._second = (begin + seconds * SECOND, self.frames)
            for esc in self.escs:
                for source, track in esc.tracks.items():
                    track.history.extend([esc.number(source)] * min(seconds, HISTORY_S))
        return now

    def reset(self) -> None:
        """Restart extremes and history."""
        for esc in self.escs:
            for track in esc.tracks.values():
                track.reset()
        self._start = self._now

    @property
    def watched_s(self) -> float:
        """Seconds since the start, or since the extremes were reset."""
        return 0.0 if self._start is None else (self._now - self._start) / SECOND

    @property
    def silent_ns(self) -> int:
        """Time since the last frame, or since the start before the first one."""
        last = self.view.last_ns if self.view.last_ns is not None else self._start
        return 0 if last is None else max(0, self._now - last)

    @property
    def gateway_state(self) -> str | None:
        """Name of the gateway's state; None where it is not available."""
        return self.gateway.text("gateway_state")

    @property
    def can_state(self) -> str | None:
        """Name of the state of the gateway's CAN controller; None where it is not available."""
        return self.gateway.text("can_state")

    @property
    def is_replay(self) -> bool:
        """True where the gateway reports that it plays a recording."""
        return normalize(self.gateway_state or "") == "replay"

    def document(self) -> dict[str, Any]:
        """Everything as JSON: source names, values and their units; None for what is not available."""
        return {
            "frames": self.frames,
            "gateway": {
                "state": self.gateway_state,
                "can_state": self.can_state,
                "uptime_s": self.gateway.number("uptime"),
            },
            "units": {name: unit for esc in self.escs for name, unit in esc.units.items() if unit},
            "escs": [esc.document() for esc in self.escs],
        }
