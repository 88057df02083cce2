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

_OF_ITS_OWN = Event.SECOND | Event.LINK
"""Followed here in any case."""


class NativeCore:
    """As Core. NotInCore where the core in C cannot express the layout or an ESC's settings."""

    language = "C"

    def __init__(
        self,
        library: Any,
        escs: Sequence[EscSettings],
        layout: Layout,
        now: int,
        silent: bool,
    ) -> None:
        self._handle = Handle(library, Tables(layout, escs, silent), now, self._follow)
        self.status = cast(GatewayStatus, NativeStatus(self._handle.gateway))
        self.status.esc_count = len(escs)
        self.escs = [NativeEsc(*pair) for pair in zip(escs, self._handle.escs, strict=True)]
        self.own_ids: dict[int, Owner] = own_ids(layout)
        self._followers: Sequence[OnEvent] = ()
        self._handle.report_only(_OF_ITS_OWN)
        self.link_changes: list[int] = []
        self.shortest_timeout_ns = self._shortest_timeout()
        self.packs_at_once = False
        self.handle = handle = self._handle
        self.receive, self.port, self.advance = handle.receive, handle.port, handle.advance
        self.expire, self.next_deadline = handle.expire, handle.next_deadline
        self.gateway_changed, self.repeat = handle.gateway_changed, handle.repeat
        self.stop, self.take = handle.stop, handle.take

    @property
    def followers(self) -> Sequence[OnEvent]:
        return self._followers

    @followers.setter
    def followers(self, given: Sequence[OnEvent]) -> None:
        self._followers = given
        self._handle.report_only(Event.ALL if given else _OF_ITS_OWN)

    @property
    def is_pending(self) -> bool:
        return self._handle.is_pending

    def apply(self, esc: int, settings: EscSettings) -> None:
        self._handle.apply(esc, settings)
        self.escs[esc].apply(settings)
        self.shortest_timeout_ns = self._shortest_timeout()

    def pack(self, now: int) -> None:
        """Nothing: this core packs when it hands over."""

    def _follow(self, esc: int, events: int, now: int) -> None:
        self.escs[esc].follow(events)
        if events & Event.LINK:
            self.link_changes.append(esc)
        for follow in self._followers:
            follow(esc, events, now)

    def _shortest_timeout(self) -> int:
        return min(esc.settings.timeout_ns for esc in self.escs)
