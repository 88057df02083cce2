"""Every value that can be published: name, unit, availability, and how it is computed.

DBC signals and CANopen objects bind to these by name. A value is a whole number of steps divided by
a divisor of the ESC (pole pairs, gear, cells), which may change at run time:
physical value = steps / ``per_unit`` / divisor. ``steps`` and ``physical`` read any value.
"""

import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from fractions import Fraction
from functools import cache
from typing import Any

from kontronik_can_gw.esc.decoder import EscProtocol
from kontronik_can_gw.esc.protocols import PROTOCOLS, protocol_named
from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry, LinkState
from kontronik_can_gw.status import COUNTERS, CanState, GatewayState, GatewayStatus
from kontronik_can_gw.times import MS, SECOND

MWS_PER_WH = 3_600_000


class Group(Enum):
    """When a value is available."""

    LIVE = "live"
    """With fresh live data."""
    INFO = "info"
    """With fresh info data of the present device."""
    LINK = "link"
    """Always, for each ESC."""
    GATEWAY = "gateway"
    """Always, once for the gateway."""


class Kind(Enum):
    """How a value is computed."""

    WIRE = "a field of the reading"
    BITS = "some bits of a field"
    PRODUCT = "the product of two fields"
    INTEGRAL = "a sum over time"
    RUN_TIME = "time in a state"
    COUNT = "a counter"
    AGE = "time since an event"
    RATE = "events per second"
    STATE = "a state of the link"
    GATEWAY = "a value of the gateway itself"
    OBJECT = "shown only by an object of a CANopen node"


class Divisor(Enum):
    """The divisor of a value's steps."""

    ONE = "1"
    POLE_PAIRS = "pole pairs"
    SHAFT = "pole pairs and gear"
    CELLS = "cells"


Read = Callable[[EscTelemetry, GatewayStatus, int], int | None]
"""Maps ESC, gateway and time to steps, or None if not available.

The function of a gateway value must not use the ESC.
"""


@dataclass(frozen=True, eq=False)
class Value:
    """A value that can be published.

    The kinds WIRE, BITS and PRODUCT are computed from the words of a live or info reading. The
    other kinds have a function ``read``.
    """

    name: str
    unit: str
    group: Group
    kind: Kind
    words: tuple[int, ...] = ()
    """Indices in the reading: one for WIRE and BITS, two for PRODUCT."""
    shift: int = 0
    mask: int = -1
    """For BITS, the steps are ``word >> shift & mask``."""
    read: Read | None = None
    per_unit: int = 1
    """Number of steps that make one ``unit``."""
    divisor: Divisor = Divisor.ONE
    low: int | None = None
    """Smallest possible steps. None: unknown."""
    high: int | None = None
    """Greatest possible steps. None: unknown."""
    names: Mapping[int, str] = field(default_factory=dict)
    """Names of an enumeration's numbers."""
    not_on: frozenset[int] = frozenset()
    """Devices that do not supply the value."""
    optional: bool = False
    """True if it may be not available although its group is available."""
    rolls: bool = False
    """True for a counter that restarts at 0 after the greatest value that the signal can hold."""
    last: bool = False
    """True if the last known info data is used even if it is not fresh."""
    pace: Group | None = None
    """The group whose data changes the value. None: its own group."""
    negative_in: tuple[int, frozenset[int]] | None = None
    """WIRE: index of a word of live data, and its values for which the steps are negative."""
    supplied: bool = True
    """False if the ESC's protocol does not have the value. It is then never available."""

    @property
    def bit(self) -> int | None:
        """Position of a flag in its word. None for any other value."""
        if self.kind is Kind.BITS and self.mask == 1:
            return self.shift
        return None


def steps(
    value: Value,
    esc: EscTelemetry,
    gateway: GatewayStatus,
    now: int,
) -> int | None:
    """Return the value at ``now`` in steps, not divided yet. None if not available."""
    if value.read is not None:
        return value.read(esc, gateway, now)
    if value.group is Group.LIVE:
        return steps_of(value, esc, esc.live)
    return steps_of(value, esc, esc.last_info if value.last else esc.info)


