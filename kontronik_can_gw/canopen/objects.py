"""The objects that show values of an ESC or of the gateway, with their steps.

``objects.tsv`` lists the values of the ESC and the gateway. The values of the link are defined
here. All other objects store their values or are bound to a service. The EDS holds the types,
names, limits and PDO defaults of objects, and ``VALUES`` the units and ranges of values.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from pathlib import Path

from kontronik_can_gw.esc.decoder import EscProtocol
from kontronik_can_gw.esc.protocols import PROTOCOLS
from kontronik_can_gw.esc.telemetry import EscTelemetry
from kontronik_can_gw.esc.values import (
    VALUES,
    Group,
    Kind,
    Value,
    scaled,
    values_of,
)
from kontronik_can_gw.status import GatewayState, GatewayStatus
from kontronik_can_gw.times import MS

U8 = 0xFF
U16 = 0xFFFF
LIVE = 0x2000
DERIVED = 0x2001
UNITS = 0x2002
INFO = 0x2010
EXTREMES = 0x2011
LINK = 0x2020
GATEWAY = 0x2021
SETTINGS = 0x2100
NODE_ID = 0x2101
RESET_STATISTICS = 0x2102
ERROR_CODE = 0x603F

_TABLE = Path(__file__).with_name("objects.tsv")
_ROLL = frozenset({(DERIVED, 4), (DERIVED, 6)})
"""Objects that restart at 0 after the highest number of their type."""
_STATUS = frozenset({"operating_errors", "operating_state_raw", "link_status"})
"""Values of status objects. A PDO that carries one is sent when it changes."""


@dataclass(frozen=True)
class Bound:
    """A value as an object shows it: in ``steps`` steps per unit of the value."""

    source: Value
    steps: Fraction

    @property
    def status(self) -> bool:
        """True if a change causes a PDO: errors, operating state and link status."""
        return self.source.name in _STATUS

    @property
    def slope(self) -> Fraction:
        """Steps of the object per step of the value."""
        return self.steps / self.source.per_unit

    def shown(self, esc: EscTelemetry, count: int | None, high: int) -> int | None:
        """Return the number that the object shows of these steps of the value. None if unknown.

        A counter restarts at 0 after ``high``.
        """
        number = scaled(self.source, esc, count, self.slope)
        if number is not None and self.source.rolls:
            return number % (high + 1)
        return number


def _counter(
    name: str,
    read: Callable[[EscTelemetry], int],
    pace: Group | None = None,
) -> Value:
    """Return a counter of the link, which restarts at 0."""
    return Value(
        name,
        "",
        Group.LINK,
        Kind.OBJECT,
        read=lambda esc, _gateway, _now: read(esc),
        low=0,
        rolls=True,
        pace=pace,
    )


def _age(name: str, stamp: Callable[[EscTelemetry], int | None]) -> Value:
    """Return an age in ms. FFFEh means this age or more, and FFFFh that nothing arrived yet.

    ``stamp`` returns the time of arrival, or None.
    """

    def read(esc: EscTelemetry, _gateway: GatewayStatus, now: int) -> int:
        at = stamp(esc)
        if at is None:
            return U16
        age_ms = max(0, now - at) // MS
        return min(age_ms, U16 - 1)

    return Value(
        name,
        "ms",
        Group.LINK,
        Kind.OBJECT,
        read=read,
        low=0,
        high=U16,
    )


def link_status(
    esc: EscTelemetry,
    gateway: GatewayStatus,
    _now: int,
) -> int:
    """Return 2020h:1: bits 0..5 link state, bit 6 replay, bit 7 fresh information."""
    is_replay = gateway.state is GatewayState.REPLAY
    has_info = esc.info is not None
    return esc.link | is_replay << 6 | has_info << 7


def _kept(value: Value) -> Value:
    """Return a value of the information frame that stays while telemetry is lost.

    Bit 7 of the link status shows that it is not fresh.
    """
    return replace(
        value,
        group=Group.LINK,
        last=True,
        optional=True,
        pace=Group.INFO,
    )


def _firmware(
    esc: EscTelemetry,
    _gateway: GatewayStatus,
    _now: int,
) -> int | None:
    """Return the main version times 256, plus the sub version. None if unknown."""
    main = esc.protocol.value("firmware_main", esc.last_info)
    sub = esc.protocol.value("firmware_sub", esc.last_info)
    if main is None or sub is None:
        return None
    return main << 8 | sub


_FIRMWARE = Value(
    "firmware",
    "",
    Group.INFO,
    Kind.OBJECT,
    read=_firmware,
    low=0,
    high=U16,
)
_LINK_STATUS = Value(
    "link_status",
    "",
    Group.LINK,
    Kind.OBJECT,
    read=link_status,
    low=0,
    high=U8,
)
_LINK_VALUES = {
    1: _LINK_STATUS,
    2: _counter("live_counter", lambda esc: esc.counters.live, Group.LIVE),
    3: _age("data_age", lambda esc: esc.live_ns),
    4: _age("info_age", lambda esc: esc.last_info_ns),
    5: _counter("live_frames", lambda esc: esc.counters.live - esc.base.live),
    6: _counter("info_frames", lambda esc: esc.counters.info - esc.base.info),
    7: _counter("crc_errors", lambda esc: esc.counters.crc_errors - esc.base.crc_errors),
    8: _counter("line_errors", lambda esc: esc.line_errors - esc.base_line_errors),
    9: _counter("dropped_bytes", lambda esc: esc.counters.dropped_bytes - esc.base.dropped_bytes),
    10: _counter("losses", lambda esc: esc.losses - esc.base_losses),
    11: VALUES["frame_rate"],
}


@cache
def bindings_of(protocol: EscProtocol) -> Mapping[tuple[int, int], Bound]:
    """Return the values that objects show of an ESC of this protocol, by index and sub-index."""
    values = {**values_of(protocol), _FIRMWARE.name: _FIRMWARE}
    bindings: dict[tuple[int, int], Bound] = {}
    for line in _TABLE.read_text(encoding="ascii").splitlines()[1:]:
        index_text, sub_text, name, steps_per_unit = line.split("\t")
        index = int(index_text, 16)
        sub = int(sub_text)
        value = values[name]
        if index in (INFO, EXTREMES):
            value = _kept(value)
        elif (index, sub) in _ROLL:
            value = replace(value, rolls=True)
        bindings[index, sub] = Bound(value, Fraction(steps_per_unit))
    for sub, value in _LINK_VALUES.items():
        bindings[LINK, sub] = Bound(value, Fraction(value.per_unit))
    return bindings


BINDINGS = bindings_of(PROTOCOLS[0])
"""Bindings of the default protocol. Their objects are the same for all protocols."""
