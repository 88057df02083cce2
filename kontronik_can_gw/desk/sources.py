"""Sources of CAN frames for the monitor and MQTT.

They are the CAN bus, to which nothing is sent, a recording in real time, and a simulation.
"""

import queue
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from threading import Thread
from typing import Protocol, Self

from kontronik_can_gw.assembly.assemble import assemble, check_devices
from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.desk.receiver.bus_listener import BusListener
from kontronik_can_gw.desk.receiver.unpacker import SignalReader
from kontronik_can_gw.desk.recordings.inputs import Input
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.recordings.replay import TimedFrame
from kontronik_can_gw.esc.kontronik.simulator import (
    FLIGHT,
    Dropout,
    ErrorWindow,
    EscOptions,
    Faults,
    OperatingError,
    SimulatedEsc,
)
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.can.open_can import check_interface
from kontronik_can_gw.times import SECOND

_MAX_LAG_S = 0.5
"""Longest delay after which a recording is played faster to make up for it."""
_LONGEST_SLEEP_S = 0.05

Take = Callable[[CanFrame, int], None]


class Source:
    """A source of frames with their times."""

    is_file = False
    has_ended = False
    is_paused = False
    problem = ""
    """The reason why frames cannot be received, in one line. Empty while they can be received."""
    hints: tuple[str, ...] = ()
    """Possible causes if no frame is received."""
    progress = ""
    simulation = ""
    """Description of the simulation. Empty for a real bus and a recording."""

    def __init__(self, name: str, bus: BusLayout) -> None:
        self.name = name
        self.bus = bus

    def pump(self, take: Take, until_s: float) -> None:
        """Pass frames to ``take`` until this time of ``time.monotonic``. May return earlier."""
        raise NotImplementedError

    def now(self) -> int:
        """Return the present time on the clock of the frames, in ns."""
        return time.monotonic_ns()

    def wall_ns(self) -> int | None:
        """Return the Unix time of ``now``. None if it is unknown."""
        return time.time_ns()


def can_config(bus: BusLayout, interface: str | None, channel: str | None) -> CanConfig:
    """Return the settings of the interface to listen on.

    Raises UserError if python-can does not have the interface. Also raises it if the channel is the
    port of an ESC, because nothing may be sent to an ESC.
    """
    if bus.config is None:
        is_fd = any(message.fd for message in bus.layout.messages)
        can = CanConfig(interface=interface or "socketcan", channel=channel or "can0", fd=is_fd)
    else:
        can = bus.config.can
        if interface not in (None, can.interface):
            # the configured options and channel are for another kind of interface
            can = replace(can, interface=interface, options={})
        can = replace(can, channel=channel or can.channel)
        check_devices(replace(bus.config, can=can))
    check_interface(can)
    return can


class Bus(Source):
    """The CAN bus as a context manager.

    Raises RunError if the bus cannot be opened. If ``patient``, opening is tried again instead.
    """

    def __init__(self, bus: BusLayout, config: CanConfig, patient: bool = False) -> None:
        super().__init__(config.channel, bus)
        self._listener = BusListener(config, SignalReader(bus.layout).keys, patient)
        self.problem = self._listener.problem
        rate = f"{config.bitrate // 1000} kbit/s"
        if config.interface == "socketcan":
            rate = f"ip -details link show {config.channel}"
        self.hints = (
            "Is the gateway running (kontronik-can-gw status)?",
            f"Is the bit rate right ({rate})?",
            "Does the gateway use another DBC (give -c or --dbc)?",
        )
        if bus.config is None or config.quiet_after_s:
            self.hints += ("Is the vehicle parked (can.quiet_after_s)?",)

    def pump(self, take: Take, until_s: float) -> None:
        frames = self._listener.receive(max(0.0, until_s - time.monotonic()))
        self.problem = self._listener.problem
        now = time.monotonic_ns()
        for frame in frames:
            take(frame, now)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.close()


class _FramesAhead:
    """Reads the frames of a stream in a thread, so that no caller waits for the next frame."""

    def __init__(self, frames: Iterator[TimedFrame]) -> None:
        self._frames = frames
        self._read: queue.Queue[TimedFrame | None] = queue.Queue(1000)
        self._problem: Exception | None = None
        self.has_ended = False
        Thread(target=self._read_all, daemon=True).start()

    def take(self) -> TimedFrame | None:
        """Return the next frame. None if it has not arrived yet, and after the last frame.

        An exception of the reader is raised after the frames that were read before it.
        """
        try:
            found = self._read.get_nowait()
        except queue.Empty:
            return None
        if found is None:
            self.has_ended = True
            if self._problem is not None:
                raise self._problem
        return found

    def close(self) -> None:
        """Wait for the thread. The stream must have been ended."""
        while not self.has_ended:
            self.has_ended = self._read.get() is None

    def _read_all(self) -> None:
        try:
            for frame in self._frames:
                self._read.put(frame)
        except Exception as error:  # raised again by the thread that takes the frames
            self._problem = error
        self._read.put(None)