def steps_of(
    value: Value,
    esc: EscTelemetry,
    reading: Sequence[int] | None,
) -> int | None:
    """Return the value in a live or info reading in steps, not divided yet.

    None without a reading, if the ESC's device does not supply the value, or if the value is not
    computed from readings.
    """
    if reading is None or not value.words:
        return None
    word = reading[value.words[0]]
    if value.kind is Kind.PRODUCT:
        return word * reading[value.words[1]]
    count = word >> value.shift & value.mask
    if value.negative_in is not None:
        state_word, negative_states = value.negative_in
        if reading[state_word] in negative_states:
            count = -count
    if value.not_on and not esc.supplies(value.not_on, count):
        return None
    return count


def divisor(value: Value, esc: EscTelemetry) -> tuple[int, int] | None:
    """Return numerator and denominator of the value's divisor. None if it is unknown."""
    if value.divisor is Divisor.ONE:
        return 1, 1
    if value.divisor is Divisor.POLE_PAIRS:
        return esc.pole_pairs, 1
    if value.divisor is Divisor.SHAFT:
        return esc.shaft_divisor, esc.gear_denominator
    cells = esc.last_cells
    return (cells, 1) if cells else None


def scaled(
    value: Value,
    esc: EscTelemetry,
    count: int | None,
    slope: Fraction,
) -> int | None:
    """Return ``count`` steps x ``slope`` / divisor, rounded once to a whole number, half up.

    None if the steps or the divisor are not available.
    """
    parts = divisor(value, esc)
    if count is None or parts is None:
        return None
    return rounded(count, slope, parts)


def rounded(
    count: int,
    slope: Fraction,
    parts: tuple[int, int],
    intercept: Fraction = Fraction(0),
) -> int:
    """Return ``count`` x ``slope`` / ``parts`` + ``intercept``, rounded once, half up."""
    over, under = parts
    times, by = slope.as_integer_ratio()
    plus, of = intercept.as_integer_ratio()
    denominator = by * over * of
    numerator = count * times * under * of + plus * by * over
    return (2 * numerator + denominator) // (2 * denominator)


def physical(
    value: Value,
    esc: EscTelemetry,
    count: int | None,
) -> float | None:
    """Return ``count`` steps in the value's ``unit``.

    The result is an integer if one step is one unit, else a float rounded to six decimals. None if
    the steps or the divisor are not available.
    """
    parts = divisor(value, esc)
    if count is None or parts is None:
        return None
    if value.per_unit == 1 and value.divisor is Divisor.ONE:
        return count
    over, under = parts
    return round(count * under / (value.per_unit * over), 6)


def _field_values(protocol: EscProtocol, group: Group) -> Iterator[Value]:
    """Yield the fields of live or info data, then the flags of their error words."""
    is_info = group is Group.INFO
    fields = [each for each in protocol.fields if each.is_info is is_info]
    for each in fields:
        yield Value(
            name=each.name,
            unit=each.unit,
            group=group,
            kind=Kind.WIRE if each.mask == -1 else Kind.BITS,
            words=(each.word,),
            shift=each.shift,
            mask=each.mask,
            per_unit=each.per_unit,
            low=each.low,
            high=each.high,
            names=each.names,
            not_on=each.not_on,
            optional=bool(each.not_on),
        )
    for each in fields:
        for bit in protocol.errors.get(each.name, ()):
            yield Value(
                name=bit.text,
                unit="",
                group=group,
                kind=Kind.BITS,
                words=(each.word,),
                shift=int(bit),
                mask=1,
                low=0,
                high=1,
            )


