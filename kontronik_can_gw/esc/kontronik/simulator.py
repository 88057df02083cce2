"""An ESC with faults on request.

Contract: time is handed in (integer ns), bytes are handed out; the same options, seed and start give the same bytes, however
the calls are spaced. The data does not depend on the faults: they only change what becomes of it on the wire. Nothing blocks,
reads a clock or does I/O. Every frame comes as a ``Sent``, which holds what was meant and what went out.

The flight is synthetic. Of recorded frames it keeps: the idle error word (bit 17 set), state 12 when idle, a logged maximum
battery voltage of 0.00 V before the motor has run, the peak current as a held maximum, no BEC current on a JIVEPro.
"""

import math
from dataclasses import dataclass, field
from random import Random
from typing import NamedTuple

from kontronik_can_gw.esc.decoder import SECOND_NS as SECOND_NS
from kontronik_can_gw.esc.kontronik.codec import Layout as Layout
from kontronik_can_gw.esc.kontronik.codec import encode
from kontronik_can_gw.esc.kontronik.fields import Data
from kontronik_can_gw.esc.kontronik.flight_model import FLIGHT as FLIGHT
from kontronik_can_gw.esc.kontronik.flight_model import FlightModel
from kontronik_can_gw.esc.kontronik.flight_model import Phase as Phase
from kontronik_can_gw.esc.kontronik.states import Device as Device
from kontronik_can_gw.esc.kontronik.states import OperatingError as OperatingError
from kontronik_can_gw.esc.kontronik.states import SelfTestError as SelfTestError

BYTE_NS = 11 * SECOND_NS // 115_200
"""Wire time of a byte: start, 8 data, parity, stop."""


class Dropout(NamedTuple):
    """The line is silent for the last ``duration_ns`` of every ``interval_ns``."""

    duration_ns: int
    interval_ns: int


class ErrorWindow(NamedTuple):
    """An error bit that is set from ``start_ns`` for ``duration_ns`` (None: for ever), counted from the simulation's start."""

    bit: OperatingError | SelfTestError
    start_ns: int
    duration_ns: int | None = None


class Swap(NamedTuple):
    """Another device is plugged in ``time_ns`` after the simulation's start. Layout None: the device's usual one."""

    time_ns: int
    device: Device
    layout: Layout | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Faults:
    """What goes wrong."""

    flipped_bits: float = 0.0
    """Share of the frames' bits that are flipped, 0..1."""
    dropout: Dropout | None = None
    errors: tuple[ErrorWindow, ...] = ()
    swaps: tuple[Swap, ...] = ()
    """In order of time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EscOptions:
    """What ESC it is, and how it sends."""

    device: Device = Device.KOSMIK
    layout: Layout | None = None
    """None: the device's usual one."""
    period_ns: int = 10_000_000
    """From live frame to live frame, 100 µs..10 s."""
    info_every: int = 100
    """An info frame after every n-th live frame; 0: never."""
    profile: tuple[Phase, ...] = FLIGHT
    faults: Faults = field(default_factory=Faults)


def usual_layout(device: Device) -> Layout:
    """The layout in which the simulated device sends by default: legacy for the JIVEPro as recorded, else V4."""
    return Layout.LEGACY if device is Device.JIVEPRO else Layout.V4


class Sent(NamedTuple):
    """A frame and what became of it."""

    time_ns: int
    """When its first byte leaves, on the clock of ``start_ns``."""
    data: Data
    """What the ESC meant to say."""
    frame: bytes
    """The frame as built."""
    wire: bytes
    """What goes out: the frame with flipped bits."""

    @property
    def intact(self) -> bool:
        """Where False, a receiver rejects the frame, but for flips of bits that the legacy layout's CRC does not cover."""
        return self.wire == self.frame


class SimulatedEsc:
    """One ESC. The first frame leaves at ``start_ns``."""

    def __init__(self, options: EscOptions | None = None, seed: int = 0, start_ns: int = 0) -> None:
        options = options or EscOptions()
        faults = options.faults
        self.next_ns = start_ns
        """No frame leaves before this time."""
        self.device = options.device
        self.layout = options.layout or usual_layout(options.device)
        self._options = options
        self._seed = seed
        self._start_ns = start_ns
        self._tick_ns = start_ns
        self._frame_number = 0
        self._info_due = False
        self._model = self._powered_up(options.device, seed)
        self._swaps = list(reversed(faults.swaps))
        self._faults = faults
        self._flips = Random(f"flips {seed}").random

    def frames_until(self, now_ns: int) -> list[Sent]:
        """What leaves up to and including ``now_ns`` and was not returned yet, in order."""
        frames: list[Sent] = []
        while self.next_ns <= now_ns:
            sent = self._next()
            if sent is not None:
                frames.append(sent)
        return frames

    def _next(self) -> Sent | None:
        """The frame due at ``next_ns``, None in a dropout; moves ``next_ns`` on."""
        now_ns = self.next_ns
        since_start = now_ns - self._start_ns
        data: Data
        if self._info_due:
            data = self._model.info(self._word(SelfTestError, since_start))
            self._info_due = False
            self.next_ns = self._tick_ns
        else:
            while self._swaps and since_start >= self._swaps[-1].time_ns:
                self._plug_in(self._swaps.pop())
            options = self._options
            live = self._model.step(self._word(OperatingError, since_start))
            data = live
            self._tick_ns = self.next_ns = now_ns + options.period_ns
            self._frame_number += 1
            if options.info_every and self._frame_number % options.info_every == 0:
                self._info_due = True
                length = 40 if self.layout is Layout.V4 else 38
                self.next_ns = now_ns + min(length * BYTE_NS, options.period_ns // 2)
        if self._faults.dropout is not None:
            duration, interval = self._faults.dropout
            if since_start % interval >= interval - duration:
                return None
        frame = encode(data, self.layout)
        return Sent(now_ns, data, frame, self._spoiled(frame))

    def _plug_in(self, swap: Swap) -> None:
        self.device = swap.device
        self.layout = swap.layout or usual_layout(swap.device)
        self._model = self._powered_up(swap.device, self._seed + 1_000_003 * (1 + len(self._swaps)))
        self._frame_number = 0

    def _powered_up(self, device: Device, seed: int) -> FlightModel:
        options = self._options
        return FlightModel(options.profile, options.period_ns / SECOND_NS, device, seed)

    def _word(self, kind: type[OperatingError] | type[SelfTestError], since_start: int) -> int:
        word = 0
        for bit, start, duration in self._faults.errors:
            end = math.inf if duration is None else start + duration
            if isinstance(bit, kind) and start <= since_start < end:
                word |= 1 << bit
        return word

    def _spoiled(self, frame: bytes) -> bytes:
        share = self._faults.flipped_bits
        if not share:
            return frame
        flips = sum(1 << bit for bit in range(8 * len(frame)) if self._flips() < share)
        return (int.from_bytes(frame, "little") ^ flips).to_bytes(len(frame), "little")
