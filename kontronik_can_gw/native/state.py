"""What others read of the core in C: the state of an ESC and of the gateway, straight from its memory."""

import ctypes as c
import struct
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, Self

from kontronik_can_gw.esc.decoder import SECOND_NS, Counters, Data, EscProtocol
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry, LinkState
from kontronik_can_gw.native.rows import COUNTS, GATEWAY
from kontronik_can_gw.status import CanState, GatewayState

_STREAM = COUNTS.index("longer_crcs") + 1
"""Number of counters in kcg_esc.count that are those of the stream."""
_PLACES = (("has_live", "live"), ("has_info", "info"), ("had_live", "live"), ("had_info", "info"))
"""Of live data, info, and the newest ever of both: whether there is any, and its bytes."""


@cache
def _forms(protocol: EscProtocol) -> Sequence[tuple[struct.Struct, Any]]:
    """Of live data and info, for all ESCs of a protocol."""
    assert protocol.wire is not None
    return [(struct.Struct("<" + codes), kind) for codes, kind in protocol.wire]


class NativeEsc(EscTelemetry):
    """The state of an ESC. What the core holds is read when somebody asks."""

    def __init__(self, settings: EscSettings, state: Any) -> None:
        self._state = state
        self.protocol = protocol_named(settings.protocol)
        self._forms = _forms(self.protocol)
        self._generation = -1
        self._readings: dict[int, Data | None] = {}
        self._counters_of = type(self.protocol.make().counters)
        self.line_errors = self.base_losses = self.base_line_errors = 0
        self.apply(settings)
        self.base = self.counters

    def frozen(self) -> Self:
        twin = object.__new__(type(self))
        state = type(self._state).from_buffer_copy(self._state)
        vars(twin).update(vars(self), _state=state, _readings={})
        return twin

    @property
    def up(self) -> bool:
        return bool(self._state.has_live)

    @property
    def counters(self) -> Counters:
        found: Counters = self._counters_of(*self._state.count[:_STREAM])
        return found

    def reading(self, place: int) -> Data | None:
        """Live data, info, and the newest ever of both; None where there is none."""
        state, known = self._state, self._readings
        if state.generation != self._generation:
            self._generation = state.generation
            known.clear()
        elif place in known:
            return known[place]
        there, body = _PLACES[place]
        known[place] = None
        if getattr(state, there):
            form, kind = self._forms[place & 1]
            known[place] = tuple.__new__(kind, form.unpack_from(getattr(state, body)))
        return known[place]


_READ: dict[str, Callable[[NativeEsc], Any]] = {
    "live": lambda esc: esc.reading(0),
    "info": lambda esc: esc.reading(1),
    "last_live": lambda esc: esc.reading(2),
    "last_info": lambda esc: esc.reading(3),
    "device": lambda esc: esc.protocol.value("device_raw", esc.reading(3)),
    "link": lambda esc: LinkState(esc._state.link),
    "layout": lambda esc: esc._state.layout,
    "cells": lambda esc: esc._state.cells,
    "frame_rate": lambda esc: None if esc._state.rate < 0 else esc._state.rate,
    "live_ns": lambda esc: esc._state.live_ns if esc._state.has_time else None,
    "live_bound_ns": lambda esc: esc._state.live_bound,
    "last_info_ns": lambda esc: esc._state.last_info_ns if esc._state.had_info else None,
    "info_bound_ns": lambda esc: esc._state.info_bound if esc._state.has_info else None,
}
for _name, _read in _READ.items():
    setattr(NativeEsc, _name, property(_read))


def _energy(esc: NativeEsc) -> int:
    return int(esc._state.energy) * SECOND_NS + int(esc._state.energy_rest)


def _set_energy(esc: NativeEsc, mw_ns: int) -> None:
    esc._state.energy, esc._state.energy_rest = divmod(mw_ns, SECOND_NS)


def _set_run_time(esc: NativeEsc, ns: int) -> None:
    esc._state.run_time = ns


def _count(place: int) -> property:
    def read(esc: NativeEsc) -> Any:
        return esc._state.count[place]

    def write(esc: NativeEsc, value: int) -> None:
        esc._state.count[place] = value

    return property(read, write)


_COUNTS = ("losses", "late_frames", "suspect_frames")
_WRITABLE = {name: _count(COUNTS.index(name)) for name in _COUNTS} | {
    "energy_mw_ns": property(_energy, _set_energy),
    "run_time_ns": property(lambda esc: esc._state.run_time, _set_run_time),
}
"""A capture of a later part begins with what was before."""
for _name, _property in _WRITABLE.items():
    setattr(NativeEsc, _name, _property)


_GATEWAY_STATES, _CAN_STATES = tuple(GatewayState), tuple(CanState)


class NativeStatus(c.Structure):
    """As GatewayStatus, in the core's memory: kcg.gateway."""

    _fields_ = tuple(
        (f"{name}_number" if name == "can_state" else name, c.c_int64) for name in GATEWAY
    )

    @property
    def state(self) -> GatewayState:
        return _GATEWAY_STATES[self.gateway_state]

    @state.setter
    def state(self, state: GatewayState) -> None:
        self.gateway_state = state

    @property
    def can_state(self) -> CanState:
        return _CAN_STATES[self.can_state_number]

    @can_state.setter
    def can_state(self, state: CanState) -> None:
        self.can_state_number = state

    def frozen(self) -> "NativeStatus":
        return NativeStatus.from_buffer_copy(self)