def _derived_values(live: Mapping[str, Value]) -> Iterator[Value]:
    """Yield the values computed from live data, if the protocol supplies the fields they need."""
    speed = live.get("electrical_speed")
    voltage = live.get("battery_voltage")
    current = live.get("battery_current")
    if speed is not None:
        yield replace(
            speed,
            name="motor_speed",
            unit="1/min",
            divisor=Divisor.POLE_PAIRS,
        )
        yield replace(
            speed,
            name="output_speed",
            unit="1/min",
            divisor=Divisor.SHAFT,
        )
    if voltage is not None and current is not None:
        voltages: Any = (voltage.low, voltage.high)  # a field of the wire has limits
        currents: Any = (current.low, current.high)
        products = [u * i for u in voltages for i in currents]
        yield Value(
            name="battery_power",
            unit="W",
            group=Group.LIVE,
            kind=Kind.PRODUCT,
            words=voltage.words + current.words,
            per_unit=voltage.per_unit * current.per_unit,
            low=min(products),
            high=max(products),
        )
    if voltage is not None:
        yield replace(
            voltage,
            name="mean_cell_voltage",
            divisor=Divisor.CELLS,
            low=None,
            high=None,
            optional=True,
        )


def _reader_of(attribute: str) -> Read:
    """Return a function that reads an attribute of the ESC."""
    get = operator.attrgetter(attribute)
    return lambda esc, _gateway, _now: get(esc)


def _energy_mw_s(esc: EscTelemetry, _gateway: GatewayStatus, _now: int) -> int:
    return esc.energy_mw_ns // SECOND


def _data_age_ms(
    esc: EscTelemetry,
    _gateway: GatewayStatus,
    now: int,
) -> int | None:
    return esc.age_ms(now)


_LINK: tuple[tuple[str, str, Kind, Read, int], ...] = (
    ("energy_used", "Wh", Kind.INTEGRAL, _energy_mw_s, MWS_PER_WH),
    ("motor_run_time", "s", Kind.RUN_TIME, _reader_of("run_time_ns"), SECOND),
    ("link_state", "", Kind.STATE, _reader_of("link"), 1),
    ("layout", "", Kind.STATE, _reader_of("layout"), 1),
    ("data_age", "ms", Kind.AGE, _data_age_ms, 1),
    ("frame_rate", "Hz", Kind.RATE, _reader_of("frame_rate"), 10),
    ("losses", "", Kind.COUNT, _reader_of("losses"), 1),
    ("crc_errors", "", Kind.COUNT, _reader_of("counters.crc_errors"), 1),
    ("dropped_bytes", "", Kind.COUNT, _reader_of("counters.dropped_bytes"), 1),
    ("live_frames", "", Kind.COUNT, _reader_of("counters.live"), 1),
    ("info_frames", "", Kind.COUNT, _reader_of("counters.info"), 1),
    ("received_bytes", "", Kind.COUNT, _reader_of("counters.bytes"), 1),
    ("suspect_frames", "", Kind.COUNT, _reader_of("suspect_frames"), 1),
)  # fmt: skip
"""Name, unit, kind, function that reads the steps, steps that make one unit."""
_NEEDED_FIELDS = {
    "energy_used": {"battery_voltage", "battery_current"},
    "motor_run_time": {"electrical_speed"},
}
"""Fields that a protocol must have so that its ESCs supply a value of the link."""


def _pascal(text: str) -> str:
    parts = text.split("_")
    return "".join([part.capitalize() for part in parts])


def _link_values(protocol: EscProtocol) -> Iterator[Value]:
    layouts = ("unknown", *protocol.layouts)
    names_of = {
        "link_state": {int(state): _pascal(state.name) for state in LinkState},
        "layout": {number: _pascal(text) for number, text in enumerate(layouts)},
    }
    for name, unit, kind, read, per_unit in _LINK:
        if not _NEEDED_FIELDS.get(name, set()) <= protocol.by_name.keys():
            continue
        names = names_of.get(name, {})
        yield Value(
            name=name,
            unit=unit,
            group=Group.LINK,
            kind=kind,
            read=read,
            per_unit=per_unit,
            low=0,
            high=max(names) if names else None,
            names=names,
            optional=kind in (Kind.AGE, Kind.RATE),
            rolls=kind is Kind.COUNT,
            pace=Group.LIVE if kind in (Kind.INTEGRAL, Kind.RUN_TIME) else None,
        )


