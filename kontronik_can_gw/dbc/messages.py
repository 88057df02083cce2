"""Plans, packers and schedule put together: telemetry events and time in, CAN frames out."""

from collections.abc import Iterator, Sequence

from kontronik_can_gw.dbc.schedule import Schedule
from kontronik_can_gw.esc.telemetry import EscTelemetry, Event
from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.frames import EXTENDED, CanFrame
from kontronik_can_gw.gateway_status import CanState, GatewayStatus
from kontronik_can_gw.output import Output, Owner
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

    ``last`` holds the bits of the last frame of each page, without alive counter and CRC; ``pending`` the places of the pages that
    have to follow without waiting for an event.
    """

    __slots__ = (
        "alive",
        "alive_modulus",
        "by_event",
        "can_id",
        "crc_at",
        "extended",
        "fd",
        "goes_at_once",
        "is_free",
        "is_paged",
        "is_plain",
        "last",
        "length",
        "on_change",
        "pack",
        "page",
        "pages",
        "pending",
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
        self.is_paged = plan.pages != (None,)
        # no cycle, no minimum distance, nothing that follows by itself: the schedule never has to know of it
        self.is_free = not (plan.cycle_ns or plan.delay_ns or self.is_paged)
        self.pack = compile_pack(plan)
        self.page = 0
        self.pending: list[int] = []
        self.alive = 0
        crc = next((signal for signal in plan.signals if signal.role is Role.CRC), None)
        alive = next((signal for signal in plan.signals if signal.role is Role.ALIVE), None)
        self.crc_at = None if crc is None else crc.pieces[0].at // 8
        self.alive_modulus = alive_modulus(alive, crc is not None) if alive else 0
        self.last: dict[int | None, int] = {}
        # messages with the link's state always go on
        self.silent_able = (
            silent and bool(plan.paces & {Group.LIVE, Group.INFO}) and Group.LINK not in plan.paces
        )
        self.by_event = SendType.EVENT in plan.send_type
        self.on_change = SendType.ON_CHANGE in plan.send_type
        self.goes_at_once = self.by_event and self.is_free
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


class Messages(Output):
    """All messages of one layout. Frames are appended to ``frames``, which the owner empties.

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
        super().__init__()
        self._escs = escs
        self._gateway = gateway
        self._messages = [_Message(plan, silent) for plan in layout.messages]
        self._of_gateway = [
            (i, m) for i, m in enumerate(self._messages) if Group.GATEWAY in m.plan.paces
        ]
        self._schedule = Schedule(layout.messages, now)
        self._listeners = [
            [
                [self._listeners_of(esc, up, events) for events in range(Event.ALL + 1)]
                for up in (False, True)
            ]
            for esc in range(len(escs))
        ]
        """The messages that follow: by ESC, whether its live data is fresh, and combination of events."""

    def _listeners_of(self, esc: int, up: bool, events: int) -> list[tuple[int, _Message]]:
        return [
            (i, m)
            for i, m in enumerate(self._messages)
            if esc in m.plan.escs and m.follows(events, up)
        ]

    def start(self, now: int, can_open: bool) -> None:  # noqa: ARG002
        self._send_all(now)

    def stop(self, now: int) -> None:
        """The last word, without regard to the minimum distance of messages."""
        for index, message in self._changed_of_gateway(now):
            self._send(index, message, now)
            while message.pending:
                self._send(index, message, now)

    def on_can_state(self, before: CanState, state: CanState, now: int) -> None:
        if state is before:
            return
        self.on_gateway_change(now)
        if before is CanState.BUS_OFF and state is not CanState.DOWN:
            self._send_all(now)  # what was handed over meanwhile never reached the bus

    def can_returned(self, now: int) -> None:
        self._send_all(now)

    def make_anew(self, now: int) -> None:
        self._send_all(now)

    def own_ids(self) -> dict[int, Owner]:
        return {
            message.can_id | (EXTENDED if message.extended else 0): Owner(
                None, f"message {message.plan.name}"
            )
            for message in self._messages
        }

    def _send_all(self, now: int) -> None:
        """Send every message that has no cycle once, so that nobody goes on with values from before a restart or an outage."""
        for index, message in enumerate(self._messages):
            message.last.clear()
            if not message.plan.cycle_ns:
                if not message.is_free:
                    message.pending = list(range(len(message.pages)))
                self._request(index, message, now)

    def bits(self, index: int, now: int, page: int | None) -> int:
        """What a message would hold now, alive counter and CRC 0."""
        return self._messages[index].pack(self._escs, self._gateway, now, 0, page or 0)

    def on_event(self, esc: int, events: int, now: int) -> None:
        """Something of an ESC changed: send, or note for later, the messages that follow it."""
        state = self._escs[esc]
        up = state.live is not None
        gone = not up or (events & Event.INFO and state.info is None)
        for index, message in self._listeners[esc][up][events]:
            if message.goes_at_once or self._may_go(index, message, bool(gone), now):
                self._send(index, message, now)

    def _may_go(self, index: int, message: _Message, gone: bool, now: int) -> bool:
        """Whether a message that follows an event is news and may be sent now. ``gone``: values that nothing will bring again."""
        if not message.by_event:
            if not self._note_changes(message, now):
                return False
        elif gone and message.is_paged:
            message.pending = list(range(len(message.pages)))  # no further event brings the others
        return message.is_free or self._schedule.request(index, now)

    def on_gateway_change(self, now: int, each_second: bool = False) -> None:
        """Messages with the gateway's own values that are sent by event or on change follow.

        ``each_second``: only its counters went on, which is news for messages that have no cycle.
        """
        for index, message in self._changed_of_gateway(now, each_second):
            self._request(index, message, now)

    def _changed_of_gateway(
        self, now: int, each_second: bool = False
    ) -> Iterator[tuple[int, _Message]]:
        for index, message in self._of_gateway:
            if each_second and message.plan.cycle_ns:
                continue
            if message.by_event or (message.on_change and self._note_changes(message, now)):
                yield index, message

    def advance(self, now: int) -> None:
        """Send what is due."""
        for index, cyclic in self._schedule.due(now):
            message = self._messages[index]
            if cyclic and len(message.pages) > 1:
                if message.page not in message.pending:
                    message.pending.append(message.page)
                message.page = (message.page + 1) % len(message.pages)
            if cyclic or message.by_event or message.pending or self._note_changes(message, now):
                self._send(index, message, now)

    def next_deadline(self) -> int:
        return self._schedule.next_deadline()

    def _request(self, index: int, message: _Message, now: int) -> None:
        if self._schedule.request(index, now):
            self._send(index, message, now)

    def _note_changes(self, message: _Message, now: int) -> bool:
        """True if a page differs from what was sent of it last; with several pages those that do are pending."""
        pack, last, pages = message.pack, message.last, message.plan.pages
        if len(pages) == 1:
            return pack(self._escs, self._gateway, now, 0, pages[0] or 0) != last.get(pages[0])
        changed = [
            place
            for place, page in enumerate(pages)
            if pack(self._escs, self._gateway, now, 0, page or 0) != last.get(page)
        ]
        message.pending += [place for place in changed if place not in message.pending]
        return bool(changed)

    def _send(self, index: int, message: _Message, now: int) -> None:
        if message.silent_able and not any(self._escs[esc].up for esc in message.plan.escs):
            message.pending.clear()
            return
        place = page = 0
        if message.is_paged:
            place = self._next_place(message)
            page = message.pages[place]
        bits = message.pack(self._escs, self._gateway, now, message.alive, page)
        data = bits.to_bytes(message.length, "little")
        if not message.is_plain:
            data = self._finish(message, data, place, now)
        self.frames.append(
            _new(
                CanFrame, (message.can_id, data, message.extended, message.fd, place, False, False)
            )
        )
        if not message.is_free:
            self._schedule.sent(index, now)
            if not message.is_paged:
                message.pending.clear()
            elif message.pending:
                self._schedule.wait(index, now)

    def _next_place(self, message: _Message) -> int:
        """The place of the page to send: the oldest pending one, else that whose turn it is."""
        if message.pending:
            return message.pending.pop(0)
        place = message.page
        message.page = (place + 1) % len(message.pages)
        return place

    def _finish(self, message: _Message, data: bytes, place: int, now: int) -> bytes:
        """The data with its CRC; the alive counter goes on, and what was sent is noted for a message that is sent on change."""
        if message.alive_modulus:
            message.alive = (message.alive + 1) % message.alive_modulus
        if message.on_change:
            message.last[message.plan.pages[place]] = message.pack(
                self._escs, self._gateway, now, 0, message.pages[place]
            )
        if message.crc_at is None:
            return data
        at = message.crc_at
        return data[:at] + bytes((e2e.crc(data, at, message.plan.data_id),)) + data[at + 1 :]
