"""The core: bytes of ESCs and time in, CAN frames and deadlines out. Telemetry of each ESC, the messages of a layout, their schedule.

Pure, and the way of every value: ``receive`` decodes and marks messages as pending, ``advance`` lets cycles and time-outs pass,
``take`` packs what is pending. What happens besides is reported to ``followers``. ``now`` is integer nanoseconds of one monotonic clock.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol

from kontronik_can_gw.core.esc_stream import EscStream
from kontronik_can_gw.core.messages import Messages, own_ids
from kontronik_can_gw.core.output import Owner
from kontronik_can_gw.core.slots import Slot, Slots
from kontronik_can_gw.esc.decoder import Reading
from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry, Event
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.signals.plan import Layout
from kontronik_can_gw.status import GatewayStatus
from kontronik_can_gw.times import SECOND

OnEvent = Callable[[int, int, int], None]
"""ESC, bits of telemetry.Event, time."""


class Follower(NamedTuple):
    """``on_event`` is given what happens, as it happens, with at least one of ``events``."""

    events: int
    on_event: OnEvent


class Core(Protocol):
    """The seam of the core: what the gateway asks of it. In Python it is PythonCore, in C native.core.NativeCore."""

    language: str
    """``Python`` or ``C``."""
    note: str
    """What live frames need Python for although the core is in C, in words; empty: nothing."""

    @property
    def escs(self) -> Sequence[EscTelemetry]:
        """The state of each ESC."""

    @property
    def status(self) -> GatewayStatus:
        """The gateway's own values; the runtime writes the CAN side, then ``gateway_changed`` where that cannot wait."""

    @property
    def own_ids(self) -> Mapping[int, Owner]:
        """The ids of the messages (29-bit ones with EXTENDED), and what for."""

    followers: Sequence[Follower]
    link_changes: list[int]
    """ESCs whose link state, layout or device changed; the owner empties it."""
    shortest_timeout_ns: int
    """Of all ESCs: live data of one is not available after this."""
    packs_at_once: bool
    """As 0.5.0 did, to replay its captures: with each event, so that one step may make several frames of a message."""

    def receive(self, esc: int, data: bytes, now: int, since: int) -> None:
        """Bytes of one ESC's UART, read at ``now``. ``since``: none of them had come by then (stream.py, Arrival)."""

    def port(self, esc: int, is_open: bool, now: int) -> None:
        """An ESC's port was opened (again), or cannot be used: its values are not available from now on."""

    def apply(self, esc: int, settings: EscSettings) -> None:
        """Other settings of an ESC from now on."""

    def slot(self, esc: int) -> Slot:
        """A further slot of an ESC."""

    def expire(self, now: int) -> None:
        """What is too old by now goes."""

    def advance(self, now: int) -> None:
        """Let time pass: time-outs, cyclic messages."""

    def next_deadline(self) -> int:
        """When ``advance`` is to be called at the latest."""

    def gateway_changed(self, now: int) -> None:
        """``status`` has changed: messages that hold it follow."""

    def repeat(self, now: int) -> None:
        """Send every message that has no cycle once, so that nobody goes on with values from before a restart or an outage."""

    def stop(self, now: int) -> None:
        """What the gateway says of itself goes out once more, all pages at once, without regard to minimum distances."""

    @property
    def is_pending(self) -> bool:
        """True while ``take`` has something to do."""

    def take(self, now: int) -> list[CanFrame]:
        """The frames of what is due, with the values of now: slots, then messages, each in the order in which they became due."""

    def pack(self, now: int) -> None:
        """Make the frames of what is pending, before ``take`` asks for them."""


class PythonCore:
    """The core in plain Python. ``silent``: see Messages. ``packs_at_once``: see Core."""

    language = "Python"
    note = ""

    def __init__(
        self,
        escs: Sequence[EscSettings],
        layout: Layout,
        now: int,
        silent: bool,
        packs_at_once: bool = False,
    ) -> None:
        self.escs: list[EscStream] = [EscStream(settings, now) for settings in escs]
        self.status = GatewayStatus(esc_count=len(escs), started_ns=now)
        self.messages = Messages(layout, self.escs, self.status, now, silent)
        self.slots = Slots(self.escs, self.status, packs_at_once)
        self.slot = self.slots.add
        self.own_ids = own_ids(layout)
        self.gateway_changed = self.messages.on_gateway_change
        self.repeat = self.messages.repeat
        self.stop = self.messages.stop
        self.shortest_timeout_ns = self._shortest_timeout()
        self.packs_at_once = packs_at_once
        self._packed: list[CanFrame] = []
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
        if self._packed:
            messages, self._packed = self._packed + messages, []
        return slots + messages if slots else messages

    @property
    def is_pending(self) -> bool:
        return bool(self.messages.pending) or self.slots.is_pending

    def pack(self, now: int) -> None:
        self._packed += self.messages.take(now)

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
        if self.packs_at_once:
            self.pack(now)
        for wanted, follow in self.followers:
            if events & wanted:
                follow(esc, events, now)
        self.slots.on_event(esc, events, now)  # what followers know may be in one

    def _shortest_timeout(self) -> int:
        return min(esc.settings.timeout_ns for esc in self.escs)
