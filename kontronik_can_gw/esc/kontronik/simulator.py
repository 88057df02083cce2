"""A simulated ESC, with faults on request.

1. Takes time as whole ns and returns frames. Does not block, read a clock or do I/O.
2. The same options, seed and start give the same bytes, however the calls are spaced.
3. The faults of the line do not change the data, only the bytes on the wire. Each frame is returned
   as a ``SimulatedFrame``, which has both.

The flight is synthetic. These details are as in recorded frames: the idle error word (bit 17 set),
state 12 when idle, a logged maximum battery voltage of 0.00 V before the motor has run, the peak
current as a held maximum, no BEC current on a JIVEPro.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import NamedTuple

from kontronik_can_gw.esc.decoder import SECOND_NS as SECOND_NS
from kontronik_can_gw.esc.kontronik.codec import WireLayout as WireLayout
from kontronik_can_gw.esc.kontronik.codec import encode
from kontronik_can_gw.esc.kontronik.fields import Data, InfoData, LiveData, device_and_variant, rows
from kontronik_can_gw.esc.kontronik.states import Device as Device
from kontronik_can_gw.esc.kontronik.states import OperatingError as OperatingError
from kontronik_can_gw.esc.kontronik.states import OperatingState
from kontronik_can_gw.esc.kontronik.states import SelfTestError as SelfTestError

BYTE_NS = 11 * SECOND_NS // 115_200
"""Time of a byte on the wire: start, 8 data, parity and stop bit."""


_STANDING = frozenset(state for state in OperatingState if state <= OperatingState.StandBy)
_CELLS = 6
_CAPACITY_MAH = 5000
"""Capacity of the battery.

