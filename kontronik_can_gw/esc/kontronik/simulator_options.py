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


def _check(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ValueError(f"{name}: {value} is outside {low}..{high}")
