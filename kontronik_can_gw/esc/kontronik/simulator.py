"""An ESC with faults on request.

Contract: time is handed in (integer ns), bytes are handed out; the same options, seed and start give the same bytes, however
the calls are spaced. The data does not depend on the faults: they only change what becomes of it on the wire. Nothing blocks,
reads a clock or does I/O. Every frame comes as a ``Sent``, which holds what was meant and what went out.

The flight is synthetic. Of recorded frames it keeps: the idle error word (bit 17 set), state 12 when idle, a logged maximum
battery voltage of 0.00 V before the motor has run, the peak current as a held maximum, no BEC current on a JIVEPro.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import NamedTuple

from kontronik_can_gw.esc.decoder import SECOND_NS as SECOND_NS
from kontronik_can_gw.esc.kontronik.codec import Layout as Layout
from kontronik_can_gw.esc.kontronik.codec import encode
from kontronik_can_gw.esc.kontronik.fields import Data, InfoData, LiveData, device_and_variant, rows
from kontronik_can_gw.esc.kontronik.states import Device as Device
from kontronik_can_gw.esc.kontronik.states import OperatingError as OperatingError
from kontronik_can_gw.esc.kontronik.states import OperatingState
from kontronik_can_gw.esc.kontronik.states import SelfTestError as SelfTestError

BYTE_NS = 11 * SECOND_NS // 115_200
"""Wire time of a byte: start, 8 data, parity, stop."""


_STANDING = frozenset(state for state in OperatingState if state <= OperatingState.StandBy)
_CELLS, _CAPACITY = 6, 5000
"""mAh of the battery. When less than a fifth is left at the profile's end, a fresh one is plugged in: the ESC powers up anew."""
_MAX_CURRENT = 120.0
"""A in the motor at full throttle, about."""
_AMBIENT = 22.0
"""°C"""
_VARIANT, _FIRMWARE = 120, 4 << 8 | 17
"""4.17"""
_SPEED_PER_VOLT = 2500.0  # electrical 1/min for each V at the motor
_FULL_SPEED = 3.8 * _CELLS * _SPEED_PER_VOLT
_SUPPLIES_NO_BEC_CURRENT = rows(LiveData)["bec_current"].not_on
_EXTREMES = tuple(
    name.partition("_")[::2] for name in InfoData._fields if name[:4] in ("max_", "min_")
)


class Phase(NamedTuple):
    """A part of the profile. The throttle moves evenly to ``throttle`` within ``ramp_s``, then stays."""

    name: str
    duration_s: float
    throttle: int
    """-100..100 %; the motor is driven above 0 and braked by regeneration below 0."""
    state: OperatingState
    ramp_s: float = 1.0


POWER_UP = (
    Phase("self-test", 0.2, 0, OperatingState.Selftest),
    Phase("wait", 0.3, 0, OperatingState.WaitForMotorOff),
    Phase("beep", 0.5, 0, OperatingState.AcousticSignal),
)
"""Played once after power-up."""

FLIGHT = (
    Phase("idle", 4, 0, OperatingState.MotorOff),
    Phase("spool-up", 4, 60, OperatingState.SpoolUpFromStill, 4),
    Phase("hover", 8, 65, OperatingState.RPMControl),
    Phase("climb", 6, 95, OperatingState.RPMControl, 2),
    Phase("regeneration", 2, -20, OperatingState.Brake, 0.5),
    Phase("recover", 2, 60, OperatingState.SpoolUpFromTurn, 2),
    Phase("cruise", 8, 55, OperatingState.Forward),
    Phase("stop", 4, -30, OperatingState.Brake, 0.5),
    Phase("cool-down", 12, 0, OperatingState.MotorOff, 0.5),
)
"""The profile, 50 s, repeated for ever."""


