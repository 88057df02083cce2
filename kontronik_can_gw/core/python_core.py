"""The core in plain Python: telemetry of each ESC, messages with their schedule, and slots."""

from collections.abc import Sequence

from kontronik_can_gw.core.esc_stream import EscStream
from kontronik_can_gw.core.interface import Follower
from kontronik_can_gw.core.messages import Messages, own_ids
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.core.slots import Slots
from kontronik_can_gw.esc.decoder import Reading
from kontronik_can_gw.esc.telemetry import EscSettings, Event
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.status import GatewayState, GatewayStatus
from kontronik_can_gw.times import NEVER, SECOND


class PythonCore:
    """The core in plain Python. See ``core.interface.Core`` for its methods."""

    language = "Python"

    def __init__(self, settings: CoreSettings, now: int, note: str = "") -> None:
        self.note = note
        self.escs: list[EscStream] = [EscStream(esc, now) for esc in settings.escs]
        self.status = GatewayStatus(esc_count=len(settings.escs), started_ns=now, heard_ns=now)
        self.messages = Messages(settings, self.escs, self.status, now)
        self.slots = Slots(self.escs, self.status)
        self.slot = self.slots.add
        self.own_ids = own_ids(settings.layout)
        self.gateway_changed = self.messages.on_gateway_change
        self.places = self.messages.places
        self.repeat = self.messages.repeat
        self.stop = self.messages.stop
        self.followers: Sequence[Follower] = ()
        self.link_changes: list[int] = []
        self._quiet_after_ns = settings.quiet_after_ns
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
        self._next_expiry = 0

    # --- a replay that begins later in a run

    def adopt_places(self, places: Sequence[Sequence[int]]) -> None:
        self.messages.adopt_places(places)
        self._next_expiry = 0

    # --- time

    def expire(self, now: int, but: int | None = None) -> None:
        """Drop the expired values of all ESCs except ``but``."""
        if now < self._next_expiry:
            return
        for index, esc in enumerate(self.escs):
            if index != but and now >= self._deadline_of(esc):
                events = esc.advance(now)
                if events:
                    self._report(index, events, now)
        self._next_expiry = self._first_expiry()
        if now - self._second_ns >= SECOND:
            self._second_ns = now
            self.messages.on_gateway_change(now, each_second=True)

    def _deadline_of(self, esc: EscStream) -> int:
        """Return the next deadline of an ESC.

        In quiet mode no second of its statistics ends, until live data of any ESC are about to end
        this mode.
        """
        if self.status.is_quiet and not self.status.escs_ok:
            return esc.expiry()
        return esc.next_deadline()

    def _first_expiry(self) -> int:
        return min([self._deadline_of(esc) for esc in self.escs])

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
        if now >= self._quiet_deadline():
            self._change_quiet(now)
        if self.status.is_quiet:
            return
        if now >= self.messages.next_due:
            self.messages.advance(now)
        self.slots.advance(now)

    def next_deadline(self) -> int:
        due = min(self._next_expiry or self._first_expiry(), self._quiet_deadline())
        if self.status.is_quiet:
            return due
        return min(due, self.messages.next_due, self.slots.next_deadline())

    # --- quiet mode

    def _quiet_deadline(self) -> int:
        """Return the time at which quiet mode begins or ends."""
        if self.status.is_quiet:
            return self.status.heard_ns if self.status.escs_ok else NEVER
        if not self._quiet_after_ns or self.status.escs_ok:
            return NEVER
        return self.status.heard_ns + self._quiet_after_ns

    def _change_quiet(self, now: int) -> None:
        """Begin quiet mode, or end it."""
        is_quiet = not self.status.is_quiet
        self.status.is_quiet = is_quiet
        self._next_expiry = 0
        if is_quiet and self.status.state is GatewayState.RUNNING:
            self.status.state = GatewayState.QUIET
        elif not is_quiet and self.status.state is GatewayState.QUIET:
            self.status.state = GatewayState.RUNNING
        self.slots.set_quiet(is_quiet)
        if is_quiet:
            self.messages.begin_quiet(now)
        else:
            self.messages.end_quiet(now)
        self._report(0, Event.QUIET, now)

    # --- frames

    @property
    def is_pending(self) -> bool:
        return bool(self.messages.pending or self.slots.pending)

    def take(self, now: int) -> list[CanFrame]:
        frames: list[CanFrame] = []
        for slot in self.slots.take(now):
            frames += slot.frames
        return frames + self.messages.take(now)

    def take_oldest(self, now: int) -> list[CanFrame]:
        if self.slots.pending_since <= self.messages.pending_since:
            return self.slots.take(now, 1)[0].frames
        return self.messages.take(now, 1)

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
        self._next_expiry = min(self._next_expiry, self._deadline_of(self.escs[esc]))
        escs_ok = sum([each.live is not None for each in self.escs])
        if escs_ok != self.status.escs_ok:
            self.status.escs_ok = escs_ok
            if self.status.is_quiet:
                self._next_expiry = 0  # see _deadline_of
            if not escs_ok:
                self.status.heard_ns = max([each.live_ns or 0 for each in self.escs])
            self.messages.on_gateway_change(now)