def _gateway_value(
    name: str,
    unit: str = "",
    read: Read | None = None,
    **more: Any,
) -> Value:
    """Make a value of the gateway. By default it reads the attribute of GatewayStatus ``name``."""
    if read is None:
        get = operator.attrgetter(name.removeprefix("gateway_"))
        read = lambda _esc, gateway, _now: get(gateway)  # noqa: E731
    return Value(
        name,
        unit,
        Group.GATEWAY,
        Kind.GATEWAY,
        read=read,
        low=0,
        **more,
    )


def _make_gateway_values() -> Iterator[Value]:
    for name, states in (("gateway_state", GatewayState), ("can_state", CanState)):
        names = {int(state): _pascal(state.name) for state in states}
        yield _gateway_value(name, names=names)
    yield _gateway_value("esc_count")
    yield _gateway_value("escs_ok")
    uptime: Read = lambda _esc, gateway, now: (now - gateway.started_ns) // MS  # noqa: E731
    yield _gateway_value(
        "uptime",
        unit="s",
        per_unit=1000,
        read=uptime,
    )
    for name in COUNTERS:
        yield _gateway_value(name, rolls=True)


_GATEWAY_VALUES = tuple(_make_gateway_values())
"""The same for all protocols."""


def _own_values(protocol: EscProtocol) -> Iterator[Value]:
    """Yield the values that an ESC of this protocol supplies, and the gateway's."""
    live = {value.name: value for value in _field_values(protocol, Group.LIVE)}
    yield from live.values()
    yield from _field_values(protocol, Group.INFO)
    yield from _derived_values(live)
    yield from _link_values(protocol)
    yield from _GATEWAY_VALUES


def _all_values(protocols: Sequence[EscProtocol]) -> Mapping[str, Value]:
    """Return the values of all protocols by name.

    A value of several protocols is the first protocol's. The first protocol's values are listed
    first, then the values that only the others have.
    """
    values: dict[str, Value] = {}
    for protocol in protocols:
        for value in _own_values(protocol):
            values.setdefault(value.name, value)
    return values


VALUES = _all_values(PROTOCOLS)
"""Every value of an ESC and of the gateway by name."""


@cache
def values_of(protocol: EscProtocol) -> Mapping[str, Value]:
    """Return every value of VALUES by name, as an ESC of this protocol supplies it.

    Values that the protocol does not have are included; they are never available. Raises ValueError
    if the protocol gives a value a unit that differs from VALUES.
    """
    own = {value.name: value for value in _own_values(protocol)}
    for name, value in own.items():
        if name in VALUES and value.unit != VALUES[name].unit:
            raise ValueError(f"ESC protocol {protocol.name}: {name} is in {VALUES[name].unit}")
    found = {}
    for name, value in VALUES.items():
        found[name] = own.get(name) or _missing(value)
    return found | own


def with_direction(protocol: EscProtocol, speed: Value) -> Value:
    """Return the speed. It is negative in the states in which the motor turns backward."""
    state = protocol.by_name.get("operating_state_raw")
    if state is None or not protocol.backward_states or speed.kind is not Kind.WIRE:
        return speed
    low = None if speed.high is None else -speed.high
    return replace(speed, negative_in=(state.word, protocol.backward_states), low=low)


def values_of_esc(settings: EscSettings) -> Mapping[str, Value]:
    """Return every value by name, as this ESC supplies it."""
    return values_of(protocol_named(settings.protocol))


def _missing(value: Value) -> Value:
    """Return the value as it is for an ESC whose protocol does not have it."""
    return replace(
        value,
        words=(),
        read=lambda _esc, _gateway, _now: None,
        low=None,
        high=None,
        optional=True,
        supplied=False,
    )