If less than a fifth is left at the end of the profile, a full battery is plugged in and the ESC
powers up again.
"""
_MAX_CURRENT_A = 120.0
"""Approximate motor current at full throttle."""
_AMBIENT_C = 22.0
_VARIANT = 120
_FIRMWARE = 4 << 8 | 17
"""Firmware 4.17."""
_SPEED_PER_VOLT = 2500.0
"""Electrical speed in 1/min for each volt at the motor."""
_FULL_SPEED = 3.8 * _CELLS * _SPEED_PER_VOLT
_WITHOUT_BEC_CURRENT = rows(LiveData)["bec_current"].not_on
_EXTREMES = [name for name in InfoData._fields if name.startswith(("max_", "min_"))]
"""Names of the logged extremes: "max_" or "min_" and the name of the live field."""


class Phase(NamedTuple):
    """A part of the profile. The throttle ramps linearly to ``throttle``, then stays."""

    name: str
    duration_s: float
    throttle: int
    """-100..100 %. Above 0 the motor is driven, below 0 it is braked by regeneration."""
    state: OperatingState
    ramp_s: float = 1.0
    """Duration of the ramp. 0: the throttle jumps."""


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
"""A profile of 50 s, which is repeated for ever."""


class FlightModel:
    """Battery, motor and temperatures of one ESC, in steps of ``period_s`` since its power-up."""

    def __init__(
        self,
        profile: Sequence[Phase],
        period_s: float,
        device: Device,
        seed: int,
    ) -> None:
        self._profile = profile
        self._device = device
        self._dt = period_s
        self._random = Random(f"model {seed}").random
        self._strength_a = _MAX_CURRENT_A * (0.95 + 0.1 * self._random())
        """Current scale of this ESC's motor."""
        self._stage_c = _AMBIENT_C + 4 + 2 * self._random()
        self._bec_c = _AMBIENT_C + 6 + 2 * self._random()
        self._phases = self._endless_phases()
        self.phase = next(self._phases)
        self._phase_s = 0.0
        """Time since the start of the phase."""
        self._ramp_from = 0.0
        """Throttle at the start of the phase's ramp, in %."""

    def _endless_phases(self) -> Iterator[Phase]:
        """Yield the phases with one battery after another. Each begins a new log of the ESC."""
        while True:
            self._full = 0.94 + 0.06 * self._random()
            """Charge of the fresh battery as a share of its capacity."""
            self._charge_mah = 0.0
            self._speed = 0.0
            self._throttle = 0.0
            self._peak = 0
            self._log: dict[str, int] = {}
            yield from POWER_UP
            while self._charge_mah <= 0.8 * _CAPACITY_MAH:
                yield from self._profile

    def step(self, errors: int) -> LiveData:
        """Advance by one period and return the live data at its end.

        The bits of ``errors`` are set in addition to the bits implied by the state.
        """
        self._phase_s += self._dt
        while self._phase_s >= self.phase.duration_s:
            self._phase_s -= self.phase.duration_s
            self.phase = next(self._phases)
            # Between driving and braking the throttle jumps to 0, so that the sign of the current
            # always agrees with the state.
            has_same_sign = self.phase.throttle * self._throttle >= 0
            self._ramp_from = self._throttle if has_same_sign else 0.0
        phase = self.phase
        ramp = 1.0
        if phase.ramp_s:
            ramp = min(self._phase_s / phase.ramp_s, 1.0)
        self._throttle = self._ramp_from + (phase.throttle - self._ramp_from) * ramp
        live = self._compute_live(self._throttle / 100, errors)
        self._update_log(live)
        return live

    def _compute_live(self, drive: float, errors: int) -> LiveData:
        """Advance the model of a propeller by one period and return the live data.

        ``drive`` is the throttle, -1..1. The current rises with the square of the speed. Braking
        charges the battery.
        """
        charge_left = max(self._full - self._charge_mah / _CAPACITY_MAH, 0.0)
        open_v = _CELLS * (3.5 + 0.7 * charge_left)
        motor_a, battery_a = self._compute_currents(drive)
        settled_speed = open_v * max(drive, 0.0) * _SPEED_PER_VOLT
        self._speed = self._settle(self._speed, settled_speed, 0.4 if drive else 1.25)
        if drive <= 0 and self._speed < 400:
            self._speed = 0.0
        self._charge_mah += max(battery_a, 0.0) * self._dt / 3.6
        bec_a = 0.25 + 0.1 * self._random()
        if drive > 0:
            bec_a += 0.8 * self._random()
        self._update_temperatures(motor_a, bec_a)

        battery_raw = round(battery_a * 10)
        motor_raw = round(motor_a * 10)
        peak = battery_raw if self._device.peak_current_of == "battery" else motor_raw
        self._peak = max(self._peak, peak + peak // 8)
        throttle = round(self._throttle)
        is_standing = self.phase.state in _STANDING
        has_bec_current = self._device not in _WITHOUT_BEC_CURRENT
        return LiveData(
            electrical_speed=round(self._speed),
            battery_voltage=round((open_v - battery_a * 0.015) * 100),
            battery_current=battery_raw,
            motor_current=motor_raw,
            peak_current=self._peak,
            consumed_charge=int(self._charge_mah),
            bec_current=round(bec_a * 1000) if has_bec_current else 0,
            bec_voltage=round((8.03 - 0.02 * bec_a) * 1000),
            pwm_input=1001 + (9 * throttle if throttle > 0 else throttle),
            throttle=throttle,
            output_opening=abs(throttle) if self._speed > 0 else 0,
            power_stage_temperature=round(self._stage_c),
            bec_temperature=round(self._bec_c),
            operating_errors=errors | is_standing << OperatingError.PROGRAMMING_ALLOWED,
            operating_state=self.phase.state,
            timing=20,
        )

    def _compute_currents(self, drive: float) -> tuple[float, float]:
        """Return the current in the motor and the current from the battery, in A."""
        part = self._speed / _FULL_SPEED
        if drive > 0:
            noise = 0.98 + 0.04 * self._random()
            motor_a = self._strength_a * (0.75 * part * part + 0.01) * noise
            return motor_a, motor_a * drive
        if drive < 0:
            motor_a = self._strength_a * (1.5 * drive - 0.3) * part
            return motor_a, motor_a * part
        return 0.0, 0.0

    def _update_temperatures(self, motor_a: float, bec_a: float) -> None:
        settled_c = _AMBIENT_C + 4 + 60 * abs(motor_a) / _MAX_CURRENT_A
        self._stage_c = self._settle(self._stage_c, settled_c, 25)
        settled_c = _AMBIENT_C + 5 + 4 * bec_a + 0.2 * (self._stage_c - _AMBIENT_C)
        self._bec_c = self._settle(self._bec_c, settled_c, 40)

    def _settle(self, value: float, target: float, lag_s: float) -> float:
        """Return the value one period later, if it approaches ``target`` with this lag."""
        return value + (target - value) * min(self._dt / lag_s, 1.0)

    def _update_log(self, live: LiveData) -> None:
        """Update the ESC's own log, the extremes of InfoData."""
        log = self._log
        for name in _EXTREMES:
            extreme, _, field_name = name.partition("_")
            value = getattr(live, field_name)
            choose = max if extreme == "max" else min
            log[name] = choose(log.get(name, value), value)
        if not log["max_electrical_speed"]:
            log["max_battery_voltage"] = 0

    def info(self, selftest_errors: int) -> InfoData:
        """Return the info data: extremes of all live data since power-up, sent or not."""
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
    """An error bit that is set for a time."""

    bit: OperatingError | SelfTestError
    start_ns: int
    """Counted from the start of the simulation."""
    duration_ns: int | None = None
    """None: the bit stays set."""


class Swap(NamedTuple):
    """Another device replaces the present one."""

    time_ns: int
    """Counted from the start of the simulation."""
    device: Device
    layout: WireLayout | None = None
    """None: the usual layout of the device."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Faults:
    """Faults of the line and of the ESC."""

    flipped_bits: float = 0.0
    """Probability that a bit of a frame is flipped, 0..1."""
    dropout: Dropout | None = None
    errors: tuple[ErrorWindow, ...] = ()
    swaps: tuple[Swap, ...] = ()
    """Ordered by time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EscOptions:
    """The device and the way it sends."""

    device: Device = Device.KOSMIK
    layout: WireLayout | None = None
    """None: the usual layout of the device."""
    period_ns: int = 10_000_000
    """Time from one live frame to the next, 100 µs..10 s."""
    info_every: int = 100
    """An info frame follows every n-th live frame. 0: never."""
    profile: tuple[Phase, ...] = FLIGHT
    faults: Faults = field(default_factory=Faults)


def usual_layout(device: Device) -> WireLayout:
    """Return the layout that the simulated device uses by default.

    It is legacy for the JIVEPro, as in recordings, and V4 for all others.
    """
    return WireLayout.LEGACY if device is Device.JIVEPRO else WireLayout.V4


class SimulatedFrame(NamedTuple):
    """A frame before and after the faults of the line."""

    time_ns: int
    """Time at which its first byte leaves, on the clock of ``start_ns``."""
    data: Data
    frame: bytes
    """The correct frame with ``data``."""
    wire: bytes
    """The frame with flipped bits."""

    @property
    def intact(self) -> bool:
        """False if bits are flipped.

        A receiver then rejects the frame, unless the CRC of the legacy layout covers none of them.
        """
        return self.wire == self.frame


class SimulatedEsc:
    """One simulated ESC. The first frame leaves at ``start_ns``."""

    def __init__(
        self,
        options: EscOptions | None = None,
        seed: int = 0,
        start_ns: int = 0,
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
        self._is_info_due = False
        self._model = self._power_up(options.device, seed)
        self._swaps = list(reversed(faults.swaps))
        self._faults = faults
        self._flips = Random(f"flips {seed}").random

    def frames_until(self, now_ns: int) -> list[SimulatedFrame]:
        """Return the frames up to and including ``now_ns`` that were not returned yet, in order."""
        frames: list[SimulatedFrame] = []
        while self.next_ns <= now_ns:
            sent = self._make_next_frame()
            if sent is not None:
                frames.append(sent)
        return frames

    def _make_next_frame(self) -> SimulatedFrame | None:
        """Return the frame due at ``next_ns``, or None in a dropout. Update ``next_ns``."""
        now_ns = self.next_ns
        since_start = now_ns - self._start_ns
        data: Data
        if self._is_info_due:
            data = self._model.info(self._error_word(SelfTestError, since_start))
            self._is_info_due = False
            self.next_ns = self._tick_ns
        else:
            while self._swaps and since_start >= self._swaps[-1].time_ns:
                self._plug_in(self._swaps.pop())
            options = self._options
            data = self._model.step(self._error_word(OperatingError, since_start))
            self._tick_ns = now_ns + options.period_ns
            self.next_ns = self._tick_ns
            self._frame_number += 1
            if options.info_every and self._frame_number % options.info_every == 0:
                self._is_info_due = True
                length = 40 if self.layout is WireLayout.V4 else 38
                self.next_ns = now_ns + min(length * BYTE_NS, options.period_ns // 2)
        if self._faults.dropout is not None:
            duration, interval = self._faults.dropout
            if since_start % interval >= interval - duration:
                return None
        frame = encode(data, self.layout)
        return SimulatedFrame(now_ns, data, frame, self._flip_bits(frame))

    def _plug_in(self, swap: Swap) -> None:
        self.device = swap.device
        self.layout = swap.layout or usual_layout(swap.device)
        seed = self._seed + 1_000_003 * (1 + len(self._swaps))
        self._model = self._power_up(swap.device, seed)
        self._frame_number = 0

    def _power_up(self, device: Device, seed: int) -> FlightModel:
        options = self._options
        return FlightModel(options.profile, options.period_ns / SECOND_NS, device, seed)

    def _error_word(
        self, bits: type[OperatingError] | type[SelfTestError], since_start: int
    ) -> int:
        """Return the word with the bits of this class that are set at this time."""
        word = 0
        for bit, start, duration in self._faults.errors:
            end = math.inf if duration is None else start + duration
            if isinstance(bit, bits) and start <= since_start < end:
                word |= 1 << bit
        return word

    def _flip_bits(self, frame: bytes) -> bytes:
        share = self._faults.flipped_bits
        if not share:
            return frame
        bits = int.from_bytes(frame, "little")
        for bit in range(8 * len(frame)):
            if self._flips() < share:
                bits ^= 1 << bit
        return bits.to_bytes(len(frame), "little")
