"""The core in plain Python: telemetry of each ESC, messages with their schedule, and slots."""

from collections.abc import Sequence

from kontronik_can_gw.core.esc_stream import EscStream
from kontronik_can_gw.core.interface import Follower
from kontronik_can_gw.core.messages import Messages, own_ids
from kontronik_can_gw.core.slots import Slots
from kontronik_can_gw.esc.decoder import Reading
from kontronik_can_gw.esc.telemetry import EscSettings, Event
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.signals.plan import Layout
from kontronik_can_gw.status import GatewayStatus
from kontronik_can_gw.times import SECOND


class PythonCore:
    """The core in plain Python. ``silent``: see Messages."""

    language = "Python"
    note = ""

    def __init__(
        self,
        escs: Sequence[EscSettings],
        layout: Layout,
        now: int,
        silent: bool,
    ) -> None:
        self.escs: list[EscStream] = [EscStream(settings, now) for settings in escs]
        self.status = GatewayStatus(esc_count=len(escs), started_ns=now)
        self.messages = Messages(layout, self.escs, self.status, now, silent)
        self.slots = Slots(self.escs, self.status)
        self.slot = self.slots.add
        self.own_ids = own_ids(layout)
        self.gateway_changed = self.messages.on_gateway_change
        self.repeat = self.messages.repeat
        self.stop = self.messages.stop
        self.shortest_timeout_ns = self._shortest_timeout()
        self.followers: Sequence[Follower] = ()
        self.link_changes: list[int] = []
        self._second_ns = now
        self._next_expiry = 0
        """No ESC has a deadline before this: they only move on, but for a link that comes up, which sets this back."""

    def receive(self, esc: int, data: bytes, now: int, since: int) -> None:
        state = self._expired(esc, now)
        for events in state.receive_each(data, now, since):
            self._report(esc, events, now)

    def accept(self, esc: int, reading: Reading, now: int) -> None:
        """A reading that came at ``now``; its ESC's decoder has counted it."""
        if events := self._expired(esc, now).accept(reading, now, now):
            self._report(esc, events, now)

    def _expired(self, esc: int, now: int) -> EscStream:
        """An ESC that is about to bring something, after what is too old by now went. IndexError where there is none, and nothing went."""
        state = self.escs[esc]
        if now >= self._next_expiry:
            self.expire(now, but=esc)  # a message may hold values of several ESCs
            if events := state.expire(now):
                self._report(esc, events, now)
        return state

    def port(self, esc: int, is_open: bool, now: int) -> None:
        state = self.escs[esc]
        if events := state.port_opened() if is_open else state.port_lost():
            self._report(esc, events, now)

    def apply(self, esc: int, settings: EscSettings) -> None:
        self.escs[esc].apply(settings)
        self.shortest_timeout_ns = self._shortest_timeout()
        self._next_expiry = 0

    def expire(self, now: int, but: int | None = None) -> None:
        """What is too old by now goes, of all ESCs ``but`` one that is about to bring something."""
        if now < self._next_expiry:
            return
        for index, esc in enumerate(self.escs):
            if index != but and now >= esc.next_deadline() and (events := esc.advance(now)):
                self._report(index, events, now)
        self._next_expiry = min(esc.next_deadline() for esc in self.escs)
        if now - self._second_ns >= SECOND:
            self._second_ns = now
            self.messages.on_gateway_change(now, each_second=True)

    def advance(self, now: int) -> None:
        if now >= self._next_expiry:
            self.expire(now)
        if now >= self.messages.next_due:
            self.messages.advance(now)
        self.slots.advance(now)

    def next_deadline(self) -> int:
        due = self._next_expiry or min(esc.next_deadline() for esc in self.escs)
        return min(due, self.messages.next_due, self.slots.next_deadline())

    def take(self, now: int) -> list[CanFrame]:
        slots, messages = self.slots.take(now), self.messages.take(now)
        return slots + messages if slots else messages

    @property
    def is_pending(self) -> bool:
        return bool(self.messages.pending) or self.slots.is_pending

    def _report(self, esc: int, events: int, now: int) -> None:
        self.messages.on_event(esc, events, now)
        if events & (Event.LINK | Event.INFO):
            if events & Event.LINK:
                self.link_changes.append(esc)
            self._next_expiry = min(self._next_expiry, self.escs[esc].next_deadline())
            escs_ok = sum([e.live is not None for e in self.escs])
            if escs_ok != self.status.escs_ok:
                self.status.escs_ok = escs_ok
                self.messages.on_gateway_change(now)
        for wanted, follow in self.followers:
            if events & wanted:
                follow(esc, events, now)
        self.slots.on_event(esc, events, now)  # what followers know may be in one

    def _shortest_timeout(self) -> int:
        return min(esc.settings.timeout_ns for esc in self.escs)
