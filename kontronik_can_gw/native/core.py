"""The core in C in place of the one in Python (core.py): the same surface, and what is read of it has the same names."""

from collections.abc import Sequence
from typing import Any, cast

from kontronik_can_gw.core import Follower
from kontronik_can_gw.dbc.messages import own_ids
from kontronik_can_gw.esc.telemetry import EscSettings, Event
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway_status import GatewayStatus
from kontronik_can_gw.native.binding import Handle
from kontronik_can_gw.native.state import NativeEsc, NativeStatus
from kontronik_can_gw.native.tables import Tables
from kontronik_can_gw.native.turns import Turns
from kontronik_can_gw.output import Owner
from kontronik_can_gw.signals.plan import Layout
from kontronik_can_gw.slots import PythonSlot, Slot, Slots, SlotSettings

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
        self.slots = Slots(self.escs, self.status)
        self._followers: Sequence[Follower] = ()
        self.report_what_is_followed()
        self.link_changes: list[int] = []
        self.shortest_timeout_ns = self._shortest_timeout()
        self.packs_at_once = False
        handle = self._handle
        self.receive, self.port, self.expire = handle.receive, handle.port, handle.expire
        self.gateway_changed, self.repeat = handle.gateway_changed, handle.repeat
        self.stop = handle.stop

    @property
    def followers(self) -> Sequence[Follower]:
        return self._followers

    @followers.setter
    def followers(self, given: Sequence[Follower]) -> None:
        self._followers = given
        self.report_what_is_followed()

    def report_what_is_followed(self) -> None:
        """Be given the events that somebody in Python follows."""
        events = _OF_ITS_OWN | self.slots.triggers
        for wanted, _ in self._followers:
            events |= wanted
        self._handle.report_only(events)

    def slot(self, esc: int) -> Slot:
        return NativeSlot(self, self.slots.add(esc))

    def advance(self, now: int) -> None:
        self._handle.advance(now)
        self.slots.advance(now)

    def next_deadline(self) -> int:
        return min(self._handle.next_deadline(), self.slots.next_deadline())

    def turns(self) -> Turns:
        """Whole turns of a loop with this core."""
        return Turns(self._handle.library, self._handle.core, len(self.escs))

    def follow(self, found: int, now: int) -> None:
        """Follow an event that a turn came back with, and what else there is."""
        self._handle.follow(found, now)

    @property
    def reports_live(self) -> bool:
        """True while somebody follows each live frame."""
        return bool(self._followers)

    @property
    def is_pending(self) -> bool:
        return self._handle.is_pending or self.slots.is_pending

    def take(self, now: int) -> list[CanFrame]:
        return self.slots.take(now) + self._handle.take(now)

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
        for wanted, follow in self._followers:
            if events & wanted:
                follow(esc, events, now)
        self.slots.on_event(esc, events, now)

    def _shortest_timeout(self) -> int:
        return min(esc.settings.timeout_ns for esc in self.escs)


class NativeSlot:
    """As Slot."""

    def __init__(self, core: NativeCore, python: PythonSlot) -> None:
        self._core = core
        self._python = python

    @property
    def sent(self) -> int:
        return self._python.sent

    @property
    def is_news(self) -> bool:
        return self._python.is_news

    def configure(self, settings: SlotSettings | None, now: int) -> None:
        self._python.configure(settings, now)
        self._core.report_what_is_followed()

    def start(self, now: int) -> None:
        self._python.start(now)
        self._core.report_what_is_followed()

    def stop(self) -> None:
        self._python.stop()
        self._core.report_what_is_followed()

    def news(self, now: int) -> None:
        self._python.news(now)

    def send(self, now: int) -> None:
        self._python.send(now)
