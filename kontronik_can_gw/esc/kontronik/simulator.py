"""An ESC with faults on request.

Contract: time is handed in (integer ns), bytes are handed out; the same options, seed and start give the same bytes, however
the calls are spaced. The data does not depend on the faults: they only change what becomes of it on the wire. Nothing blocks,
reads a clock or does I/O. Every frame comes as a ``Sent``, which holds what was meant and what went out.

The flight is synthetic. Of recorded frames it keeps: the idle error word (bit 17 set), state 12 when idle, a logged maximum
battery voltage of 0.00 V before the motor has run, the peak current as a held maximum, no BEC current on a JIVEPro.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from random import Random
from typing import NamedTuple

from kontronik_can_gw.esc.kontronik.codec import Layout, encode
from kontronik_can_gw.esc.kontronik.fields import Data, InfoData, LiveData, device_and_variant, rows
from kontronik_can_gw.esc.kontronik.states import (
    Device,
    OperatingError,
    OperatingState,
    SelfTestError,
    peak_current_of,
)

__all__ = ["Device", "Layout", "OperatingError", "SelfTestError"]  # what its options are made of
BYTE_NS = 11 * 1_000_000_000 // 115_200
"""Wire time of a byte: start, 8 data, parity, stop."""
SECOND_NS = 1_000_000_000


class Sent(NamedTuple):
    """A frame and what became of it."""

    time_ns: int
    """When its first byte leaves, on the clock of ``start_ns``."""
    data: Data
    """What the ESC meant to say."""
    frame: bytes
    """The frame as built."""
    wire: bytes
    """What goes out: noise in front, then the frame less lost bytes, with flipped bits."""
    intact: bool
    """The frame is whole in ``wire``. Where False, a receiver rejects the frame, with two exceptions: in the legacy layout a
    flipped bit in the last bytes before the CRC (live: 32, 33; info: 36) is not covered, and is accepted; and a lost last
    byte may happen to be replaced by what follows, which is then missing there."""


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

IDLE = (Phase("idle", 60, 0, OperatingState.MotorOff),)
"""A motor that never runs."""


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
    """What goes wrong. ValueError for a value out of range."""

    noise: float = 0.0
    """Mean number of random bytes in front of a frame, 0..1000."""
    lost_bytes: float = 0.0
    """Share of the frames' bytes that get lost, 0..1."""
    flipped_bits: float = 0.0
    """Share of the frames' bits that are flipped, 0..1."""
    dropout: Dropout | None = None
    errors: tuple[ErrorWindow, ...] = ()
    swaps: tuple[Swap, ...] = ()
    """In order of time."""

    def __post_init__(self) -> None:
        _check("noise", self.noise, 0, 1000)
        _check("lost bytes", self.lost_bytes, 0, 1)
        _check("flipped bits", self.flipped_bits, 0, 1)
        if (
            self.dropout is not None
            and not 0 <= self.dropout.duration_ns < self.dropout.interval_ns
        ):
            raise ValueError("dropout: the duration must be shorter than the interval")
        if list(self.swaps) != sorted(self.swaps, key=lambda swap: swap.time_ns):
            raise ValueError("swaps: must be in order of time")


@dataclass(frozen=True, slots=True, kw_only=True)
class EscOptions:
    """What ESC it is, and how it sends. ValueError for a value out of range."""

    device: Device = Device.KOSMIK
    layout: Layout | None = None
    """None: the device's usual one."""
    variant: int = 120
    """0..1023"""
    firmware: tuple[int, int] = (4, 17)
    """Main and sub version, each 0..255."""
    cell_count: int = 6
    """1..100"""
    capacity: int = 5000
    """mAh of the battery, 100..50000. When less than a fifth is left at the profile's end, a fresh one is plugged in: the
    ESC powers up anew, its log and charge begin again."""
    max_current: float = 120.0
    """Motor current at full throttle in A, 1..600."""
    ambient: float = 22.0
    """°C, -40..60"""
    period_ns: int = 10_000_000
    """From live frame to live frame, 100 µs..10 s."""
    info_every: int = 100
    """An info frame with every n-th live frame; 0: never."""
    info_replaces: bool = False
    """The info frame takes the live frame's place; otherwise it follows at once."""
    profile: tuple[Phase, ...] = FLIGHT
    faults: Faults = field(default_factory=Faults)

    def __post_init__(self) -> None:
        _check("variant", self.variant, 0, 1023)
        for part in self.firmware:
            _check("firmware version", part, 0, 255)
        _check("cell count", self.cell_count, 1, 100)
        _check("capacity", self.capacity, 100, 50_000)
        _check("maximum current", self.max_current, 1, 600)
        _check("ambient temperature", self.ambient, -40, 60)
        _check("period in ns", self.period_ns, 100_000, 10 * SECOND_NS)
        _check("info frame distance", self.info_every, 0, 1_000_000)
        if not self.profile:
            raise ValueError("profile: needs at least one phase")
        for phase in self.profile:
            _check(f"phase {phase.name}: duration", phase.duration_s, 0.001, 1e6)
            _check(f"phase {phase.name}: throttle", phase.throttle, -100, 100)
            _check(f"phase {phase.name}: ramp", phase.ramp_s, 0, 1e6)


