"""What others read of the core in C: the state of an ESC and of the gateway, straight from its memory."""

import struct
from collections.abc import Callable
from typing import Any

from kontronik_can_gw.esc.decoder import SECOND_NS, Counters, Data
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry, Event, LinkState
from kontronik_can_gw.gateway_status import CanState, GatewayState
from kontronik_can_gw.native.rows import COUNTS, GATEWAY

_STREAM = COUNTS.index("long_run_bytes") + 1
"""Number of counters in kcg_esc.count that are those of the stream."""
_PLACES = (("has_live", "live"), ("has_info", "info"), ("had_live", "live"), ("had_info", "info"))
"""Of live data, info, and the newest ever of both: whether there is any, and its bytes."""
_COUNT = {name: COUNTS.index(name) for name in ("losses", "late_frames", "suspect_frames")}


class NativeDrawn:
    """As Drawn: ``energy`` in whole milliwatt seconds, ``run_time`` in ns."""

    def __init__(self, state: Any) -> None:
        self._state = state

    @property
    def energy(self) -> int:
        found: int = self._state.energy
        return found

    @property
    def run_time(self) -> int:
        found: int = self._state.run_time
        return found

    @run_time.setter
    def run_time(self, ns: int) -> None:
        self._state.run_time = ns

    @property
    def energy_mw_ns(self) -> int:
        """The energy in milliwatt nanoseconds, as a capture holds it."""
        return self.energy * SECOND_NS + int(self._state.energy_rest)

    @energy_mw_ns.setter
    def energy_mw_ns(self, energy: int) -> None:
        self._state.energy, self._state.energy_rest = divmod(energy, SECOND_NS)


class NativeEsc(EscTelemetry):
    """The state of an ESC. What the core holds is read when somebody asks."""

    def __init__(self, settings: EscSettings, state: Any) -> None:
        self._state = state
        self.protocol = protocol_named(settings.protocol)
        assert self.protocol.wire is not None
        self._forms = [(struct.Struct("<" + codes), kind) for codes, kind in self.protocol.wire]
        self._generation = -1
        self._link_before = LinkState.NEVER_SEEN
        self._readings: dict[int, Data | None] = {}
        self._counters_of = type(self.protocol.make().counters)
        self.drawn = NativeDrawn(state)
        self.line_errors = self.base_losses = self.base_line_errors = 0
        self.apply(settings)
        self.base = self._window_counters = self._diagnosis_counters = self.counters

    def follow(self, events: int) -> None:
        """Keep the counters of the begin of the second before, for ``diagnosis``."""
        came_up = False
        if events & Event.LINK:
            before, self._link_before = self._link_before, self.link
            came_up = self.link is LinkState.OK and before not in (LinkState.OK, LinkState.DEGRADED)
        if came_up or events & Event.SECOND:
            counters = self.counters
            self._diagnosis_counters = counters if came_up else self._window_counters
            self._window_counters = counters

    @property
    def counters(self) -> Counters:
        found: Counters = self._counters_of(*self._state.count[:_STREAM])
        return found

    def __setattr__(self, name: str, value: Any) -> None:
        if (place := _COUNT.get(name)) is not None:
            self._state.count[place] = value  # as a capture of a later part begins with
        else:
            super().__setattr__(name, value)

    def __getattr__(self, name: str) -> Any:
        if (place := _COUNT.get(name)) is not None:
            return self._state.count[place]
        if (read := _READ.get(name)) is None:
            raise AttributeError(name)
        return read(self)

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


def _member(name: str, place: int, kind: Callable[[int], Any] | None) -> property:
    def read(self: "NativeStatus") -> Any:
        found = self._gateway[place]
        return found if kind is None else kind(found)

    def write(self: "NativeStatus", value: int) -> None:
        self._gateway[place] = value

    return property(read, write, doc=f"GatewayStatus.{name}")


class NativeStatus:
    """As GatewayStatus, in the core's memory: its attributes are those of GATEWAY."""

    __slots__ = ("_gateway",)

    def __init__(self, gateway: Any) -> None:
        self._gateway = gateway


_KINDS: dict[str, Callable[[int], Any]] = {"state": GatewayState, "can_state": CanState}
for _place, _name in enumerate(GATEWAY):
    _name = _name.removeprefix("gateway_")
    setattr(NativeStatus, _name, _member(_name, _place, _KINDS.get(_name)))
