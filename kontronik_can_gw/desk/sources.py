"""Where the frames of monitor and MQTT come from: the CAN bus, to which nothing is sent, a recording in real time, or a simulation."""

import queue
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from threading import Thread
from typing import Self

from kontronik_can_gw.assembly.assemble import assemble, check_devices
from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.desk.recordings.inputs import Input
from kontronik_can_gw.desk.recordings.layouts import BusLayout
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
from kontronik_can_gw.runtime.can.bus_listener import BusListener
from kontronik_can_gw.runtime.can.open_can import check_interface
from kontronik_can_gw.signals.unpacker import SignalReader
from kontronik_can_gw.times import SECOND

_MAX_LAG_S = 0.5
_LONGEST_SLEEP_S = 0.05

Take = Callable[[CanFrame, int], None]


class Source:
    """Frames with their time."""

    is_file = False
    ended = False
    paused = False
    problem = ""
    """One line while no frames can come."""
    hints: tuple[str, ...] = ()
    """Possible causes where no frame comes."""
    progress = ""
    simulation = ""
    """What is simulated, if the frames are not those of a real bus."""

    def __init__(self, name: str, bus: BusLayout) -> None:
        self.name = name
        self.bus = bus

    def pump(self, take: Take, until_s: float) -> None:
        """Pass on the frames that come until this time of ``time.monotonic``; may return sooner."""
        raise NotImplementedError

    def now(self) -> int:
        """The present time on the clock of the frames, in ns."""
        return time.monotonic_ns()

    def wall_ns(self) -> int | None:
        """Unix time of ``now``; None where not known."""
        return time.time_ns()


def can_config(bus: BusLayout, interface: str | None, channel: str | None) -> CanConfig:
    """The interface to listen on. UserError for one that python-can does not know, and for an ESC's port, to which nothing may be sent."""
    if bus.config is None:
        is_fd = any(message.fd for message in bus.layout.messages)
        can = CanConfig(interface=interface or "socketcan", channel=channel or "can0", fd=is_fd)
    else:
        can = bus.config.can
        if interface not in (None, can.interface):
            # options and channel belong to another kind of interface
            can = replace(can, interface=interface, options={})
        can = replace(can, channel=channel or can.channel)
        check_devices(replace(bus.config, can=can))
    check_interface(can)
    return can


class Bus(Source):
    """Frames from the CAN bus, as context manager. RunError where it cannot be opened, unless ``patient``: then it is tried again."""

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
            "Does the gateway send by another DBC (give -c or --dbc)?",
        )

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
    """Frames of a stream, read by a thread so that nobody has to wait for the next one."""

    def __init__(self, frames: Iterator[TimedFrame]) -> None:
        self._frames = frames
        self._read: queue.Queue[TimedFrame | None] = queue.Queue(1000)
        self._problem: Exception | None = None
        self.have_ended = False
        Thread(target=self._read_all, daemon=True).start()

    def take(self) -> TimedFrame | None:
        """The next frame; None if it has not arrived yet, or after the last one. Raises the reader's exception at its place."""
        try:
            found = self._read.get_nowait()
        except queue.Empty:
            return None
        if found is None:
            self.have_ended = True
            if self._problem is not None:
                raise self._problem
        return found

    def close(self) -> None:
        """Wait for the thread; the stream must have been ended."""
        while not self.have_ended:
            self.have_ended = self._read.get() is None

    def _read_all(self) -> None:
        try:
            for frame in self._frames:
                self._read.put(frame)
        except Exception as error:  # raised again by the thread that takes the frames
            self._problem = error
        self._read.put(None)


