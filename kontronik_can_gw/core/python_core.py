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
    """The core in plain Python. See ``core.interface.Core`` for its methods.

    With ``silent_on_loss``, messages stop while telemetry is lost (``core.messages.Messages``).
    """

    language = "Python"
    note = ""

    def __init__(
        self,
        escs: Sequence[EscSettings],
        layout: Layout,
        now: int,
        silent_on_loss: bool,
    ) -> None:
        self.escs: list[EscStream] = [EscStream(settings, now) for settings in escs]
        self.status = GatewayStatus(esc_count=len(escs), started_ns=now)
        self.messages = Messages(layout, self.escs, self.status, now, silent_on_loss)
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
        """No ESC has a deadline before this time. 0: not known.

        ``expire`` computes it. It is lowered when a link comes up or info data begin.
        """

    # --- ESCs

    def receive(
        self,
        esc: int,
        data: bytes,
        now: int,
        since: int,
    ) -> None:
        state = self._expired(esc, now)
        for events in state.receive_each(data, now, since):
            self._report(esc, events, now)

    def accept(self, esc: int, reading: Reading, now: int) -> None:
        """Take a reading that arrived at ``now`` and that the ESC's decoder has counted."""
        events = self._expired(esc, now).accept(reading, now, now)
        if events:
            self._report(esc, events, now)

    def port(self, esc: int, is_open: bool, now: int) -> None:
        state = self.escs[esc]
        events = state.port_opened() if is_open else state.port_lost()
        if events:
            self._report(esc, events, now)

    def apply(self, esc: int, settings: EscSettings) -> None:
        self.escs[esc].apply(settings)
        self.shortest_timeout_ns = self._shortest_timeout()
        self._next_expiry = 0

    def _shortest_timeout(self) -> int:
        return min(esc.settings.timeout_ns for esc in self.escs)

    # --- time

    def expire(self, now: int, but: int | None = None) -> None:
        """Drop the expired values of all ESCs except ``but``."""
        if now < self._next_expiry:
            return
        for index, esc in enumerate(self.escs):
            if index != but and now >= esc.next_deadline():
                events = esc.advance(now)
                if events:
                    self._report(index, events, now)
        self._next_expiry = min(esc.next_deadline() for esc in self.escs)
        if now - self._second_ns >= SECOND:
            self._second_ns = now
            self.messages.on_gateway_change(now, each_second=True)

    def _expired(self, esc: int, now: int) -> EscStream:
        """Drop expired values, and return the state of an ESC that takes new ones.

        IndexError if there is no such ESC. Then nothing was dropped.
        """
        state = self.escs[esc]
        if now >= self._next_expiry:
            self.expire(now, but=esc)  # a message may hold values of several ESCs
            events = state.expire(now)
            if events:
                self._report(esc, events, now)
        return state

    def advance(self, now: int) -> None:
        if now >= self._next_expiry:
            self.expire(now)
        if now >= self.messages.next_due:
            self.messages.advance(now)
        self.slots.advance(now)

    def next_deadline(self) -> int:
        due = self._next_expiry or min(esc.next_deadline() for esc in self.escs)
        return min(due, self.messages.next_due, self.slots.next_deadline())

    # --- frames

    @property
    def is_pending(self) -> bool:
        return bool(self.messages.pending) or self.slots.is_pending

    def take(self, now: int) -> list[CanFrame]:
        slots = self.slots.take(now)
        messages = self.messages.take(now)
        return slots + messages if slots else messages

    def _report(self, esc: int, events: int, now: int) -> None:
        """Pass events of an ESC to messages, followers and slots."""
        self.messages.on_event(esc, events, now)
        if events & (Event.LINK | Event.INFO):
            self._follow_link(esc, events, now)
        for wanted, follow in self.followers:
            if events & wanted:
                follow(esc, events, now)
        # Slots are last, because they may hold values that followers have just changed.
        self.slots.on_event(esc, events, now)

    def _follow_link(self, esc: int, events: int, now: int) -> None:
        if events & Event.LINK:
            self.link_changes.append(esc)
        self._next_expiry = min(self._next_expiry, self.escs[esc].next_deadline())
        escs_ok = sum([each.live is not None for each in self.escs])
        if escs_ok != self.status.escs_ok:
            self.status.escs_ok = escs_ok
            self.messages.on_gateway_change(now)
