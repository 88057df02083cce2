"""The messages of a layout: what makes each of them pending, and its frame when it is handed over.

Pure: ``on_event`` and time (``advance``) mark messages as pending, ``take`` packs what is pending: newest wins. A message is handed
over at most once in a step: in the order of the times at which the messages became due, then of their index.
"""

from collections.abc import Sequence

from kontronik_can_gw.dbc.schedule import CYCLE, REQUEST, Schedule
from kontronik_can_gw.esc.telemetry import EscTelemetry, Event
from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.frames import EXTENDED, CanFrame
from kontronik_can_gw.gateway_status import GatewayStatus
from kontronik_can_gw.output import Owner
from kontronik_can_gw.signals import e2e
from kontronik_can_gw.signals.packer import alive_modulus, compile_pack
from kontronik_can_gw.signals.plan import Layout, MessagePlan, Role, SendType

_new = tuple.__new__
_EVENT_OF_PACE = {
    Group.LIVE: Event.LIVE,
    Group.INFO: Event.INFO,
    Group.LINK: Event.LINK,
    Group.GATEWAY: Event.NONE,
}


class _Message:
    """One message at work.

    ``last`` holds the bits of the last frame of each page, without alive counter and CRC, of a message that is sent on change;
    ``pages_to_send`` the places of the pages that have to follow without waiting for an event.
    """

    __slots__ = (
        "alive",
        "alive_modulus",
        "by_event",
        "can_id",
        "crc_at",
        "extended",
        "fd",
        "is_free",
        "is_paged",
        "is_plain",
        "last",
        "length",
        "on_change",
        "pack",
        "page",
        "pages",
        "pages_to_send",
        "plan",
        "silent_able",
        "triggers",
    )

    def __init__(self, plan: MessagePlan, silent: bool) -> None:
        self.plan = plan
        self.can_id, self.length, self.extended, self.fd = (
            plan.can_id,
            plan.length,
            plan.extended,
            plan.fd,
        )
        self.pages = [page or 0 for page in plan.pages]
        self.is_paged = len(plan.pages) > 1
        # no cycle, no minimum distance, nothing that follows by itself: the schedule never has to know of it
        self.is_free = not (plan.cycle_ns or plan.delay_ns or self.is_paged)
        self.pack = compile_pack(plan)
        self.page = 0
        self.pages_to_send: set[int] = set()
        self.alive = 0
        crc = next((signal for signal in plan.signals if signal.role is Role.CRC), None)
        alive = next((signal for signal in plan.signals if signal.role is Role.ALIVE), None)
        self.crc_at = None if crc is None else crc.pieces[0].at // 8
        self.alive_modulus = alive_modulus(alive, crc is not None) if alive else 0
        self.last: dict[int, int] = {}
        # messages with the link's state always go on
        self.silent_able = (
            silent and bool(plan.paces & {Group.LIVE, Group.INFO}) and Group.LINK not in plan.paces
        )
        self.by_event = SendType.EVENT in plan.send_type
        self.on_change = SendType.ON_CHANGE in plan.send_type
        # sending it leaves nothing to note, and its bits are its data
        self.is_plain = not self.on_change and not self.alive_modulus and self.crc_at is None
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

    def follows(self, events: int, up: bool) -> bool:
        """Whether these events of an ESC are news to it. ``up``: the ESC's live data is fresh."""
        if up and self.by_event and self.triggers & Event.LIVE:  # live frames set the pace
            events &= ~Event.LINK
        return bool(self.triggers & events)

    def add_all_pages(self) -> None:
        """Let all pages follow, of a message that has several."""
        if self.is_paged:
            self.pages_to_send.update(range(len(self.pages)))

    def turn_page(self) -> None:
        """Let the page follow whose turn it is."""
        self.pages_to_send.add(self.page)
        self.page = (self.page + 1) % len(self.pages)

    def take_place(self) -> int:
        """The place of the page to send: the first of those that are to follow, from the one on whose turn it is next."""
        if not self.pages_to_send:
            self.turn_page()
        count = len(self.pages)
        place = next(
            n for n in range(self.page, self.page + count) if n % count in self.pages_to_send
        )
        self.pages_to_send.remove(place % count)
        return place % count


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
        self._messages = [_Message(plan, silent) for plan in layout.messages]
        self._of_gateway = [
            (i, m)
            for i, m in enumerate(self._messages)
            if Group.GATEWAY in m.plan.paces and (m.by_event or m.on_change)
        ]
        self._schedule = Schedule(layout.messages, now)
        self._pending: dict[int, tuple[int, int, int]] = {}
        """By message: (since when, message, CYCLE: it is sent in any case, REQUEST: where it is news)."""
        self._listeners = [
            [
                [self._listeners_of(esc, up, events) for events in range(Event.ALL + 1)]
                for up in (False, True)
            ]
            for esc in range(len(escs))
        ]
        """The messages that follow: by ESC, whether its live data is fresh, and combination of events."""
        self._stopping = False

    def _listeners_of(self, esc: int, up: bool, events: int) -> list[tuple[int, _Message]]:
        return [
            (i, m)
            for i, m in enumerate(self._messages)
            if esc in m.plan.escs and m.follows(events, up)
        ]

    # --- what makes messages pending

    def on_event(self, esc: int, events: int, now: int) -> None:
        """Something of an ESC changed: bits of telemetry.Event."""
        state, pending = self._escs[esc], self._pending
        up = state.live is not None
        gone = not up or (events & Event.INFO and state.info is None)
        for index, message in self._listeners[esc][up][events]:
            if gone and message.is_paged and message.by_event:
                message.add_all_pages()  # no further event brings the others
            if index not in pending:
                if message.is_free:
                    pending[index] = (now, index, REQUEST)
                else:
                    self._request(index, now)

    def on_gateway_change(self, now: int, each_second: bool = False) -> None:
        """The gateway's own state changed; ``each_second``: only its counters, which is news for messages that have no cycle."""
        for index, message in self._of_gateway:
            if not (each_second and message.plan.cycle_ns):
                self._request(index, now)

    def repeat(self, now: int) -> None:
        """Send every message that has no cycle once, so that nobody goes on with values from before a restart or an outage."""
        for index, message in enumerate(self._messages):
            message.last.clear()
            if not message.plan.cycle_ns:
                message.add_all_pages()
                self._request(index, now)

    def stop(self, now: int) -> None:
        """What the gateway says of itself goes out once more, all pages at once, without regard to minimum distances."""
        self._stopping = True
        for index, message in self._of_gateway:
            if message.by_event:
                message.add_all_pages()
            self._pending[index] = (now, index, REQUEST)

    def advance(self, now: int) -> None:
        """Let time pass: cycles, and what a minimum distance has put off."""
        for when, index, why in self._schedule.due(now):
            since, _, before = self._pending.get(index, (when, index, 0))
            self._pending[index] = (min(since, when), index, before | why)

    def next_deadline(self) -> int:
        """When ``advance`` has something to do."""
        return self._schedule.next_deadline()

    @property
    def is_pending(self) -> bool:
        """True while ``take`` has something to do."""
        return bool(self._pending)

    def _request(self, index: int, now: int) -> None:
        """Let a message be handed over as soon as its minimum distance allows."""
        if self._schedule.may_go(index, now):
            self._pending.setdefault(index, (now, index, REQUEST))
        elif self._is_news(self._messages[index], now):
            self._schedule.defer(index)

    # --- frames

    def take(self, now: int) -> list[CanFrame]:
        """The frames of what is pending, as they are now."""
        if not self._pending:
            return []
        pending, self._pending = sorted(self._pending.values()), {}
        frames: list[CanFrame] = []
        for _, index, why in pending:
            message = self._messages[index]
            if message.silent_able and not any(self._escs[esc].up for esc in message.plan.escs):
                message.pages_to_send.clear()
            elif (why & REQUEST and self._is_news(message, now)) or why & CYCLE:
                if why & CYCLE and message.is_paged:
                    message.turn_page()
                frames.append(self._frame(index, message, now))
                while self._stopping and message.pages_to_send:
                    frames.append(self._frame(index, message, now))
        return frames

    def _is_news(self, message: _Message, now: int) -> bool:
        """False for a message that is sent on change and has not changed; of several pages those that have follow."""
        if message.by_event or not message.on_change:
            return True
        pack, last = message.pack, message.last
        changed = [
            place
            for place, page in enumerate(message.pages)
            if pack(self._escs, self._gateway, now, 0, page) != last.get(page)
        ]
        if message.is_paged:
            message.pages_to_send.update(changed)
        return bool(changed or message.pages_to_send)

    def _frame(self, index: int, message: _Message, now: int) -> CanFrame:
        place = message.take_place() if message.is_paged else 0
        page = message.pages[place]
        bits = message.pack(self._escs, self._gateway, now, message.alive, page)
        data = bits.to_bytes(message.length, "little")
        if not message.is_plain:
            data = self._finish(message, data, page, now)
        if not message.is_free:
            self._schedule.sent(index, now)
            if message.pages_to_send:
                self._schedule.wait(index, now)
        return _new(
            CanFrame, (message.can_id, data, message.extended, message.fd, place, False, False)
        )

    def _finish(self, message: _Message, data: bytes, page: int, now: int) -> bytes:
        """The data with its CRC; the alive counter goes on, and what was sent is noted for a message that is sent on change."""
        if message.alive_modulus:
            message.alive = (message.alive + 1) % message.alive_modulus
        if message.on_change:
            message.last[page] = message.pack(self._escs, self._gateway, now, 0, page)
        if message.crc_at is None:
            return data
        at = message.crc_at
        return data[:at] + bytes((e2e.crc(data, at, message.plan.data_id),)) + data[at + 1 :]
