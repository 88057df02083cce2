"""Every value that can be published: name, unit, when it is available, how it comes about.

DBC signals and CANopen objects bind to these by name. A value is a whole number of steps divided by a divisor of the ESC (pole
pairs, gear, cells), which may change at run time: physical = steps / ``per_unit`` / divisor. ``steps`` and ``physical`` read any
of them.
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
from kontronik_can_gw.esc.telemetry import MS, SECOND, EscSettings, EscTelemetry, LinkState
from kontronik_can_gw.gateway_status import CanState, GatewayState, GatewayStatus

MWS_PER_WH = 3_600_000


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
    OBJECT = "as only an object of a CANopen node shows it"


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
    negative_in: tuple[int, frozenset[int]] | None = None
    """WIRE: a word of the live reading, and its values for which the steps are negative."""
    supplied: bool = True
    """False where the ESC's protocol does not have it: it is never available."""

    @property
    def bit(self) -> int | None:
        """Number of the bit of a flag in its word; None for any other value."""
        return self.shift if self.kind is Kind.BITS and self.mask == 1 else None


_ONE, _POLE_PAIRS, _OUTPUT = Divisor.ONE, Divisor.POLE_PAIRS, Divisor.OUTPUT
_PRODUCT = Kind.PRODUCT  # an enumeration's members are slow to look up


def steps(value: Value, esc: EscTelemetry, gateway: GatewayStatus, now: int) -> int | None:
    """The value now, in steps before the divisor; None: not available."""
    if value.read is not None:
        return value.read(esc, gateway, now)
    if value.group is Group.LIVE:
        return steps_of(value, esc, esc.live)
    return steps_of(value, esc, esc.last_info if value.last else esc.info)


def steps_of(value: Value, esc: EscTelemetry, reading: Sequence[int] | None) -> int | None:
    """The value in a live or info reading of the ESC, in steps before the divisor; None: not available."""
    if reading is None or not value.words:
        return None
    found = reading[value.words[0]]
    if value.kind is _PRODUCT:
        return found * reading[value.words[1]]
    found = found >> value.shift & value.mask
    if value.negative_in is not None:
        word, negative = value.negative_in
        if reading[word] in negative:
            found = -found
    return found if not value.not_on or esc.supplies(value.not_on, found) else None


def divisor(value: Value, esc: EscTelemetry) -> tuple[int, int] | None:
    """Numerator and denominator of what the value's steps are divided by; None where it is not known."""
    if value.divisor is _ONE:
        return 1, 1
    if value.divisor is _POLE_PAIRS:
        return esc.pole_pairs, 1
    if value.divisor is _OUTPUT:
        return esc.output_divisor, esc.gear_denominator
    cells = esc.last_cells
    return (cells, 1) if cells else None


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
    if value.per_unit == 1 and value.divisor is _ONE:
        return found
    return round(found * parts[1] / (value.per_unit * parts[0]), 6)


def _supplied(protocol: EscProtocol, group: Group) -> Iterator[Value]:
    """The values of live data or of information, then the flags of their error words."""
    fields = [f for f in protocol.fields if f.is_info is (group is Group.INFO)]
    for found in fields:
        yield Value(
            *(found.name, found.unit, group, Kind.WIRE if found.mask == -1 else Kind.BITS),
            *((found.word,), found.shift, found.mask),
            per_unit=found.per_unit,
            low=found.low,
            high=found.high,
            names=found.names,
            not_on=found.not_on,
            optional=bool(found.not_on),
        )
    for found in fields:
        for bit in protocol.errors.get(found.name, ()):
            name = (bit.text, "", group, Kind.BITS)
            yield Value(*name, (found.word,), int(bit), 1, low=0, high=1)


def _derived(live: Mapping[str, Value]) -> Iterator[Value]:
    """Values that are made of those of live data; what a protocol does not supply leaves them out."""
    speed, voltage = live.get("electrical_speed"), live.get("battery_voltage")
    current = live.get("battery_current")
    if speed is not None:
        yield replace(speed, name="motor_speed", unit="1/min", divisor=Divisor.POLE_PAIRS)
        yield replace(speed, name="output_speed", unit="1/min", divisor=Divisor.OUTPUT)
    if voltage is not None and current is not None:
        ends = [(value.low or 0, value.high or 0) for value in (voltage, current)]
        products = [u * i for u in ends[0] for i in ends[1]]
        yield Value(
            *("battery_power", "W", Group.LIVE, Kind.PRODUCT, voltage.words + current.words),
            per_unit=voltage.per_unit * current.per_unit,
            low=min(products),
            high=max(products),
        )
    if voltage is not None:
        open_ended: dict[str, Any] = {"low": None, "high": None, "optional": True}
        yield replace(voltage, name="mean_cell_voltage", divisor=Divisor.CELLS, **open_ended)


def _of_esc(attribute: str) -> Read:
    found = operator.attrgetter(attribute)
    return lambda esc, _gateway, _now: found(esc)


