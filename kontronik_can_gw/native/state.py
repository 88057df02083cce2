"""The state of an ESC and of the gateway, read from the memory of the core in C."""

import ctypes as c
import struct
from collections.abc import Callable, Sequence
from dataclasses import astuple
from functools import cache
from typing import Any, Self

from kontronik_can_gw.core.interface import SchedulePosition
from kontronik_can_gw.esc.decoder import Counters, Data, EscProtocol
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry, LinkState
from kontronik_can_gw.native.rows import COUNTS, GATEWAY
from kontronik_can_gw.status import CanState, GatewayState
from kontronik_can_gw.times import SECOND

_NEVER = (1 << 63) - 1
"""KCG_NEVER."""
_STREAM = COUNTS.index("longer_crcs") + 1
"""Number of entries in kcg_esc.count that count the stream. They are at the beginning."""
_LIVE, _INFO, _LAST_LIVE, _LAST_INFO = range(4)
"""Kinds of readings: fresh live data and info data, and the newest ones, fresh or not."""
_FIELDS = {
    _LIVE: ("has_live", "live"),
    _INFO: ("has_info", "info"),
    _LAST_LIVE: ("had_live", "live"),
    _LAST_INFO: ("had_info", "info"),
}
"""Fields of kcg_esc for each kind: whether there are data, and their bytes."""


@cache
def _forms(protocol: EscProtocol) -> Sequence[tuple[struct.Struct, Any]]:
    """Return how to unpack live data and info data, and their types."""
    assert protocol.wire is not None
    forms = []
    for codes, data_type in protocol.wire:
        little_endian = struct.Struct("<" + codes)
        forms.append((little_endian, data_type))
    return forms


class NativeEsc(EscTelemetry):
    """The state of an ESC. Values in the core's memory are read on demand."""

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
        counts = self._state.count[:_STREAM]
        found: Counters = self._counters_of(*counts)
        return found

    @property
    def window(self) -> list[int]:
        state = self._state
        return [state.window_ns, *state.window, state.rate, state.interval]

    def set_window(self, window: Sequence[int]) -> None:
        state = self._state
        state.window_ns, *counts, state.rate, state.interval = window
        state.window[:] = counts  # ctypes keeps the low 32 bits, as the core does

    @property
    def held_bytes(self) -> int:
        return int(self._state.held_count)

    def set_counters(self, counters: Any) -> None:
        self._state.count[:_STREAM] = tuple(max(0, count) for count in astuple(counters))

    def reading(self, kind: int) -> Data | None:
        """Return the data of a kind of readings, or None if there are none."""
        state = self._state
        known = self._readings
        if state.generation != self._generation:
            self._generation = state.generation
            known.clear()
        elif kind in known:
            return known[kind]
        has_data, body = _FIELDS[kind]
        known[kind] = None
        if getattr(state, has_data):
            form, data_type = self._forms[kind & 1]
            known[kind] = data_type(*form.unpack_from(getattr(state, body)))
        return known[kind]


_READ: dict[str, Callable[[NativeEsc], Any]] = {
    "live": lambda esc: esc.reading(_LIVE),
    "info": lambda esc: esc.reading(_INFO),
    "last_live": lambda esc: esc.reading(_LAST_LIVE),
    "last_info": lambda esc: esc.reading(_LAST_INFO),
    "device": lambda esc: esc.protocol.value("device_raw", esc.reading(_LAST_INFO)),
    "link": lambda esc: LinkState(esc._state.link),
    "layout": lambda esc: esc._state.layout,
    "cells": lambda esc: esc._state.cells,
    "frame_rate": lambda esc: esc._state.rate if esc._state.rate >= 0 else None,
    "live_ns": lambda esc: esc._state.live_ns if esc._state.has_time else None,
    "live_bound_ns": lambda esc: esc._state.live_bound,
    "last_info_ns": lambda esc: esc._state.last_info_ns if esc._state.had_info else None,
    "info_bound_ns": lambda esc: esc._state.info_bound if esc._state.has_info else None,
}
for _name, _read in _READ.items():
    setattr(NativeEsc, _name, property(_read))


def _energy(esc: NativeEsc) -> int:
    return int(esc._state.energy) * SECOND + int(esc._state.energy_rest)


def _set_energy(esc: NativeEsc, mw_ns: int) -> None:
    esc._state.energy, esc._state.energy_rest = divmod(mw_ns, SECOND)


def _set_run_time(esc: NativeEsc, ns: int) -> None:
    esc._state.run_time = ns


def _count(place: int) -> property:
    def read(esc: NativeEsc) -> Any:
        return esc._state.count[place]

    def write(esc: NativeEsc, value: int) -> None:
        esc._state.count[place] = value

    return property(read, write)


_COUNTS = ("losses", "late_frames", "suspect_frames")
_WRITABLE = {
    "energy_mw_ns": property(_energy, _set_energy),
    "run_time_ns": property(lambda esc: esc._state.run_time, _set_run_time),
}
"""Attributes that can be set. A later part of a capture begins with the earlier values."""
for _name in _COUNTS:
    _WRITABLE[_name] = _count(COUNTS.index(_name))
for _name, _property in _WRITABLE.items():
    setattr(NativeEsc, _name, _property)


_GATEWAY_STATES = tuple(GatewayState)
_CAN_STATES = tuple(CanState)
_FIELD_NAMES = {"can_state": "can_state_number"}
"""Names of fields whose C name is a property here."""


class NativeStatus(c.Structure):
    """The twin of GatewayStatus in the core's memory (kcg.gateway)."""

    _fields_ = tuple((_FIELD_NAMES.get(name, name), c.c_int64) for name in GATEWAY)

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


def places_of(sending: Any, count: int) -> list[SchedulePosition]:
    """Return the places of the first messages in their schedule (kcg_sending)."""
    found = []
    for each in sending[:count]:
        deferred_until = -1 if each.deferred == _NEVER else each.deferred
        sent_ns = max(-1, each.last)
        found.append(
            SchedulePosition(each.alive, each.page, sent_ns, deferred_until, each.cycle_deferred)
        )
    return found


def adopt_places(
    messages: Sequence[Any],
    sending: Any,
    core: Any,
    heap: Any,
    count: int,
    places: Sequence[Sequence[int]],
) -> None:
    """Continue from the places of the first ``count`` messages, and compute deadlines again.

    ``sending`` and ``heap`` belong to all messages and slots of the core (kcg).
    """
    for message, each, numbers in zip(messages, sending, places[:count], strict=False):
        place = SchedulePosition(*numbers)
        each.alive = place.alive % (message.last_alive + 1)
        each.page = place.page % max(1, message.pages)
        if place.sent_ns >= 0:
            each.last = place.sent_ns
        each.deferred = _NEVER if place.deferred_until < 0 else place.deferred_until
        each.cycle_deferred = place.cycle_deferred
    core.next_expiry = 0
    heaped = heap[: core.heaped]
    in_order = sorted(heaped, key=lambda i: min(sending[i].cycle_due, sending[i].deferred))
    for number, index in enumerate(in_order):  # a sorted list is a heap
        heap[number] = index
        sending[index].place_in_heap = number
