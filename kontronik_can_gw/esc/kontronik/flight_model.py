"""The flight of a simulated ESC: battery, motor and heat, as live data and information."""

from collections.abc import Sequence
from random import Random
from typing import NamedTuple

from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData, device_and_variant, rows
from kontronik_can_gw.esc.kontronik.states import (
    Device,
    OperatingError,
    OperatingState,
)

_STANDING = frozenset(state for state in OperatingState if state <= OperatingState.StandBy)
_CELLS = 6
_CAPACITY = 5000
"""mAh of the battery. When less than a fifth is left at the profile's end, a fresh one is plugged in: the ESC powers up anew, its log
and charge begin again."""
_MAX_CURRENT = 120.0
"""A in the motor at full throttle."""
_AMBIENT = 22.0
"""°C"""
_VARIANT = 120
_FIRMWARE = 4 << 8 | 17
"""4.17"""
_SPEED_PER_VOLT = 2500.0  # electrical 1/min for each V at the motor
_SUPPLIES_NO_BEC_CURRENT = rows(LiveData)["bec_current"].not_on


_LOGGED_FROM_ZERO = frozenset(
    {
        *("electrical_speed", "battery_current", "motor_current", "peak_current", "bec_current"),
        *("throttle", "output_opening"),
    }
)
"""The log of their greatest values begins at 0."""


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
        self._measures_battery_peak = device.peak_current_of == "battery"
        self._supplies_bec_current = device not in _SUPPLIES_NO_BEC_CURRENT
        self._strength = _MAX_CURRENT * (0.95 + 0.1 * self._random())
        self._stage_temperature = _AMBIENT + 4 + 2 * self._random()
        self._bec_temperature = _AMBIENT + 6 + 2 * self._random()
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
        profile = self._profile
        at = self._next_phase - len(POWER_UP)
        if at < 0:
            self.phase = POWER_UP[self._next_phase]
        elif at and at % len(profile) == 0 and self._charge > 0.8 * _CAPACITY:
            self._power_up()
        else:
            self.phase = profile[at % len(profile)]
            # From driving to braking and back the throttle jumps to 0: no current runs against the state.
            target = self.phase.throttle
            self._ramp_from = self._throttle if target * self._throttle >= 0 else 0.0

    def step(self, errors: int) -> LiveData:
        """One period on; the live data at its end. ``errors`` are set beside the bits that belong to the state."""
        self._phase_s += self._dt
        while self._phase_s >= self.phase.duration_s:
            self._enter_next_phase()
        phase = self.phase
        ramp = min(self._phase_s / phase.ramp_s, 1.0) if phase.ramp_s else 1.0
        self._throttle = self._ramp_from + (phase.throttle - self._ramp_from) * ramp
        motor_current, battery_current, voltage = self._drive(self._throttle / 100)
        bec_current = 0.25 + 0.1 * self._random()
        if self._throttle > 0:
            bec_current += 0.8 * self._random()
        if battery_current > 0:
            self._charge += battery_current * self._dt / 3.6
        self._heat(motor_current, bec_current)
        live = self._in_steps(motor_current, battery_current, voltage, bec_current, errors)
        self._remember(live)
        return live

    def _drive(self, drive: float) -> tuple[float, float, float]:
        """Motor current, battery current and battery voltage; ``drive``: throttle, -1..1.

        A propeller: current with the square of the speed and with the acceleration.
        """
        dt, speed = self._dt, self._speed
        state_of_charge = max(self._full - self._charge / _CAPACITY, 0.0)
        open_voltage = _CELLS * (3.5 + 0.7 * state_of_charge)
        full_speed = 3.8 * _CELLS * _SPEED_PER_VOLT
        motor_current = battery_current = 0.0
        part = speed / full_speed
        if drive > 0:
            lag = open_voltage * drive * _SPEED_PER_VOLT - speed
            # else it turns faster: nothing is driven until the speed is down
            if lag > -0.03 * full_speed:
                motor_current = self._strength * (
                    0.75 * part * part + min(max(lag, 0) / full_speed, 0.4) + 0.01
                )
                motor_current *= 0.98 + 0.04 * self._random()
            battery_current = motor_current * drive
            speed += lag * min(dt / 0.4, 1.0)
        elif speed > 0:
            strength = 0.3 - 1.5 * drive  # the stronger the more negative
            motor_current = -self._strength * strength * part if drive < 0 else 0.0
            battery_current = motor_current * part
            speed -= speed * min(dt * (0.5 + strength), 1.0)
            if speed < 400:
                speed = 0.0
        self._speed = speed
        voltage = open_voltage - battery_current * _CELLS * 0.3 / _MAX_CURRENT
        return motor_current, battery_current, voltage

    def _heat(self, motor_current: float, bec_current: float) -> None:
        """A first-order lag each. At full load the power stage settles about 60 K above ambient."""
        stage, bec, dt = self._stage_temperature, self._bec_temperature, self._dt
        settled = 4 + 60 * abs(motor_current) / _MAX_CURRENT + _AMBIENT
        stage += (settled - stage) * min(dt / 25, 1.0)
        settled = 5 + 4 * bec_current + 0.2 * (stage - _AMBIENT) + _AMBIENT
        bec += (settled - bec) * min(dt / 40, 1.0)
        self._stage_temperature, self._bec_temperature = stage, bec

    def _in_steps(
        self,
        motor_current: float,
        battery_current: float,
        voltage: float,
        bec_current: float,
        errors: int,
    ) -> LiveData:
        """As the ESC says it."""
        battery_raw, motor_raw = round(battery_current * 10), round(motor_current * 10)
        peak = battery_raw if self._measures_battery_peak else motor_raw
        if peak > 0:
            self._peak = max(self._peak, peak + peak // 8)
        if self.phase.state in _STANDING:
            errors |= 1 << OperatingError.PROGRAMMING_ALLOWED
        throttle = round(self._throttle)
        return LiveData(
            electrical_speed=round(self._speed),
            battery_voltage=round(voltage * 100),
            battery_current=battery_raw,
            motor_current=motor_raw,
            peak_current=self._peak,
            consumed_charge=int(self._charge),
            bec_current=round(bec_current * 1000) if self._supplies_bec_current else 0,
            bec_voltage=round((8.03 - 0.02 * bec_current) * 1000),
            pwm_input=1001 + (9 * throttle if throttle > 0 else throttle),
            throttle=throttle,
            output_opening=abs(throttle) if self._speed > 0 else 0,
            power_stage_temperature=round(self._stage_temperature),
            bec_temperature=round(self._bec_temperature),
            operating_errors=errors,
            operating_state=self.phase.state,
            timing=20,
        )

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
        return InfoData(
            device_and_variant=device_and_variant(self._device, _VARIANT),
            firmware_word=_FIRMWARE,
            selftest_errors=selftest_errors,
            cell_count=_CELLS,
            **self._log,
        )
