"""Which objects show what: index and sub-index to a value, in which steps. What is not here is plain storage or a service's own object.

Values of ESC and gateway stand in ``objects.tsv``, those of the link here. The objects' types, names, limits and PDO defaults are in
the EDS; the values, units and ranges in ``VALUES``.
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
    steps,
    steps_of,
    values_of,
)
from kontronik_can_gw.status import GatewayState, GatewayStatus
from kontronik_can_gw.times import MS

U8, U16 = 0xFF, 0xFFFF
LIVE, DERIVED, INFO, EXTREMES, LINK, GATEWAY = 0x2000, 0x2001, 0x2010, 0x2011, 0x2020, 0x2021
UNITS = 0x2002
SETTINGS, NODE_ID, RESET_STATISTICS = 0x2100, 0x2101, 0x2102
ERROR_CODE = 0x603F

_TABLE = Path(__file__).with_name("objects.tsv")
_ROLL = frozenset({(DERIVED, 4), (DERIVED, 6)})
"""These start again at 0 after the greatest number of their type."""
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


def _of_link(name: str, read: Callable[[EscTelemetry], int], pace: Group | None = None) -> Value:
    """A counter as the objects show it: since it was reset."""
    return Value(
        *(name, "", Group.LINK, Kind.OBJECT),
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

    return Value(name, "ms", Group.LINK, Kind.OBJECT, read=read, low=0, high=U16)


def link_status(esc: EscTelemetry, gateway: GatewayStatus, _now: int) -> int:
    return esc.link | (gateway.state is GatewayState.REPLAY) << 6 | (esc.info is not None) << 7


def _kept(value: Value) -> Value:
    """Information of the ESC keeps its value while telemetry is lost; bit 7 of the link status shows that it is not fresh."""
    return replace(value, group=Group.LINK, last=True, optional=True, pace=Group.INFO)


def _firmware(esc: EscTelemetry, _gateway: GatewayStatus, _now: int) -> int | None:
    value, info = esc.protocol.value, esc.last_info
    main, sub = value("firmware_main", info), value("firmware_sub", info)
    return None if main is None or sub is None else main << 8 | sub


_FIRMWARE = Value("firmware", "", Group.INFO, Kind.OBJECT, read=_firmware, low=0, high=U16)
_LINK_VALUES = {
    1: Value("link_status", "", Group.LINK, Kind.OBJECT, read=link_status, low=0, high=U8),
    2: _of_link("live_counter", lambda esc: esc.counters.live, Group.LIVE),
    3: _age("data_age", lambda esc: esc.live_ns),
    4: _age("info_age", lambda esc: esc.last_info_ns),
    5: _of_link("live_frames", lambda esc: esc.counters.live - esc.base.live),
    6: _of_link("info_frames", lambda esc: esc.counters.info - esc.base.info),
    7: _of_link("crc_errors", lambda esc: esc.counters.crc_errors - esc.base.crc_errors),
    8: _of_link("line_errors", lambda esc: esc.line_errors - esc.base_line_errors),
    9: _of_link("dropped_bytes", lambda esc: esc.counters.dropped_bytes - esc.base.dropped_bytes),
    10: _of_link("losses", lambda esc: esc.losses - esc.base_losses),
    11: VALUES["frame_rate"],
}


@cache
def bindings_of(protocol: EscProtocol) -> Mapping[tuple[int, int], Bound]:
    """(Index, sub-index) to what the object shows of an ESC of this protocol."""
    values = {**values_of(protocol), _FIRMWARE.name: _FIRMWARE}
    found = {}
    for line in _TABLE.read_text(encoding="ascii").splitlines()[1:]:
        at, number, name, per_unit = line.split("\t")
        index, sub, value = int(at, 16), int(number), values[name]
        if index in (INFO, EXTREMES):
            value = _kept(value)
        elif (index, sub) in _ROLL:
            value = replace(value, rolls=True)
        found[index, sub] = Bound(value, Fraction(per_unit))
    link = {
        (LINK, sub): Bound(value, Fraction(value.per_unit)) for sub, value in _LINK_VALUES.items()
    }
    return found | link


BINDINGS = bindings_of(PROTOCOLS[0])
"""Those of an ESC whose configuration names no protocol; the objects are the same for all."""
