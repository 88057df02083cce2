"""The flight of a simulated ESC: battery, motor and heat, as live data and information."""

from collections.abc import Iterator, Sequence
from random import Random
from typing import NamedTuple

from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData, device_and_variant, rows
from kontronik_can_gw.esc.kontronik.states import Device, OperatingError, OperatingState

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
