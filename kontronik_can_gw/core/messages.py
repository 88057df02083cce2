"""The messages of a layout: when each of them is sent, and with which frame (twin: native/core.c).

Events of ESCs (``on_event``) and time (``advance``) mark messages as pending. ``take`` packs the
pending messages with the values of that moment, so the newest value wins. In one step a message
is sent at most once. The order is that of the times at which the messages became due, then of
their index. Messages with the same cycle are spread evenly over it. The minimum delay time of a
message is always kept.
"""

from collections.abc import Sequence
from operator import itemgetter

from kontronik_can_gw.core.interface import SchedulePosition
from kontronik_can_gw.core.output import Owner
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.esc.telemetry import EscTelemetry, Event
from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.signals.packer import alive_modulus, compile_frame
from kontronik_can_gw.signals.plan import MessageLayout, MessagePlan, Role, SendType
from kontronik_can_gw.status import GatewayStatus
from kontronik_can_gw.times import MS, NEVER

_CYCLE = 1
_REQUEST = 2
"""Why a message is pending. It is always sent for its cycle, and for a request if it has news."""
_MIN_DISTANCE_NS = MS
"""Minimum time between frames of a message that are not caused by an event."""
_EVENT_OF_PACE = {
    Group.LIVE: Event.LIVE,
    Group.INFO: Event.INFO,
    Group.LINK: Event.LINK,
    Group.GATEWAY: Event.NONE,
}


class Traits:
    """How a message is sent, according to its plan. The core in C is given the same."""

    def __init__(self, plan: MessagePlan, settings: CoreSettings) -> None:
        self.by_event = SendType.EVENT in plan.send_type
        self.on_change = SendType.ON_CHANGE in plan.send_type
        self.is_paged = len(plan.pages) > 1
        # Without a cycle, a minimum delay time and further groups, time never makes it pending.
        self.is_untimed = not any((plan.cycle_ns, plan.delay_ns, self.is_paged))
        self.is_silent_on_loss = settings.silent_on_loss and plan.can_stop
        moduli = [alive_modulus(s, plan.e2e) for s in plan.compiled if s.role is Role.ALIVE]
        self.alive_modulus = max(moduli, default=0)
        paces = plan.paces if self.by_event or self.on_change else ()
        self.follows_gateway = Group.GATEWAY in paces
        self.triggers = Event.NONE
        for pace in paces:
            self.triggers |= _EVENT_OF_PACE[pace]
        by_live_frames = self.by_event and self.triggers & Event.LIVE
        if self.triggers & Event.LINK and not (plan.cycle_ns or by_live_frames):
            # Counters, rates and ages change without an event. Nothing else sends the message.
            self.triggers |= Event.SECOND


def phases(cycles: Sequence[int]) -> list[int]:
    """Return the first time of each message within its cycle, in the unit of the cycles.

    Messages with the same cycle are spaced evenly. Groups with different cycles interleave.
    """
    members: dict[int, list[int]] = {}
    for index, cycle in enumerate(cycles):
        members.setdefault(cycle, []).append(index)
    found = [0] * len(cycles)
    groups = len(members)
    for number, cycle in enumerate(sorted(members)):
        indices = members[cycle]
        parts = len(indices) * groups
        for place, index in enumerate(indices):
            # place / len(indices) of the cycle, plus number / groups of the space between two
            part = place * groups + number
            found[index] = cycle * part // parts
    return found