class Recording(Source):
    """Frames from a recording, played in real time times ``speed``; ``at_once``: as fast as it can be read.

    A stream is played as its frames arrive, and waits for nothing. While none arrive its clock goes on, so that values expire.
    """

    is_file = True

    def __init__(self, opened: Input, speed: float, at_once: bool = False) -> None:
        super().__init__(Path(opened.name).name, opened.bus)
        self._input, self._speed, self._at_once = opened, speed, at_once
        self._frames = opened.frames()
        self._ahead = None if opened.stream is None else _FramesAhead(self._frames)
        self._next: TimedFrame | None = None
        self._has_begun = False
        self._clock = self._first_ns = 0
        self._last_pump = time.monotonic()
        self._advance()

    def _advance(self) -> None:
        """Fetch the next frame, if there is one yet."""
        if self._ahead is None:
            self._next = next(self._frames, None)
            self.ended = self._next is None
        else:
            self._next = self._ahead.take()
            self.ended = self._ahead.have_ended
        if not self._has_begun and self._next is not None:
            self._has_begun = True
            self._clock = self._first_ns = self._next.time_ns
            self._input.begin_ns = self._first_ns

    def close(self) -> None:
        """End a stream and the thread that reads it."""
        if self._ahead is not None and self._input.stream is not None:
            self._input.stream.end()
            self._ahead.close()

    def pump(self, take: Take, until_s: float) -> None:
        begin = time.monotonic()
        # a delay is not made up for: a slow reader plays slower than asked for
        passed, self._last_pump = min(begin - self._last_pump, _MAX_LAG_S), begin
        pause = _LONGEST_SLEEP_S
        if not self.paused and not self.ended:
            if self._next is None:
                self._advance()
            clock = self._clock + round(passed * self._speed * SECOND) * self._has_begun
            while self._next is not None and (self._at_once or self._next.time_ns <= clock):
                self._clock = max(self._clock, self._next.time_ns)
                take(self._next.frame, self._clock)
                self._advance()
                if time.monotonic() >= until_s:
                    break
            else:
                if not self.ended and not self._at_once:  # at the end the clock stays
                    self._clock = clock
                if self._next is not None:
                    pause = min(pause, (self._next.time_ns - clock) / SECOND / self._speed)
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
        if self.ended:
            parts.append("END OF FILE")
        if self.paused:
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


class DemoBus(Source):
    """A bus on which a gateway sends the telemetry of one flight, again and again."""

    simulation = "simulated ESC and faults"

    def __init__(self, seed: int) -> None:
        esc = {"port": "simulated", "pole_pairs": 7, "gear": 9.8}
        made = assemble(parse({"esc": [esc]}, "demo"))
        assert made.database is not None
        super().__init__("demo", BusLayout(made.database, made.layout, made.escs, made.config))
        now = time.monotonic_ns()
        self._esc = _flight(seed, now)
        self._gateway = Gateway(made.escs, made.layout, now)
        self._gateway.port(0, True, now)
        self._gateway.start(now)

    def pump(self, take: Take, until_s: float) -> None:
        """Let the gateway work until this time."""
        gateway = self._gateway
        while True:
            now = time.monotonic_ns()
            for sent in self._esc.frames_until(now):
                gateway.receive_bytes(0, sent.wire, now, now)
            gateway.advance(now)
            for frame in gateway.take_frames(now):
                take(frame, now)
            if time.monotonic() >= until_s:
                return
            time.sleep(_DEMO_STEP_S)


def _flight(seed: int, start_ns: int) -> SimulatedEsc:
    """A short flight, again and again, with damaged frames, silences and errors."""
    errors = tuple(
        ErrorWindow(_ERRORS[n % len(_ERRORS)], (6 + 13 * n) * SECOND, 3 * SECOND)
        for n in range(1000)
    )
    faults = Faults(flipped_bits=1e-5, dropout=Dropout(SECOND, 17 * SECOND), errors=errors)
    profile = tuple(phase._replace(duration_s=max(1.5, phase.duration_s * 0.4)) for phase in FLIGHT)
    return SimulatedEsc(EscOptions(profile=profile, faults=faults), seed=seed, start_ns=start_ns)
