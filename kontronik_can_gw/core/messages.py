"""The messages of a layout: what makes each of them pending, and its frame when it is handed over.

Pure: ``on_event`` and time (``advance``) mark messages as pending, ``take`` packs what is pending: newest wins. A message is handed
over at most once in a step: in the order of the times at which the messages became due, then of their index. Cyclic messages have
spread phases, and none is sent closer than its minimum distance.
"""

from collections.abc import Sequence

from kontronik_can_gw.core.output import Owner
from kontronik_can_gw.esc.telemetry import EscTelemetry, Event
from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.frames import EXTENDED, CanFrame
from kontronik_can_gw.signals.packer import alive_modulus, compile_frame
from kontronik_can_gw.signals.plan import Layout, MessagePlan, Role, SendType
from kontronik_can_gw.status import GatewayStatus
from kontronik_can_gw.times import NEVER

_LONG_AGO = -(1 << 62)
_CYCLE, _REQUEST = 1, 2
"""Why a message is pending: its cycle, sent in any case, or a request, sent where it is news."""
_MIN_DISTANCE_NS = 1_000_000
"""Minimum distance between frames of a message that are not caused by an event."""
_EVENT_OF_PACE = {
    Group.LIVE: Event.LIVE,
    Group.INFO: Event.INFO,
    Group.LINK: Event.LINK,
    Group.GATEWAY: Event.NONE,
}


class Traits:
    """How a message is sent, by its plan; the tables of the core in C are made of the same."""

    def __init__(self, plan: MessagePlan, silent: bool) -> None:
        self.by_event = SendType.EVENT in plan.send_type
        self.on_change = SendType.ON_CHANGE in plan.send_type
        self.is_paged = len(plan.pages) > 1
        # no cycle, no minimum distance, nothing that follows by itself: the schedule never has to know of it
        self.is_free = not (plan.cycle_ns or plan.delay_ns or self.is_paged)
        # messages with the link's state always go on
        self.silent_able = (
            silent and bool(plan.paces & {Group.LIVE, Group.INFO}) and Group.LINK not in plan.paces
        )
        self.follows_gateway = Group.GATEWAY in plan.paces and (self.by_event or self.on_change)
        roles = {signal.role: signal for signal in plan.compiled}
        alive = roles.get(Role.ALIVE)
        self.alive_modulus = 0 if alive is None else alive_modulus(alive, Role.CRC in roles)
        self.triggers = Event.NONE
        if self.by_event or self.on_change:
            for pace in plan.paces:
                self.triggers |= _EVENT_OF_PACE[pace]
            if (
                self.triggers & Event.LINK
                and not plan.cycle_ns
                and not (self.by_event and self.triggers & Event.LIVE)
            ):
                self.triggers |= Event.SECOND  # counters, rates and ages change all the time


def phases(cycles: Sequence[int]) -> list[int]:
    """A phase for each message within its cycle: messages of one cycle are spaced evenly, and the groups interleave."""
    members: dict[int, list[int]] = {}
    for index, cycle in enumerate(cycles):
        members.setdefault(cycle, []).append(index)
    found = [0] * len(cycles)
    for number, (cycle, indices) in enumerate(sorted(members.items())):
        for place, index in enumerate(indices):
            found[index] = cycle * (place * len(members) + number) // (len(indices) * len(members))
    return found