class _Message(Traits):
    """The state of one message."""

    def __init__(
        self,
        index: int,
        plan: MessagePlan,
        settings: CoreSettings,
        first_cycle: int,
    ) -> None:
        super().__init__(plan, settings)
        self.index = index
        self.plan = plan
        self.live_triggers = self.triggers
        """Its triggers while live data is fresh."""
        if self.by_event and self.triggers & Event.LIVE:
            self.live_triggers &= ~Event.LINK  # each live frame causes it already
        self.frame = compile_frame(plan)
        self.place = 0
        self.pages_to_send: set[int] = set()
        """Places of groups that are sent next, without another event."""
        self.alive = 0
        self.last: dict[int, CanFrame] = {}
        """If it is sent on change: the last frame of each group, with alive counter 0."""
        self.why = 0
        self.sent_ns = -NEVER
        self.cycle_due = first_cycle if plan.cycle_ns else NEVER
        self.deferred_until = NEVER
        self.is_cycle_deferred = False

    def may_go(self, now: int) -> bool:
        """Return True if the minimum delay time to its last frame is over."""
        return now >= self.sent_ns + self.plan.delay_ns

    def defer(self) -> None:
        """Delay it until its minimum delay time is over."""
        if self.deferred_until == NEVER:
            self.deferred_until = self.sent_ns + self.plan.delay_ns

    def take_due(self, now: int) -> tuple[int, int]:
        """Return the time at which it became due and the reasons, or NEVER and 0.

        A cycle within the minimum delay time is returned when that time is over. A late call skips
        missed cycles.
        """
        when = NEVER
        why = 0
        if self.deferred_until <= now:
            when = self.deferred_until
            why = _REQUEST
            if self.is_cycle_deferred:
                why |= _CYCLE
            self.deferred_until = NEVER
            self.is_cycle_deferred = False
        start = self.cycle_due
        if start <= now:
            cycle = self.plan.cycle_ns
            self.cycle_due += cycle * ((now - start) // cycle + 1)
            if self.may_go(now):
                return min(when, start), why | _CYCLE
            self.defer()
            self.is_cycle_deferred = True
        return when, why

    def schedule_place(self) -> SchedulePosition:
        """Return its place in the schedule."""
        deferred_until = -1 if self.deferred_until == NEVER else self.deferred_until
        return SchedulePosition(
            self.alive,
            self.place,
            max(-1, self.sent_ns),
            deferred_until,
            int(self.is_cycle_deferred),
        )

    def adopt(self, place: SchedulePosition) -> None:
        """Continue from this place."""
        self.alive = place.alive % max(1, self.alive_modulus)
        self.place = place.page % len(self.plan.pages)
        if place.sent_ns >= 0:
            self.sent_ns = place.sent_ns
        self.deferred_until = NEVER if place.deferred_until < 0 else place.deferred_until
        self.is_cycle_deferred = bool(place.cycle_deferred)

    def add_all_pages(self) -> None:
        """Send all groups, if there are several."""
        if self.is_paged:
            self.pages_to_send.update(range(len(self.plan.pages)))

    def turn_page(self) -> None:
        """Send the next group, if there are several."""
        if self.is_paged:
            self.pages_to_send.add(self.place)
            self.place = (self.place + 1) % len(self.plan.pages)


def own_ids(layout: MessageLayout) -> dict[int, Owner]:
    """Return the ids of the messages (with EXTENDED if they have 29 bits) and their owners."""
    owners = {}
    for plan in layout.messages:
        owners[plan.key] = Owner(None, f"message {plan.name}")
    return owners


class Messages:
    """All messages of one layout.

    While the telemetry of all ESCs of a message is lost, the message is sent with NotAvailable, or
    stops (``Traits.is_silent_on_loss``).
    """

    def __init__(
        self,
        settings: CoreSettings,
        escs: Sequence[EscTelemetry],
        gateway: GatewayStatus,
        now: int,
    ) -> None:
        layout = settings.layout
        self._escs = escs
        self._gateway = gateway
        first = phases([plan.cycle_ns for plan in layout.messages])
        self._messages: list[_Message] = []
        self._of_gateway: list[_Message] = []
        self._of_esc: list[list[_Message]] = [[] for _ in escs]
        self._timed: list[_Message] = []
        for index, plan in enumerate(layout.messages):
            message = _Message(index, plan, settings, now + first[index])
            self._messages.append(message)
            if message.follows_gateway:
                self._of_gateway.append(message)
            for esc in plan.escs:
                self._of_esc[esc].append(message)
            if not message.is_untimed:
                self._timed.append(message)
        self.pending: dict[int, int] = {}
        """Indices of the messages that ``take`` sends, and the times at which they became due."""
        self._is_last = False
        """True while nothing follows the pending messages, so all their groups are sent."""
        self._is_quiet = False

    @property
    def next_due(self) -> int:
        """The time at which ``advance`` must be called, or NEVER."""
        dues = [min(each.cycle_due, each.deferred_until) for each in self._timed]
        return min(dues, default=NEVER)

    # --- a replay that begins later in a run

    def places(self) -> list[SchedulePosition]:
        """Return the place of each message in its schedule."""
        return [message.schedule_place() for message in self._messages]

    def adopt_places(self, places: Sequence[Sequence[int]]) -> None:
        """Continue from these places."""
        for message, place in zip(self._messages, places, strict=False):
            message.adopt(SchedulePosition(*place))

    # --- what makes messages pending

    def on_event(self, esc: int, events: int, now: int) -> None:
        """Mark the messages that follow these events of an ESC (bits of telemetry.Event)."""
        if self._is_quiet:
            return
        state = self._escs[esc]
        is_live = state.live is not None
        # Live or info data have ended. No later event sends the remaining groups.
        has_ended = not is_live or (events & Event.INFO and state.info is None)
        for message in self._of_esc[esc]:
            if events & (message.live_triggers if is_live else message.triggers):
                if has_ended and message.by_event:
                    message.add_all_pages()
                self._request(message, now)

    def on_gateway_change(self, now: int, each_second: bool = False) -> None:
        """Mark the messages with the gateway's own state, which changed.

        With ``each_second`` only its counters changed, which matters for messages without a cycle.
        """
        if self._is_quiet:
            return
        for message in self._of_gateway:
            if not (each_second and message.plan.cycle_ns):
                self._request(message, now)

    def repeat(self, now: int) -> None:
        """Send every message without a cycle once.

        Receivers must not keep values from before a restart or an outage.
        """
        if self._is_quiet:
            return
        for message in self._messages:
            message.last.clear()
            if not message.plan.cycle_ns:
                message.add_all_pages()
                self._request(message, now)

    def stop(self, now: int) -> None:
        """Send the messages with the gateway's own state at once, all groups, at any distance."""
        if not self._is_quiet:
            self._send_last(now)

    def begin_quiet(self, now: int) -> None:
        """Send the messages with the gateway's own state at once, then nothing."""
        for index in self.pending:
            self._messages[index].why = 0
        self.pending = {}
        for message in self._messages:
            message.pages_to_send.clear()
        self._send_last(now)
        self._is_quiet = True

    def end_quiet(self, now: int) -> None:
        """Send everything again."""
        self._is_quiet = False
        self._is_last = False
        self.on_gateway_change(now)
        self.repeat(now)

    def _send_last(self, now: int) -> None:
        """Send the messages with the gateway's own state at once, all groups, at any distance."""
        self._is_last = True
        for message in self._of_gateway:
            if message.by_event:
                message.add_all_pages()
            self._mark_pending(message, now, _REQUEST)

    def advance(self, now: int) -> None:
        """Mark messages whose cycle or minimum delay time is over."""
        for message in self._timed:
            when, why = message.take_due(now)
            if why:
                self._mark_pending(message, when, why)

    def _request(self, message: _Message, now: int) -> None:
        """Send a message as soon as its minimum delay time allows."""
        if message.may_go(now):
            self._mark_pending(message, now, _REQUEST)
        elif self._note_news(message, now):
            message.defer()

    def _mark_pending(self, message: _Message, since: int, why: int) -> None:
        index = message.index
        earlier = self.pending.get(index, since)
        self.pending[index] = min(since, earlier)
        message.why |= why

    # --- frames

    def take(self, now: int, most: int | None = None) -> list[CanFrame]:
        """Return the frames of the pending messages, with the values of ``now``.

        At most ``most`` messages are taken, those that became due first.
        """
        frames: list[CanFrame] = []
        for index, _ in sorted(self.pending.items(), key=itemgetter(1, 0))[:most]:
            del self.pending[index]
            message = self._messages[index]
            why = message.why
            message.why = 0
            escs = message.plan.escs
            if message.is_silent_on_loss and not any(self._escs[esc].up for esc in escs):
                message.pages_to_send.clear()
                continue
            # A request sends the groups that have changed, the end of a cycle the next one.
            is_sent = bool(why & _REQUEST) and self._note_news(message, now)
            if why & _CYCLE:
                message.turn_page()
                is_sent = True
            if is_sent:
                frames.append(self._frame(message, now))
                while self._is_last and message.pages_to_send:
                    frames.append(self._frame(message, now))
        return frames

    @property
    def pending_since(self) -> int:
        """The time since which the oldest message is pending, or NEVER."""
        return min(self.pending.values(), default=NEVER)

    def _note_news(self, message: _Message, now: int) -> bool:
        """Return False if a message is sent on change and has not changed.

        Changed groups are added to ``pages_to_send``.
        """
        if message.by_event or not message.on_change:
            return True
        changed = []
        for place in range(len(message.plan.pages)):
            frame = message.frame(self._escs, self._gateway, now, 0, place)
            if frame != message.last.get(place):
                changed.append(place)
        if message.is_paged:
            message.pages_to_send.update(changed)
        return bool(changed or message.pages_to_send)

    def _frame(self, message: _Message, now: int) -> CanFrame:
        """Return the frame of the next group, and note that it was sent."""
        place = 0
        if message.is_paged:
            if not message.pages_to_send:
                message.turn_page()
            # The first group to send, counted from the one whose turn is next.
            count = len(message.plan.pages)
            distance = min([(each - message.place) % count for each in message.pages_to_send])
            place = (message.place + distance) % count
            message.pages_to_send.remove(place)
        frame = message.frame(self._escs, self._gateway, now, message.alive, place)
        if message.on_change:
            message.last[place] = message.frame(self._escs, self._gateway, now, 0, place)
        if message.alive_modulus:
            message.alive = (message.alive + 1) % message.alive_modulus
        message.sent_ns = now
        message.is_cycle_deferred = False
        message.deferred_until = NEVER
        if message.pages_to_send:
            message.deferred_until = now + max(message.plan.delay_ns, _MIN_DISTANCE_NS)
        return frame