class FlightModel:
    """Battery, motor and heat of one ESC since its power-up, stepped each ``period_s``."""

    def __init__(
        self, profile: Sequence[Phase], period_s: float, device: Device, seed: int
    ) -> None:
        self._profile = profile
        self._device = device
        self._dt = period_s
        self._random = Random(f"model {seed}").random
        self._strength = _MAX_CURRENT * (0.95 + 0.1 * self._random())
        self._stage_temperature = _AMBIENT + 4 + 2 * self._random()
        self._bec_temperature = _AMBIENT + 6 + 2 * self._random()
        self._phases = self._batteries()
        self.phase = next(self._phases)
        self._phase_s = self._ramp_from = 0.0

    def _batteries(self) -> Iterator[Phase]:
        """The phases of one battery after the other; with each the ESC's log begins again."""
        while True:
            self._full = 0.94 + 0.06 * self._random()
            self._charge = self._speed = self._throttle = 0.0
            self._peak = 0
            self._log: dict[str, int] = {}
            yield from POWER_UP
            while self._charge <= 0.8 * _CAPACITY:
                yield from self._profile

    def step(self, errors: int) -> LiveData:
        """One period on; the live data at its end. ``errors`` are set beside the bits that belong to the state."""
        self._phase_s += self._dt
        while self._phase_s >= self.phase.duration_s:
            self._phase_s -= self.phase.duration_s
            self.phase = phase = next(self._phases)
            # from driving to braking and back the throttle jumps to 0: no current runs against the state
            self._ramp_from = self._throttle if phase.throttle * self._throttle >= 0 else 0.0
        phase = self.phase
        ramp = min(self._phase_s / phase.ramp_s, 1.0) if phase.ramp_s else 1.0
        self._throttle = self._ramp_from + (phase.throttle - self._ramp_from) * ramp
        live = self._driven(self._throttle / 100, errors)
        self._remember(live)
        return live

    def _driven(self, drive: float, errors: int) -> LiveData:
        """A propeller: current with the square of the speed. ``drive``: throttle, -1..1; the brake feeds the battery."""
        random, part = self._random, self._speed / _FULL_SPEED
        open_voltage = _CELLS * (3.5 + 0.7 * max(self._full - self._charge / _CAPACITY, 0.0))
        motor_current = battery_current = 0.0
        if drive > 0:
            motor_current = self._strength * (0.75 * part * part + 0.01) * (0.98 + 0.04 * random())
            battery_current = motor_current * drive
        elif drive < 0:
            motor_current = self._strength * (1.5 * drive - 0.3) * part
            battery_current = motor_current * part
        wanted = open_voltage * max(drive, 0.0) * _SPEED_PER_VOLT
        self._speed = self._later(self._speed, wanted, 0.4 if drive else 1.25)
        if drive <= 0 and self._speed < 400:
            self._speed = 0.0
        self._charge += max(battery_current, 0.0) * self._dt / 3.6
        bec_current = 0.25 + 0.1 * random() + (0.8 * random() if drive > 0 else 0.0)
        settled = _AMBIENT + 4 + 60 * abs(motor_current) / _MAX_CURRENT
        self._stage_temperature = self._later(self._stage_temperature, settled, 25)
        settled = _AMBIENT + 5 + 4 * bec_current + 0.2 * (self._stage_temperature - _AMBIENT)
        self._bec_temperature = self._later(self._bec_temperature, settled, 40)

        battery_raw, motor_raw = round(battery_current * 10), round(motor_current * 10)
        peak = battery_raw if self._device.peak_current_of == "battery" else motor_raw
        self._peak = max(self._peak, peak + peak // 8)
        throttle = round(self._throttle)
        standing = self.phase.state in _STANDING
        return LiveData(
            electrical_speed=round(self._speed),
            battery_voltage=round((open_voltage - battery_current * 0.015) * 100),
            battery_current=battery_raw,
            motor_current=motor_raw,
            peak_current=self._peak,
            consumed_charge=int(self._charge),
            bec_current=round(bec_current * 1000) * (self._device not in _SUPPLIES_NO_BEC_CURRENT),
            bec_voltage=round((8.03 - 0.02 * bec_current) * 1000),
            pwm_input=1001 + (9 * throttle if throttle > 0 else throttle),
            throttle=throttle,
            output_opening=abs(throttle) if self._speed > 0 else 0,
            power_stage_temperature=round(self._stage_temperature),
            bec_temperature=round(self._bec_temperature),
            operating_errors=errors | standing << OperatingError.PROGRAMMING_ALLOWED,
            operating_state=self.phase.state,
            timing=20,
        )

    def _later(self, now: float, settled: float, seconds: float) -> float:
        """A value one period on that settles with this lag."""
        return now + (settled - now) * min(self._dt / seconds, 1.0)

    def _remember(self, live: LiveData) -> None:
        """The ESC's own log: the extremes of InfoData."""
        log = self._log
        for extreme, of in _EXTREMES:
            value, name = getattr(live, of), f"{extreme}_{of}"
            log[name] = (max if extreme == "max" else min)(log.get(name, value), value)
        if not log["max_electrical_speed"]:
            log["max_battery_voltage"] = 0

    def info(self, selftest_errors: int) -> InfoData:
        """The info data now: extremes of all live data since power-up, sent or not."""
        return InfoData(
            device_and_variant=device_and_variant(self._device, _VARIANT),
            firmware_word=_FIRMWARE,
            selftest_errors=selftest_errors,
            cell_count=_CELLS,
            **self._log,
        )


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
