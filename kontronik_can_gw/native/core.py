"""The core in C in place of the one in Python (core.py): the same surface, and what is read of it has the same names."""

from collections.abc import Sequence
from typing import Any, cast

from kontronik_can_gw.core import OnEvent
from kontronik_can_gw.dbc.messages import own_ids
from kontronik_can_gw.esc.telemetry import EscSettings, Event
from kontronik_can_gw.gateway_status import GatewayStatus
from kontronik_can_gw.native.binding import Handle
from kontronik_can_gw.native.state import NativeEsc, NativeStatus
from kontronik_can_gw.native.tables import Tables
from kontronik_can_gw.output import Owner
from kontronik_can_gw.signals.plan import Layout


class NativeCore:
    """As Core. NotInCore where the core in C cannot express the layout or an ESC's settings."""

    def __init__(
        self,
        library: Any,
        escs: Sequence[EscSettings],
        layout: Layout,
        now: int,
        silent: bool,
        on_event: OnEvent,
    ) -> None:
        self._handle = Handle(library, Tables(layout, escs, silent), now, self._follow)
        self.status = cast(GatewayStatus, NativeStatus(self._handle.gateway))
        self.status.esc_count = len(escs)
        self.escs = [NativeEsc(*pair) for pair in zip(escs, self._handle.escs, strict=True)]
        self.own_ids: dict[int, Owner] = own_ids(layout)
        self._on_event = on_event
        self._settings = list(escs)
        self.shortest_timeout_ns = self._shortest_timeout()
        self.packs_at_once = False
        handle = self._handle
        self.receive, self.port, self.advance = handle.receive, handle.port, handle.advance
        self.expire, self.next_deadline = handle.expire, handle.next_deadline
        self.gateway_changed, self.repeat = handle.gateway_changed, handle.repeat
        self.stop, self.take = handle.stop, handle.take

    def report_only(self, events: int) -> None:
        self._handle.report_only(events | Event.SECOND | Event.LINK)  # which NativeEsc follows

    @property
    def is_pending(self) -> bool:
        return self._handle.is_pending

    def apply(self, esc: int, settings: EscSettings) -> None:
        self._handle.apply(esc, settings)
        self.escs[esc].apply(settings)
        self._settings[esc] = settings
        self.shortest_timeout_ns = self._shortest_timeout()

    def pack(self, now: int) -> None:
        """Nothing: this core packs when it hands over."""

    def _follow(self, esc: int, events: int, now: int) -> None:
        self.escs[esc].follow(events)
        self._on_event(esc, events, now)

    def _shortest_timeout(self) -> int:
        return min(settings.timeout_ns for settings in self._settings)
