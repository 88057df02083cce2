"""The core in C in place of the one in Python (core.py): the same surface, and what is read of it has the same names."""

from collections.abc import Sequence
from typing import Any, cast

from kontronik_can_gw.core import Follower
from kontronik_can_gw.dbc.messages import own_ids
from kontronik_can_gw.esc.telemetry import EscSettings, Event
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway_status import GatewayStatus
from kontronik_can_gw.native.binding import Handle
from kontronik_can_gw.native.slots import NativeSlot, reserve
from kontronik_can_gw.native.state import NativeEsc, NativeStatus
from kontronik_can_gw.native.tables import Tables
from kontronik_can_gw.native.turns import Turns
from kontronik_can_gw.output import Owner
from kontronik_can_gw.signals.plan import Layout
from kontronik_can_gw.slots import Slot, Slots

_LIVE_IN_PYTHON = "a PDO with a value that it does not have is sent in Python"


class NativeCore(Handle):
    """As Core. NotInCore where the core in C cannot express the layout or an ESC's settings.

    ``slots``: of each ESC in C; further ones, and those with values that C does not know, are in Python and are handed over first.
    """

    language = "C"

    def __init__(
        self,
        library: Any,
        escs: Sequence[EscSettings],
        layout: Layout,
        now: int,
        silent: bool,
        slots: int = 0,
    ) -> None:
        tables = Tables(layout, escs, silent)
        self._places = reserve(tables, slots)
        super().__init__(library, tables, now, self._follow)
        self.status = cast(GatewayStatus, NativeStatus.from_buffer(self.state.gateway))
        self.status.esc_count = len(escs)
        self.escs = [NativeEsc(*pair) for pair in zip(escs, self.esc_states, strict=True)]
        self.own_ids: dict[int, Owner] = own_ids(layout)
        self._slots = Slots(self.escs, self.status)
        self._followers: Sequence[Follower] = ()
        self._choose_events()
        self.link_changes: list[int] = []
        self.shortest_timeout_ns = self._shortest_timeout()
        self.packs_at_once = False

    @property
    def followers(self) -> Sequence[Follower]:
        return self._followers

    @followers.setter
    def followers(self, given: Sequence[Follower]) -> None:
        self._followers = given
        self._choose_events()

    def _choose_events(self) -> None:
        """Be given the events that somebody in Python follows."""
        events = Event.LINK | self._slots.triggers  # which is followed here in any case
        for wanted, _ in self._followers:
            events |= wanted
        self.reports_live = bool(events & Event.LIVE)
        """True while somebody follows each live frame."""
        self.note = _LIVE_IN_PYTHON if self.reports_live else ""
        self.report_only(events)

    def slot(self, esc: int) -> Slot:
        places, python = self._places[esc], self._slots.add(esc)
        place = places.pop(0) if places else None
        protocol = self.escs[esc].settings.protocol
        return NativeSlot(self, place, esc, protocol, python, self._choose_events)

    def advance(self, now: int) -> None:
        super().advance(now)
        self._slots.advance(now)

    def advance_in_python(self, now: int) -> None:
        """The same for what C does not know: the slots in Python."""
        self._slots.advance(now)

    def next_deadline(self) -> int:
        return min(super().next_deadline(), self._slots.next_deadline())

    def deadline_in_python(self) -> int:
        """When ``advance_in_python`` has something to do; 0 while one of these slots is pending."""
        return 0 if self._slots.is_pending else self._slots.next_deadline()

    def turns(self) -> Turns:
        """Whole turns of a loop with this core."""
        return Turns(self.library, self.core, len(self.escs))

    def follow(self, found: int, now: int) -> None:
        """Follow an event that a turn came back with; if there are others it comes back with each."""
        self._follow(found >> 8, found & 0xFF, now)

    def follow_others(self, now: int) -> None:
        """Follow these, where the rest of the turn is the loop's."""
        self.follow_all(self.library.kcg_next_event(self.core), now)

    @property
    def is_pending(self) -> bool:
        return bool(self.state.pendings) or self._slots.is_pending

    def take(self, now: int) -> list[CanFrame]:
        return self._slots.take(now) + super().take(now)

    def apply(self, esc: int, settings: EscSettings) -> None:
        super().apply(esc, settings)
        self.escs[esc].apply(settings)
        self.shortest_timeout_ns = self._shortest_timeout()

    def pack(self, now: int) -> None:
        """Nothing: this core packs when it hands over."""

    def _follow(self, esc: int, events: int, now: int) -> None:
        if events & Event.LINK:
            self.link_changes.append(esc)
        for wanted, follow in self._followers:
            if events & wanted:
                follow(esc, events, now)
        self._slots.on_event(esc, events, now)

    def _shortest_timeout(self) -> int:
        return min(esc.settings.timeout_ns for esc in self.escs)