_LINK: tuple[tuple[str, str, Kind, Read, int], ...] = (
    ("energy_used", "Wh", Kind.INTEGRAL, lambda esc, _gw, _now: esc.energy_mw_ns // SECOND, MWS_PER_WH),
    ("motor_run_time", "s", Kind.RUN_TIME, _of_esc("run_time_ns"), SECOND),
    ("link_state", "", Kind.STATE, _of_esc("link"), 1),
    ("layout", "", Kind.STATE, _of_esc("layout"), 1),
    ("data_age", "ms", Kind.AGE, lambda esc, _gw, now: esc.age_ms(now), 1),
    ("frame_rate", "Hz", Kind.RATE, _of_esc("frame_rate"), 10),
    ("losses", "", Kind.COUNT, _of_esc("losses"), 1),
    ("crc_errors", "", Kind.COUNT, _of_esc("counters.crc_errors"), 1),
    ("dropped_bytes", "", Kind.COUNT, _of_esc("counters.dropped_bytes"), 1),
    ("live_frames", "", Kind.COUNT, _of_esc("counters.live"), 1),
    ("info_frames", "", Kind.COUNT, _of_esc("counters.info"), 1),
    ("received_bytes", "", Kind.COUNT, _of_esc("counters.bytes"), 1),
    ("suspect_frames", "", Kind.COUNT, _of_esc("suspect_frames"), 1),
)  # fmt: skip
"""Name, unit, kind, steps, steps to a unit."""
_NEEDED = {"energy_used": {"battery_voltage", "battery_current"}}
_NEEDED |= {"motor_run_time": {"electrical_speed"}}


def _pascal(text: str) -> str:
    return "".join(part[:1].upper() + part[1:].lower() for part in text.split("_"))


def _link(protocol: EscProtocol) -> Iterator[Value]:
    layouts = {n: _pascal(text) for n, text in enumerate(("unknown", *protocol.layouts))}
    named = {"link_state": {int(s): _pascal(s.name) for s in LinkState}, "layout": layouts}
    for name, unit, kind, read, per_unit in _LINK:
        if _NEEDED.get(name, set()) <= protocol.by_name.keys():
            yield Value(
                *(name, unit, Group.LINK, kind),
                read=read,
                per_unit=per_unit,
                low=0,
                high=max(named[name]) if name in named else None,
                names=named.get(name, {}),
                optional=kind in (Kind.AGE, Kind.RATE),
                rolls=kind is Kind.COUNT,
                pace=Group.LIVE if kind in (Kind.INTEGRAL, Kind.RUN_TIME) else None,
            )


def _of_gateway(name: str, **more: Any) -> Value:
    found = operator.attrgetter(name.removeprefix("gateway_"))
    of: dict[str, Any] = {"unit": "", "read": lambda _esc, gateway, _now: found(gateway)}
    return Value(name, group=Group.GATEWAY, kind=Kind.GATEWAY, low=0, **of | more)


def _gateway() -> Iterator[Value]:
    for name, states in (("gateway_state", GatewayState), ("can_state", CanState)):
        yield _of_gateway(name, names={int(state): _pascal(state.name) for state in states})
    yield _of_gateway("esc_count")
    yield _of_gateway("escs_ok")
    uptime: Read = lambda _esc, gateway, now: (now - gateway.started_ns) // MS  # noqa: E731
    yield _of_gateway("uptime", unit="s", per_unit=1000, read=uptime)
    for name in (
        *("sent_frames", "replaced_frames", "send_failures"),
        *("received_frames", "bus_off_count", "dropped_frames", "id_conflicts"),
    ):
        yield _of_gateway(name, rolls=True)


_GATEWAY_VALUES = tuple(_gateway())  # the same for all protocols


def _listed(protocol: EscProtocol) -> Iterator[Value]:
    live = {value.name: value for value in _supplied(protocol, Group.LIVE)}
    yield from live.values()
    yield from _supplied(protocol, Group.INFO)
    yield from _derived(live)
    yield from _link(protocol)
    yield from _GATEWAY_VALUES


def _all_values(protocols: Sequence[EscProtocol]) -> Mapping[str, Value]:
    """By name, as the first protocol that has it supplies it; in the order of the first, then what others have besides."""
    found: dict[str, Value] = {}
    for protocol in protocols:
        for value in _listed(protocol):
            found.setdefault(value.name, value)
    return found


VALUES = _all_values(PROTOCOLS)
"""Every value of one ESC and of the gateway by name."""


@cache
def values_of(protocol: EscProtocol) -> Mapping[str, Value]:
    """Every value of VALUES by name, as an ESC of this protocol supplies it; others are never available."""
    own = {value.name: value for value in _listed(protocol)}
    for name, value in own.items():
        if name in VALUES and value.unit != VALUES[name].unit:
            raise ValueError(f"ESC protocol {protocol.name}: {name} is in {VALUES[name].unit}")
    return {name: own.get(name) or _missing(value) for name, value in VALUES.items()} | own


def with_direction(protocol: EscProtocol, speed: Value) -> Value:
    """The speed with a negative sign while the motor turns backward, if the protocol has such states."""
    state = protocol.by_name.get("operating_state_raw")
    if state is None or not protocol.backward_states or speed.kind is not Kind.WIRE:
        return speed
    low = None if speed.high is None else -speed.high
    return replace(speed, negative_in=(state.word, protocol.backward_states), low=low)


def values_of_esc(settings: EscSettings) -> Mapping[str, Value]:
    """Every value by name, as this ESC supplies it."""
    return values_of(protocol_named(settings.protocol))


def _missing(value: Value) -> Value:
    never: dict[str, Any] = {"words": (), "read": lambda _esc, _gateway, _now: None}
    return replace(value, **never, low=None, high=None, optional=True, supplied=False)
