"""Every value that can be published: name, unit, when it is available, how it comes about.

DBC signals and CANopen objects bind to these by name. A value is a whole number of steps divided by a divisor of the ESC (pole
pairs, gear, cells), which may change at run time: physical = steps / ``per_unit`` / divisor. ``steps`` and ``physical`` read any
of them; the packers generate the same arithmetic from the numbers of a Value.
"""

import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from fractions import Fraction
from typing import Any

from kontronik_can_gw.esc.kontronik.fields import DataType, InfoData, LiveData, rows
from kontronik_can_gw.esc.kontronik.states import (
    Device,
    ErrorBit,
    OperatingError,
    OperatingState,
    SelfTestError,
)
from kontronik_can_gw.esc.telemetry import (
    MS,
    MWS_PER_WH,
    SECOND,
    EscSettings,
    EscTelemetry,
    LinkState,
)
from kontronik_can_gw.gateway_status import CanState, GatewayState, GatewayStatus


class Group(Enum):
    """When a value is available: with fresh live data, with info of the present device, or always."""

    LIVE = "live"
    INFO = "info"
    LINK = "link"
    GATEWAY = "gateway"


class Kind(Enum):
    """How a value comes about."""

    WIRE = "a field of the reading"
    BITS = "some bits of a field"
    PRODUCT = "two fields multiplied"
    INTEGRAL = "summed over time"
    RUN_TIME = "time in a state"
    COUNT = "a counter"
    AGE = "time since an event"
    RATE = "events a second"
    STATE = "a state of the link"
    GATEWAY = "of the gateway itself"


class Divisor(Enum):
    """What the steps of a value are divided by."""

    ONE = "1"
    POLE_PAIRS = "pole pairs"
    OUTPUT = "pole pairs and gear"
    CELLS = "cells"


Read = Callable[[EscTelemetry, GatewayStatus, int], int | None]
"""ESC, gateway and time to steps; None: not available. A value of the gateway must not use the ESC."""


@dataclass(frozen=True, eq=False)
class Value:
    """A publishable value.

    Steps of WIRE, BITS and PRODUCT come from the fields ``words`` (indices) of the live or info reading; all others are ``read``.
    ``low``..``high`` in steps (None: no limit); ``names`` for an enumeration.
    """

    name: str
    unit: str
    group: Group
    kind: Kind
    words: tuple[int, ...] = ()
    shift: int = 0
    mask: int = -1
    """BITS: ``field >> shift & mask``."""
    read: Read | None = None
    per_unit: int = 1
    """Steps to one ``unit``."""
    divisor: Divisor = Divisor.ONE
    low: int | None = None
    high: int | None = None
    names: Mapping[int, str] = field(default_factory=dict)
    not_on: frozenset[int] = frozenset()
    """Devices that do not supply the value."""
    optional: bool = False
    """It may be not available although its group is."""
    rolls: bool = False
    """A counter that starts again at 0 after the greatest value the signal can hold."""
    last: bool = False
    """The last known info is taken, fresh or not."""
    pace: Group | None = None
    """What the value changes with, where that is not its group."""

    @property
    def bit(self) -> int | None:
        """Number of the bit of a flag in its word; None for any other value."""
        return self.shift if self.kind is Kind.BITS and self.mask == 1 else None


def steps(value: Value, esc: EscTelemetry, gateway: GatewayStatus, now: int) -> int | None:
    """The value now, in steps before the divisor; None: not available."""
    if value.read is not None:
        return value.read(esc, gateway, now)
    if value.group is Group.LIVE:
        return steps_of(value, esc, esc.live)
    return steps_of(value, esc, esc.last_info if value.last else esc.info)


def steps_of(value: Value, esc: EscTelemetry, reading: Sequence[int] | None) -> int | None:
    """The value in a live or info reading of the ESC, in steps before the divisor; None: not available."""
    if reading is None:
        return None
    found = reading[value.words[0]]
    if value.kind is Kind.PRODUCT:
        return found * reading[value.words[1]]
    found = found >> value.shift & value.mask
    return found if not value.not_on or esc.supplies(value.not_on, found) else None