class _Message(Traits):
    """One message at work.

    ``last`` holds the last frame of each page, with alive counter 0, of a message that is sent on change; ``pages_to_send`` the
    places of the pages that have to follow without waiting for an event.
    """

    def __init__(self, index: int, plan: MessagePlan, silent: bool, first_cycle: int) -> None:
        super().__init__(plan, silent)
        self.index = index
        self.plan = plan
        self.frame = compile_frame(plan)
        self.place = 0
        self.pages_to_send: set[int] = set()
        self.alive = 0
        self.last: dict[int, CanFrame] = {}
        self.why = 0
        self._sent_ns = _LONG_AGO
        self._cycle_due = first_cycle if plan.cycle_ns else NEVER
        self._deferred_until = NEVER
        self._cycle_deferred = False

    @property
    def due(self) -> int:
        """When ``take_due`` has something to do."""
        return min(self._cycle_due, self._deferred_until)

    def may_go(self, now: int) -> bool:
        """True if the minimum distance to its last frame is over."""
        return now >= self._sent_ns + self.plan.delay_ns

    def defer(self) -> None:
        """Put it off until its minimum distance is over."""
        if self._deferred_until == NEVER:
            self._deferred_until = self._sent_ns + self.plan.delay_ns

    def sent(self, now: int) -> None:
        """A frame of it was sent; what was put off is done, but for pages that have to follow."""
        self._sent_ns, self._cycle_deferred = now, False
        distance = max(self.plan.delay_ns, _MIN_DISTANCE_NS)
        self._deferred_until = now + distance if self.pages_to_send else NEVER

    def take_due(self, now: int) -> tuple[int, int]:
        """When it became due, and why; a late call skips missed cycles."""
        when, why = NEVER, 0
        if (until := self._deferred_until) <= now:
            when, why = until, _CYCLE | _REQUEST if self._cycle_deferred else _REQUEST
            self._deferred_until, self._cycle_deferred = NEVER, False
        if (start := self._cycle_due) <= now:
            cycle = self.plan.cycle_ns
            self._cycle_due += cycle * ((now - start) // cycle + 1)
            if self.may_go(now):
                return min(when, start), why | _CYCLE
            self.defer()
            self._cycle_deferred = True
        return when, why

    def follows(self, events: int, up: bool) -> bool:
        """Whether these events of an ESC are news to it. ``up``: the ESC's live data is fresh."""
        if up and self.by_event and self.triggers & Event.LIVE:  # live frames set the pace
            events &= ~Event.LINK
        return bool(self.triggers & events)

    def add_all_pages(self) -> None:
        """Let all pages follow, of a message that has several."""
        if self.is_paged:
            self.pages_to_send.update(range(len(self.plan.pages)))

    def turn_page(self) -> None:
        """Let the page follow whose turn it is, of a message that has several."""
        if self.is_paged:
            self.pages_to_send.add(self.place)
            self.place = (self.place + 1) % len(self.plan.pages)

    def take_place(self) -> int:
        """The place of the page to send: the first of those that are to follow, from the one on whose turn it is next."""
        if not self.is_paged:
            return 0
        if not self.pages_to_send:
            self.turn_page()
        count = len(self.plan.pages)
        place = min(self.pages_to_send, key=lambda place: (place - self.place) % count)
        self.pages_to_send.remove(place)
        return place


def own_ids(layout: Layout) -> dict[int, Owner]:
    """The ids of the messages (29-bit ones with EXTENDED), and what for."""
    return {
        plan.can_id | (EXTENDED if plan.extended else 0): Owner(None, f"message {plan.name}")
        for plan in layout.messages
    }


class Messages:
    """All messages of one layout.

    ``silent``: on loss of telemetry messages with values of a lost ESC stop instead of carrying NotAvailable.
    """

    def __init__(
        self,
        layout: Layout,
        escs: Sequence[EscTelemetry],
        gateway: GatewayStatus,
        now: int,
        silent: bool = False,
    ) -> None:
        self._escs = escs
        self._gateway = gateway
        first = phases([plan.cycle_ns for plan in layout.messages])
        self._messages = [
            _Message(index, plan, silent, now + phase)
            for index, (plan, phase) in enumerate(zip(layout.messages, first, strict=True))
        ]
        self._of_gateway = [m for m in self._messages if m.follows_gateway]
        self._of_esc = [
            [m for m in self._messages if esc in m.plan.escs] for esc in range(len(escs))
        ]
        self._timed = [m for m in self._messages if not m.is_free]
        self.pending: dict[int, int] = {}
        """Messages that ``take`` hands over, and since when."""
        self._stopping = False

    @property
    def next_due(self) -> int:
        """When ``advance`` has something to do; NEVER for never."""
        return min([message.due for message in self._timed], default=NEVER)

    # --- what makes messages pending

    def on_event(self, esc: int, events: int, now: int) -> None:
        """Something of an ESC changed: bits of telemetry.Event."""
        state = self._escs[esc]
        up = state.live is not None
        # no further event brings the other pages
        is_last = not up or (events & Event.INFO and state.info is None)
        for message in self._of_esc[esc]:
            if message.follows(events, up):
                if is_last and message.by_event:
                    message.add_all_pages()
                self._request(message, now)

    def on_gateway_change(self, now: int, each_second: bool = False) -> None:
        """The gateway's own state changed; ``each_second``: only its counters, which is news for messages that have no cycle."""
        for message in self._of_gateway:
            if not (each_second and message.plan.cycle_ns):
                self._request(message, now)

    def repeat(self, now: int) -> None:
        """Send every message that has no cycle once, so that nobody goes on with values from before a restart or an outage."""
        for message in self._messages:
            message.last.clear()
            if not message.plan.cycle_ns:
                message.add_all_pages()
                self._request(message, now)

    def stop(self, now: int) -> None:
        """What the gateway says of itself goes out once more, all pages at once, without regard to minimum distances."""
        self._stopping = True
        for message in self._of_gateway:
            if message.by_event:
                message.add_all_pages()
            self._let_go(message, now, _REQUEST)

    def advance(self, now: int) -> None:
        """Let time pass: cycles, and what a minimum distance has put off."""
        for message in self._timed:
            when, why = message.take_due(now)
            if why:
                self._let_go(message, when, why)

    def _request(self, message: _Message, now: int) -> None:
        """Let a message be handed over as soon as its minimum distance allows."""
        if message.may_go(now):
            self._let_go(message, now, _REQUEST)
        elif self._is_news(message, now):
            message.defer()

    def _let_go(self, message: _Message, since: int, why: int) -> None:
        self.pending[message.index] = min(since, self.pending.get(message.index, since))
        message.why |= why

    # --- frames

    def take(self, now: int) -> list[CanFrame]:
        """The frames of what is pending, as they are now."""
        pending, self.pending = self.pending, {}
        frames: list[CanFrame] = []
        for _, index in sorted((since, index) for index, since in pending.items()):
            message = self._messages[index]
            why, message.why = message.why, 0
            if self._is_sent(message, why, now):
                frames.append(self._frame(message, now))
                while self._stopping and message.pages_to_send:
                    frames.append(self._frame(message, now))
        return frames

    def _is_sent(self, message: _Message, why: int, now: int) -> bool:
        """Whether a pending message is sent; one whose cycle is over turns its page."""
        if message.silent_able and not any(self._escs[esc].up for esc in message.plan.escs):
            message.pages_to_send.clear()
            return False
        is_news = bool(why & _REQUEST) and self._is_news(message, now)
        if why & _CYCLE:
            message.turn_page()
        return is_news or bool(why & _CYCLE)

    def _is_news(self, message: _Message, now: int) -> bool:
        """False for a message that is sent on change and has not changed; of several pages those that have follow."""
        if message.by_event or not message.on_change:
            return True
        changed = [
            place
            for place in range(len(message.plan.pages))
            if message.frame(self._escs, self._gateway, now, 0, place) != message.last.get(place)
        ]
        if message.is_paged:
            message.pages_to_send.update(changed)
        return bool(changed or message.pages_to_send)

    def _frame(self, message: _Message, now: int) -> CanFrame:
        """The frame of the page that is next; what it changes is noted."""
        place = message.take_place()
        frame = message.frame(self._escs, self._gateway, now, message.alive, place)
        if message.on_change:
            message.last[place] = message.frame(self._escs, self._gateway, now, 0, place)
        if message.alive_modulus:
            message.alive = (message.alive + 1) % message.alive_modulus
        message.sent(now)
        return frame
