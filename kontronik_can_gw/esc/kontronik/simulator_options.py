"""What a simulated ESC can be asked for: device and flight profile, faults on its wire."""

from dataclasses import dataclass, field
from typing import NamedTuple

from kontronik_can_gw.esc.kontronik.codec import Layout
from kontronik_can_gw.esc.kontronik.states import (
    Device,
    OperatingError,
    OperatingState,
    SelfTestError,
)

SECOND_NS = 1_000_000_000


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