def divisor(value: Value, esc: EscTelemetry) -> tuple[int, int] | None:
    """Numerator and denominator of what the value's steps are divided by; None where it is not known."""
    if value.divisor is Divisor.ONE:
        return 1, 1
    if value.divisor is Divisor.POLE_PAIRS:
        return esc.pole_pairs, 1
    if value.divisor is Divisor.OUTPUT:
        return esc.output_divisor, esc.gear_denominator
    cells = esc.last_cells
    return (cells, 1) if cells else None


def divisor_of_settings(value: Value, settings: EscSettings) -> Fraction:
    """The divisor as far as it is configured: 1 for the number of cells."""
    if value.divisor is Divisor.POLE_PAIRS:
        return Fraction(settings.pole_pairs)
    if value.divisor is Divisor.OUTPUT:
        return settings.pole_pairs * settings.gear
    return Fraction(1)


def scaled(value: Value, esc: EscTelemetry, found: int | None, slope: Fraction) -> int | None:
    """Steps x ``slope`` / divisor as a whole number, rounded once, halves up; None: not available."""
    parts = divisor(value, esc)
    if found is None or parts is None:
        return None
    numerator = found * slope.numerator * parts[1]
    denominator = slope.denominator * parts[0]
    return (2 * numerator + denominator) // (2 * denominator)


def physical(value: Value, esc: EscTelemetry, found: int | None) -> float | None:
    """Steps in ``unit``: whole where one step is a unit, else a float of six decimals; None: not available."""
    parts = divisor(value, esc)
    if found is None or parts is None:
        return None
    if value.per_unit == 1 and value.divisor is Divisor.ONE:
        return found
    return round(found * parts[1] / (value.per_unit * parts[0]), 6)


def _wire(data: DataType, group: Group) -> list[Value]:
    found = []
    for index, (name, row) in enumerate(rows(data).items()):
        low, high = row.type_range
        found.append(
            Value(
                *(name, row.unit, group, Kind.WIRE, (index,)),
                per_unit=row.per_unit,
                low=low,
                high=high,
                not_on=row.not_on,
                optional=bool(row.not_on),
            )
        )
    return found


def _flags(bits: type[ErrorBit], group: Group, word: int) -> list[Value]:
    return [
        Value(bit.text, "", group, Kind.BITS, (word,), int(bit), 1, low=0, high=1) for bit in bits
    ]


def _bits(name: str, word: int, shift: int, mask: int, **more: Any) -> Value:
    return Value(*(name, "", Group.INFO, Kind.BITS, (word,), shift, mask), low=0, high=mask, **more)


def _of_link(name: str, unit: str, kind: Kind, read: Read, per_unit: int = 1) -> Value:
    pace = Group.LIVE if kind in (Kind.INTEGRAL, Kind.RUN_TIME) else None
    return Value(
        *(name, unit, Group.LINK, kind),
        read=read,
        per_unit=per_unit,
        low=0,
        optional=kind in (Kind.AGE, Kind.RATE),
        rolls=kind is Kind.COUNT,
        pace=pace,
    )


def _of_gateway(name: str, read: Callable[[GatewayStatus], int], **more: Any) -> Value:
    return Value(
        *(name, "", Group.GATEWAY, Kind.GATEWAY),
        read=lambda _esc, gateway, _now: read(gateway),
        low=0,
        **more,
    )


def _pascal(text: str) -> str:
    return "".join(part[:1].upper() + part[1:].lower() for part in text.split("_"))


def _listed() -> Iterator[Value]:
    live = {name: index for index, name in enumerate(LiveData._fields)}
    info = {name: index for index, name in enumerate(InfoData._fields)}
    device, firmware = info["device_and_variant"], info["firmware_word"]
    state = (live["operating_state"],)
    yield from (value for value in _wire(LiveData, Group.LIVE) if value.name != "operating_state")
    of_state: dict[str, Any] = {"words": state, "low": 0, "high": 255}
    yield Value(
        *("operating_state", "", Group.LIVE, Kind.WIRE),
        **of_state,
        names={state: state.text for state in OperatingState},
    )
    yield Value("operating_state_raw", "", Group.LIVE, Kind.WIRE, **of_state)
    yield from _flags(OperatingError, Group.LIVE, live["operating_errors"])
    yield from (
        value
        for value in _wire(InfoData, Group.INFO)
        if value.name not in ("device_and_variant", "firmware_word")
    )
    yield _bits("device", device, 10, 0x3F, names={device: device.text for device in Device})
    yield _bits("device_raw", device, 10, 0x3F)
    yield _bits("variant", device, 0, 0x3FF)
    yield _bits("firmware_main", firmware, 8, 0xFF)
    yield _bits("firmware_sub", firmware, 0, 0xFF)
    yield from _flags(SelfTestError, Group.INFO, info["selftest_errors"])
    yield from _derived(live)
    yield from _link()
    yield from _gateway()