def usual_layout(device: Device) -> Layout:
    """The layout in which the simulated device sends by default: legacy for the JIVEPro as recorded, else V4."""
    return Layout.LEGACY if device is Device.JIVEPRO else Layout.V4


class SimulatedEsc:
    """One ESC. The first frame leaves at ``start_ns``."""

    __slots__ = (
        "_dropout",
        "_errors",
        "_faulty",
        "_flips",
        "_frame_number",
        "_info_due",
        "_losses",
        "_model",
        "_noise_step",
        "_options",
        "_random",
        "_seed",
        "_start_ns",
        "_swaps",
        "_tick_ns",
        "device",
        "layout",
        "next_ns",
    )

    def __init__(
        self, options: EscOptions | None = None, *, seed: int = 0, start_ns: int = 0
    ) -> None:
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
        self._model = _Model(options, options.device, seed)
        self._swaps = list(reversed(faults.swaps))
        self._errors = faults.errors
        self._dropout = faults.dropout
        self._random = Random(f"faults {seed}")
        self._noise_step = math.log(faults.noise / (1 + faults.noise)) if faults.noise else 0.0
        self._losses = _Hits(faults.lost_bytes, Random(f"losses {seed}"))
        self._flips = _Hits(faults.flipped_bits, Random(f"flips {seed}"))
        self._faulty = bool(faults.noise or faults.lost_bytes or faults.flipped_bits)

    @property
    def phase(self) -> str:
        """Name of the phase the profile is in."""
        return self._model.phase.name

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
                if options.info_replaces:
                    data = self._model.info(self._word(SelfTestError, since_start))
                else:
                    self._info_due = True
                    length = 40 if self.layout is Layout.V4 else 38
                    self.next_ns = now_ns + min(length * BYTE_NS, options.period_ns // 2)
        if self._dropout is not None:
            duration, interval = self._dropout
            if since_start % interval >= interval - duration:
                return None
        frame = encode(data, self.layout)
        if not self._faulty:
            return Sent(now_ns, data, frame, frame, True)
        return self._spoil(now_ns, data, frame)

    def _plug_in(self, swap: Swap) -> None:
        self.device = swap.device
        self.layout = swap.layout or usual_layout(swap.device)
        self._model = _Model(
            self._options, swap.device, self._seed + 1_000_003 * (1 + len(self._swaps))
        )
        self._frame_number = 0

    def _word(self, kind: type[OperatingError] | type[SelfTestError], since_start: int) -> int:
        word = 0
        for bit, start, duration in self._errors:
            if (
                isinstance(bit, kind)
                and since_start >= start
                and (duration is None or since_start < start + duration)
            ):
                word |= 1 << bit
        return word

    def _spoil(self, now_ns: int, data: Data, frame: bytes) -> Sent:
        body: bytes | bytearray = frame
        flips = self._flips.within(8 * len(frame))
        losses = self._losses.within(len(frame))
        if flips or losses:
            body = bytearray(frame)
            for bit in flips:
                body[bit // 8] ^= 1 << bit % 8
            for at in reversed(losses):
                del body[at]
        wire = bytes(body)
        intact = not flips and not losses
        if self._noise_step:
            wire = self._noise() + wire
        return Sent(now_ns, data, frame, wire, intact)

    def _noise(self) -> bytes:
        """Random bytes, geometric in number; one in eight ends with the beginning of a header."""
        random = self._random
        noise = random.randbytes(int(math.log(1 - random.random()) / self._noise_step))
        if noise and random.random() < 0.125:
            start = b"KODL"[: random.randint(1, min(4, len(noise)))]
            noise = noise[: len(noise) - len(start)] + start
        return noise


class _Hits:
    """Positions hit independently with one probability, drawn as distances: free where nothing is hit."""

    __slots__ = ("_distances", "_left")

    def __init__(self, probability: float, random: Random) -> None:
        self._distances = _distances(probability, random)
        self._left = next(self._distances)

    def within(self, length: int) -> list[int]:
        """The positions hit in the next ``length`` places, ascending."""
        hits = []
        while self._left < length:
            hits.append(int(self._left))
            self._left += 1 + next(self._distances)
        self._left -= length
        return hits


def _distances(probability: float, random: Random) -> Iterator[float]:
    """Numbers of places not hit between two hits."""
    if probability <= 0:
        while True:
            yield math.inf
    if probability >= 1:
        while True:
            yield 0
    scale = math.log1p(-probability)
    while True:
        yield math.log(1 - random.random()) // scale


_STANDING = frozenset(state for state in OperatingState if state <= OperatingState.StandBy)
_INT16 = 32_767
_SPEED_PER_VOLT = 2500.0  # electrical 1/min for each V at the motor
_SUPPLIES_NO_BEC_CURRENT = rows(LiveData)["bec_current"].not_on


_LOGGED_FROM_ZERO = frozenset(
    {
        *("electrical_speed", "battery_current", "motor_current", "peak_current", "bec_current"),
        *("throttle", "output_opening"),
    }
)
"""The log of their greatest values begins at 0."""


class _Model:
    """Battery, motor and heat of one ESC since its power-up, stepped once a period."""

    __slots__ = (
        "_bec_temperature",
        "_charge",
        "_device",
        "_dt",
        "_full",
        "_has_run",
        "_log",
        "_measures_battery_peak",
        "_next_phase",
        "_options",
        "_peak",
        "_phase_s",
        "_ramp_from",
        "_random",
        "_speed",
        "_stage_temperature",
        "_strength",
        "_supplies_bec_current",
        "_throttle",
        "phase",
    )

    def __init__(self, options: EscOptions, device: Device, seed: int) -> None:
        self._options = options
        self._device = device
        self._dt = options.period_ns / 1e9
        self._random = Random(f"model {seed}").random
        self._measures_battery_peak = peak_current_of(device) == "battery"
        self._supplies_bec_current = device not in _SUPPLIES_NO_BEC_CURRENT
        self._strength = options.max_current * (0.95 + 0.1 * self._random())
        self._stage_temperature = options.ambient + 4 + 2 * self._random()
        self._bec_temperature = options.ambient + 6 + 2 * self._random()
        self._power_up()

    def _power_up(self) -> None:
        self._full = 0.94 + 0.06 * self._random()
        self._charge = 0.0
        self._speed = 0.0
        self._throttle = 0.0
        self._peak = 0
        self._has_run = False
        self._log: dict[str, int] = {}
        self._next_phase = 0
        self._phase_s = 0.0
        self._ramp_from = 0.0
        self.phase = POWER_UP[0]

    def _enter_next_phase(self) -> None:
        self._phase_s -= self.phase.duration_s
        self._next_phase += 1
        profile = self._options.profile
        at = self._next_phase - len(POWER_UP)
        if at < 0:
            self.phase = POWER_UP[self._next_phase]
        elif at and at % len(profile) == 0 and self._charge > 0.8 * self._options.capacity:
            self._power_up()
        else:
            self.phase = profile[at % len(profile)]
            # From driving to braking and back the throttle jumps to 0: no current runs against the state.
            target = self.phase.throttle
            self._ramp_from = self._throttle if target * self._throttle >= 0 else 0.0

    def step(self, errors: int) -> LiveData:
        """One period on; the live data at its end. ``errors`` are set beside the bits that belong to the state."""
        options = self._options
        dt = self._dt
        random = self._random

        self._phase_s += dt
        while self._phase_s >= self.phase.duration_s:
            self._enter_next_phase()
        phase = self.phase
        ramp = min(self._phase_s / phase.ramp_s, 1.0) if phase.ramp_s else 1.0
        throttle = self._throttle = self._ramp_from + (phase.throttle - self._ramp_from) * ramp

        # Motor: a propeller, current with the square of the speed and with the acceleration.
        cells = options.cell_count
        state_of_charge = max(self._full - self._charge / options.capacity, 0.0)
        open_voltage = cells * (3.5 + 0.7 * state_of_charge)
        full_speed = 3.8 * cells * _SPEED_PER_VOLT
        drive = throttle / 100
        speed = self._speed
        if drive > 0:
            lag = open_voltage * drive * _SPEED_PER_VOLT - speed
            if lag > -0.03 * full_speed:
                part = speed / full_speed
                motor_current = self._strength * (
                    0.75 * part * part + min(max(lag, 0) / full_speed, 0.4) + 0.01
                )
                motor_current *= 0.98 + 0.04 * random()
            else:  # slower than it turns: nothing is driven until the speed is down
                motor_current = 0.0
            battery_current = motor_current * drive
            speed += lag * min(dt / 0.4, 1.0)
        elif speed > 0:
            strength = 0.3 - 1.5 * drive  # the stronger the more negative
            part = speed / full_speed
            motor_current = -self._strength * strength * part if drive < 0 else 0.0
            battery_current = motor_current * part
            speed -= speed * min(dt * (0.5 + strength), 1.0)
            if speed < 400:
                speed = 0.0
        else:
            motor_current = battery_current = 0.0
        self._speed = speed
        voltage = open_voltage - battery_current * cells * 0.3 / options.max_current

        bec_current = 0.25 + 0.1 * random() + (0.8 * random() if drive > 0 else 0.0)
        bec_voltage = 8.03 - 0.02 * bec_current
        if battery_current > 0:
            self._charge += battery_current * dt / 3.6

        # Heat: a first-order lag each. At full load the power stage settles about 60 K above ambient.
        stage = self._stage_temperature
        stage += (
            4 + 60 * abs(motor_current) / options.max_current + options.ambient - stage
        ) * min(dt / 25, 1.0)
        self._stage_temperature = stage
        bec = self._bec_temperature
        bec += (
            5 + 4 * bec_current + 0.2 * (stage - options.ambient) + options.ambient - bec
        ) * min(dt / 40, 1.0)
        self._bec_temperature = bec

        # Raw steps. What could leave its wire type is kept inside.
        battery_raw = min(max(round(battery_current * 10), -_INT16), _INT16)
        motor_raw = min(max(round(motor_current * 10), -_INT16), _INT16)
        peak = battery_raw if self._measures_battery_peak else motor_raw
        if peak > 0:
            peak = min(peak + peak // 8, _INT16)
            self._peak = max(self._peak, peak)
        if phase.state in _STANDING:
            errors |= 1 << OperatingError.PROGRAMMING_ALLOWED
        rounded_throttle = round(throttle)
        live = LiveData(
            electrical_speed=round(speed),
            battery_voltage=min(max(round(voltage * 100), 0), 65_535),
            battery_current=battery_raw,
            motor_current=motor_raw,
            peak_current=self._peak,
            consumed_charge=min(int(self._charge), 65_535),
            bec_current=round(bec_current * 1000) if self._supplies_bec_current else 0,
            bec_voltage=round(bec_voltage * 1000),
            pwm_input=1001 + (9 * rounded_throttle if rounded_throttle > 0 else rounded_throttle),
            throttle=rounded_throttle,
            output_opening=abs(rounded_throttle) if speed > 0 else 0,
            power_stage_temperature=min(max(round(stage), -128), 127),
            bec_temperature=min(max(round(bec), -128), 127),
            operating_errors=errors,
            operating_state=phase.state,
            timing=20,
        )
        self._remember(live)
        return live

    def _remember(self, live: LiveData) -> None:
        """The ESC's own log: the extremes of InfoData."""
        self._has_run = self._has_run or live.electrical_speed > 0
        log = self._log
        for name in InfoData._fields:
            extreme, _, of = name.partition("_")
            if extreme not in ("max", "min"):
                continue
            value: int = getattr(live, of)
            if name not in log:
                log[name] = 0 if of in _LOGGED_FROM_ZERO else value
            log[name] = max(log[name], value) if extreme == "max" else min(log[name], value)
        if not self._has_run:
            log["max_battery_voltage"] = 0

    def info(self, selftest_errors: int) -> InfoData:
        """The info data now: extremes of all live data since power-up, sent or not."""
        options = self._options
        main, sub = options.firmware
        pair = device_and_variant(self._device, options.variant)
        return InfoData(
            device_and_variant=pair,
            firmware_word=main << 8 | sub,
            selftest_errors=selftest_errors,
            cell_count=options.cell_count,
            **self._log,
        )


def _check(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ValueError(f"{name}: {value} is outside {low}..{high}")