class PlayedRecording(Source):
    """A recording that is played at ``speed`` times real time.

    With ``at_once`` it is played as fast as it can be read. A stream is played as its frames
    arrive. While no frames arrive its clock continues, so that values expire.
    """

    is_file = True

    def __init__(self, opened: Input, speed: float, at_once: bool = False) -> None:
        super().__init__(Path(opened.name).name, opened.bus)
        self._input = opened
        self._speed = speed
        self._at_once = at_once
        self._frames = opened.frames()
        self._ahead = None if opened.stream is None else _FramesAhead(self._frames)
        self._next: TimedFrame | None = None
        self._has_begun = False
        self._first_ns = 0
        """Time of the first frame."""
        self._clock = 0
        """The present time on the recording's clock."""
        self._last_pump = time.monotonic()
        self._advance()

    def _advance(self) -> None:
        """Fetch the next frame, if it has arrived."""
        if self._ahead is None:
            self._next = next(self._frames, None)
            self.has_ended = self._next is None
        else:
            self._next = self._ahead.take()
            self.has_ended = self._ahead.has_ended
        if not self._has_begun and self._next is not None:
            self._has_begun = True
            self._first_ns = self._next.time_ns
            self._clock = self._first_ns
            self._input.begin_ns = self._first_ns

    def close(self) -> None:
        """End a stream and the thread that reads it."""
        if self._ahead is not None and self._input.stream is not None:
            self._input.stream.end()
            self._ahead.close()

    def pump(self, take: Take, until_s: float) -> None:
        begin = time.monotonic()
        # a longer delay is not made up for, so a slow reader plays slower than requested
        passed_s = min(begin - self._last_pump, _MAX_LAG_S)
        self._last_pump = begin
        pause = _LONGEST_SLEEP_S
        if not self.is_paused and not self.has_ended:
            if self._next is None:
                self._advance()
            clock = self._clock
            if self._has_begun:
                clock += round(passed_s * self._speed * SECOND)
            while self._next is not None and (self._at_once or self._next.time_ns <= clock):
                self._clock = max(self._clock, self._next.time_ns)
                take(self._next.frame, self._clock)
                self._advance()
                if time.monotonic() >= until_s:
                    break
            else:
                if not self.has_ended and not self._at_once:  # the clock stops at the end
                    self._clock = clock
                if self._next is not None:
                    wait_s = (self._next.time_ns - clock) / SECOND / self._speed
                    pause = min(pause, wait_s)
        pause = min(pause, until_s - time.monotonic())
        if pause > 0 and (not self._at_once or self._next is None):
            time.sleep(pause)

    def now(self) -> int:
        return self._clock

    @property
    def progress(self) -> str:  # type: ignore[override]
        seconds = (self._clock - self._first_ns) // SECOND
        parts = [f"{seconds // 60}:{seconds % 60:02}"]
        if self._speed != 1:
            parts.append(f"x{self._speed:g}")
        if self.has_ended:
            parts.append("END OF FILE")
        if self.is_paused:
            parts.append("PAUSED")
        return "  ".join(parts)

    def wall_ns(self) -> int | None:
        return self._input.wall_ns(self._clock)


_ERRORS = (
    OperatingError.POWER_STAGE_OVERTEMP_WARNING,
    OperatingError.BEC_OVERCURRENT,
    OperatingError.UNDERVOLTAGE,
    OperatingError.LIMIT_DISCHARGED_CAPACITY,
)
_DEMO_STEP_S = 0.005
"""Time between two steps of the simulated gateway."""


class Listener(Protocol):
    """Gets frames, and is called again and again."""

    def take(self, frame: CanFrame, now: int) -> None: ...

    def tick(self) -> float: ...


class DemoBus(Source):
    """A simulated bus on which a gateway repeatedly sends the telemetry of one flight."""

    simulation = "simulated ESC and faults"

    def __init__(self, seed: int) -> None:
        esc = {"port": "simulated", "pole_pairs": 7, "gear": 9.8}
        made = assemble(parse({"esc": [esc]}, "demo"))
        assert made.database is not None
        self.listeners: list[Listener] = []
        """Get all frames, besides the caller of ``pump``."""
        super().__init__("demo", BusLayout(made.database, made.layout, made.escs, made.config))
        now = time.monotonic_ns()
        self._esc = _flight(seed, now)
        self._gateway = Gateway(CoreSettings(made.escs, made.layout), now)
        self._gateway.port(0, True, now)
        self._gateway.start(now)

    def pump(self, take: Take, until_s: float) -> None:
        """Run the gateway until this time."""
        gateway = self._gateway
        while True:
            now = time.monotonic_ns()
            for sent in self._esc.frames_until(now):
                gateway.receive_bytes(0, sent.wire, now, now)
            gateway.advance(now)
            for frame in gateway.take_frames(now):
                take(frame, now)
                for listener in self.listeners:
                    listener.take(frame, now)
            for listener in self.listeners:
                listener.tick()
            if time.monotonic() >= until_s:
                return
            time.sleep(_DEMO_STEP_S)


def _flight(seed: int, start_ns: int) -> SimulatedEsc:
    """Return an ESC in a short flight that is repeated, with damaged frames, gaps and errors."""
    errors = []
    for number in range(1000):
        error = _ERRORS[number % len(_ERRORS)]
        begin_s = 6 + 13 * number
        errors.append(ErrorWindow(error, begin_s * SECOND, 3 * SECOND))
    dropout = Dropout(SECOND, 17 * SECOND)
    faults = Faults(flipped_bits=1e-5, dropout=dropout, errors=tuple(errors))
    profile = []
    for phase in FLIGHT:
        duration_s = max(1.5, phase.duration_s * 0.4)
        profile.append(phase._replace(duration_s=duration_s))
    options = EscOptions(profile=tuple(profile), faults=faults)
    return SimulatedEsc(options, seed=seed, start_ns=start_ns)