def _derived(live: Mapping[str, int]) -> Iterator[Value]:
    speed, voltage = (live["electrical_speed"],), live["battery_voltage"]
    wire = (Group.LIVE, Kind.WIRE)
    of_speed: dict[str, Any] = {"words": speed, "low": 0, "high": (1 << 32) - 1}
    yield Value("motor_speed", "1/min", *wire, **of_speed, divisor=Divisor.POLE_PAIRS)
    yield Value("output_speed", "1/min", *wire, **of_speed, divisor=Divisor.OUTPUT)
    yield Value(
        *("battery_power", "W", Group.LIVE, Kind.PRODUCT, (voltage, live["battery_current"])),
        per_unit=1000,
        low=-0xFFFF * 0x8000,
        high=0xFFFF * 0x7FFF,
    )
    yield Value(
        *("mean_cell_voltage", "V", *wire, (voltage,)),
        per_unit=100,
        divisor=Divisor.CELLS,
        optional=True,
    )
    yield _of_link(
        "energy_used", "Wh", Kind.INTEGRAL, lambda esc, _gateway, _now: esc.energy, MWS_PER_WH
    )
    yield _of_link(
        "motor_run_time", "s", Kind.RUN_TIME, lambda esc, _gateway, _now: esc.run_time, SECOND
    )


def _link() -> Iterator[Value]:
    yield Value(
        *("link_state", "", Group.LINK, Kind.STATE),
        read=lambda esc, _gateway, _now: esc.link,
        low=0,
        high=5,
        names={state: _pascal(state.name) for state in LinkState},
    )
    yield Value(
        *("layout", "", Group.LINK, Kind.STATE),
        read=lambda esc, _gateway, _now: esc.layout,
        low=0,
        high=2,
        names={0: "Unknown", 1: "V4", 2: "Legacy"},
    )
    yield _of_link("data_age", "ms", Kind.AGE, lambda esc, _gateway, now: esc.age_ms(now))
    yield _of_link("frame_rate", "Hz", Kind.RATE, lambda esc, _gateway, _now: esc.frame_rate, 10)
    counts: tuple[tuple[str, Read], ...] = (
        ("losses", lambda esc, _gateway, _now: esc.losses),
        ("crc_errors", lambda esc, _gateway, _now: esc.counters.crc_errors),
        ("dropped_bytes", lambda esc, _gateway, _now: esc.counters.dropped_bytes),
        ("live_frames", lambda esc, _gateway, _now: esc.counters.live),
        ("info_frames", lambda esc, _gateway, _now: esc.counters.info),
        ("received_bytes", lambda esc, _gateway, _now: esc.counters.bytes),
        ("suspect_frames", lambda esc, _gateway, _now: esc.suspect_frames),
    )
    for name, read in counts:
        yield _of_link(name, "", Kind.COUNT, read)


def _gateway() -> Iterator[Value]:
    yield _of_gateway(
        "gateway_state",
        lambda gateway: gateway.state,
        names={state: _pascal(state.name) for state in GatewayState},
    )
    yield _of_gateway(
        "can_state",
        lambda gateway: gateway.can_state,
        names={state: _pascal(state.name) for state in CanState},
    )
    yield _of_gateway("esc_count", lambda gateway: gateway.esc_count)
    yield _of_gateway("escs_ok", lambda gateway: gateway.escs_ok)
    yield Value(
        *("uptime", "s", Group.GATEWAY, Kind.GATEWAY),
        read=lambda _esc, gateway, now: (now - gateway.started_ns) // MS,
        per_unit=1000,
        low=0,
    )
    for name in (
        *("sent_frames", "replaced_frames", "send_failures"),
        *("received_frames", "bus_off_count", "dropped_frames", "id_conflicts"),
    ):
        yield _of_gateway(name, operator.attrgetter(name), rolls=True)


VALUES: Mapping[str, Value] = {value.name: value for value in _listed()}
"""Every value of one ESC and of the gateway by name."""
