"""Which objects show what: index and sub-index to a value, in which steps. What is not here is plain storage or a service's own object.

The objects' types, names, limits and PDO defaults are in the EDS; the values, units and ranges in ``VALUES``.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction

from kontronik_can_gw.esc.telemetry import MS, EscTelemetry
from kontronik_can_gw.esc.values import VALUES, Group, Kind, Value, scaled, steps, steps_of
from kontronik_can_gw.gateway_status import GatewayState, GatewayStatus

U8, U16 = 0xFF, 0xFFFF
LIVE, DERIVED, INFO, EXTREMES, LINK, GATEWAY = 0x2000, 0x2001, 0x2010, 0x2011, 0x2020, 0x2021
UNITS = 0x2002
SETTINGS, NODE_ID, RESET_STATISTICS = 0x2100, 0x2101, 0x2102
ERROR_CODE, VELOCITY, DC_LINK_VOLTAGE = 0x603F, 0x606C, 0x6079

# Values in the order of their sub-indices, 1 first.
_LIVE_VALUES = (
    "electrical_speed",
    "battery_voltage",
    "battery_current",
    "motor_current",
    "peak_current",
    "consumed_charge",
    "bec_current",
    "bec_voltage",
    "pwm_input",
    "throttle",
    "output_opening",
    "power_stage_temperature",
    "bec_temperature",
    "operating_errors",
    "operating_state_raw",
    "timing",
)
_EXTREMES = (
    "max_electrical_speed",
    "min_battery_voltage",
    "max_battery_voltage",
    "max_battery_current",
    "max_motor_current",
    "max_peak_current",
    "max_bec_current",
    "min_bec_voltage",
    "max_throttle",
    "max_output_opening",
    "min_power_stage_temperature",
    "max_power_stage_temperature",
    "min_bec_temperature",
    "max_bec_temperature",
)
_DERIVED_VALUES = (
    ("motor_speed", 1),
    ("output_speed", 1),
    ("battery_power", 10),
    ("energy_used", 10),
    ("mean_cell_voltage", 1000),
    ("motor_run_time", 1),
)
_STATUS = frozenset({"operating_errors", "operating_state_raw", "link_status"})
"""A change of these is news by itself; a PDO that carries one is sent on that change."""


@dataclass(frozen=True)
class Bound:
    """A value as an object shows it: ``steps`` steps to one of the value's units."""

    source: Value
    steps: Fraction

    @property
    def status(self) -> bool:
        """True if a change of it is news by itself (errors, state, link)."""
        return self.source.name in _STATUS

    @property
    def slope(self) -> Fraction:
        """Steps of the object for one of the value."""
        return self.steps / self.source.per_unit

    def read(self, esc: EscTelemetry, gateway: GatewayStatus, now: int, high: int) -> int | None:
        """What the object shows now. ``high``: a counter starts again at 0 after it. None: not available."""
        return self._shown(esc, steps(self.source, esc, gateway, now), high)

    def last(self, esc: EscTelemetry, high: int) -> int | None:
        """What the object shows of the last live data, fresh or not."""
        return self._shown(esc, steps_of(self.source, esc, esc.last_live), high)

    def _shown(self, esc: EscTelemetry, found: int | None, high: int) -> int | None:
        value = scaled(self.source, esc, found, self.slope)
        return value % (high + 1) if value is not None and self.source.rolls else value


def _of_link(
    name: str,
    read: Callable[[EscTelemetry], int],
    pace: Group | None = None,
) -> Value:
    """A counter as the objects show it: since it was reset."""
    return Value(
        *(name, "", Group.LINK, Kind.COUNT),
        read=lambda esc, _gateway, _now: read(esc),
        low=0,
        rolls=True,
        pace=pace,
    )


def _age(name: str, stamp: Callable[[EscTelemetry], int | None]) -> Value:
    """In milliseconds; FFFEh: that old or older, FFFFh: nothing has come yet."""

    def read(esc: EscTelemetry, _gateway: GatewayStatus, now: int) -> int:
        at = stamp(esc)
        return U16 if at is None else min(max(0, now - at) // MS, U16 - 1)

    return Value(name, "ms", Group.LINK, Kind.AGE, read=read, low=0, high=U16)


def _link_status(esc: EscTelemetry, gateway: GatewayStatus, _now: int) -> int:
    return esc.link | (gateway.state is GatewayState.REPLAY) << 6 | (esc.info is not None) << 7


def _kept(value: Value) -> Value:
    """Information of the ESC keeps its value while telemetry is lost; bit 7 of the link status shows that it is not fresh."""
    return replace(value, group=Group.LINK, last=True, optional=True, pace=Group.INFO)


_FIRMWARE = Value(
    *("firmware", "", Group.INFO, Kind.WIRE, VALUES["firmware_main"].words), low=0, high=U16
)
_LINK_VALUES = (
    Value("link_status", "", Group.LINK, Kind.STATE, read=_link_status, low=0, high=U8),
    _of_link("live_counter", lambda esc: esc.counters.live, Group.LIVE),
    _age("data_age", lambda esc: esc.live_ns),
    _age("info_age", lambda esc: esc.last_info_ns),
    _of_link("live_frames", lambda esc: esc.counters.live - esc.base.live),
    _of_link("info_frames", lambda esc: esc.counters.info - esc.base.info),
    _of_link("crc_errors", lambda esc: esc.counters.crc_errors - esc.base.crc_errors),
    _of_link("line_errors", lambda esc: esc.line_errors - esc.base_line_errors),
    _of_link("dropped_bytes", lambda esc: esc.counters.dropped_bytes - esc.base.dropped_bytes),
    _of_link("losses", lambda esc: esc.losses - esc.base_losses),
    VALUES["frame_rate"],
)
_GATEWAY_VALUES = (
    ("uptime", 1),
    ("can_state", 1),
    ("sent_frames", 1),
    ("received_frames", 1),
    ("send_failures", 1),
    ("bus_off_count", 1),
    ("replaced_frames", 1),
    ("esc_count", 1),
    ("escs_ok", 1),
)


def _bindings() -> Iterator[tuple[int, int, Value, int]]:
    """Index, sub-index, value and steps of the object to one unit."""
    for sub, name in enumerate(_LIVE_VALUES, 1):
        yield LIVE, sub, VALUES[name], VALUES[name].per_unit
    for sub, (name, per_unit) in enumerate(_DERIVED_VALUES, 1):
        rolls = name in ("energy_used", "motor_run_time")
        yield DERIVED, sub, replace(VALUES[name], rolls=rolls), per_unit
    info = (
        VALUES["device_raw"],
        VALUES["variant"],
        _FIRMWARE,
        VALUES["selftest_errors"],
        VALUES["cell_count"],
    )
    for sub, value in enumerate(info, 1):
        yield INFO, sub, _kept(value), 1
    for sub, name in enumerate(_EXTREMES, 1):
        yield EXTREMES, sub, _kept(VALUES[name]), VALUES[name].per_unit
    for sub, value in enumerate(_LINK_VALUES, 1):
        yield LINK, sub, value, value.per_unit
    for sub, (name, per_unit) in enumerate(_GATEWAY_VALUES, 1):
        yield GATEWAY, sub, VALUES[name], per_unit
    yield VELOCITY, 0, VALUES["motor_speed"], 1
    yield DC_LINK_VOLTAGE, 0, VALUES["battery_voltage"], 1000


BINDINGS: Mapping[tuple[int, int], Bound] = {
    (index, sub): Bound(value, Fraction(per_unit)) for index, sub, value, per_unit in _bindings()
}
"""(Index, sub-index) to what the object shows."""
