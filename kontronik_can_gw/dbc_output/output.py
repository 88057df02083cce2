"""Plans, packers and schedule put together: telemetry events and time in, CAN frames out."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import groupby

from kontronik_can_gw.dbc_output import e2e
from kontronik_can_gw.dbc_output.layout import Layout, MessagePlan, Role, SendType, SignalPlan
from kontronik_can_gw.dbc_output.packer import SendLive, alive_modulus, compile_live, compile_pack
from kontronik_can_gw.dbc_output.schedule import Schedule
from kontronik_can_gw.frames import CanFrame, frame_of
from kontronik_can_gw.sources import GatewayStatus, Group, Source, sources
from kontronik_can_gw.telemetry import EscSettings, EscTelemetry, Event

_EVENT_OF_PACE = {Group.LIVE: Event.LIVE, Group.INFO: Event.INFO, Group.LINK: Event.LINK, Group.GATEWAY: Event.NONE}


class _Message:
    """One message at work.

    ``last`` holds the bits of the last frame of each page, without alive counter and CRC; ``owed`` the places of the pages that
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
        "follows_live",
        "is_plain",
        "last",
        "length",
        "on_change",
        "owed",
        "pack",
        "page",
        "plan",
        "silent_able",
        "triggers",
    )

    def __init__(self, plan: MessagePlan, silent: bool) -> None:
        self.plan = plan
        self.can_id, self.length, self.extended, self.fd = plan.can_id, plan.length, plan.extended, plan.fd
        self.pack = compile_pack(plan)
        self.page = 0
        self.owed: list[int] = []
        self.alive = 0
        crc = next((signal for signal in plan.signals if signal.role is Role.CRC), None)
        alive = next((signal for signal in plan.signals if signal.role is Role.ALIVE), None)
        self.crc_at = None if crc is None else crc.pieces[0].at // 8
        self.alive_modulus = alive_modulus(alive, crc is not None) if alive else 1
        self.last: dict[int | None, int] = {}
        # what also tells of the link always goes on
        self.silent_able = silent and bool(plan.paces & {Group.LIVE, Group.INFO}) and Group.LINK not in plan.paces
        self.by_event = SendType.EVENT in plan.send_type
        self.on_change = SendType.ON_CHANGE in plan.send_type
        # its frame is its pack and nothing else
        self.is_plain = plan.pages == (None,) and not (self.silent_able or self.on_change or crc)
        # and nothing but the minimum distance keeps it back when there is a live frame
        self.follows_live = self.by_event and plan.pages == (None,) and not (self.on_change or crc)
        self.triggers = Event.NONE
        if self.by_event or self.on_change:
            for pace in plan.paces:
                self.triggers |= _EVENT_OF_PACE[pace]
            if self.triggers & Event.LINK and not plan.cycle_ns and not (self.by_event and self.triggers & Event.LIVE):
                self.triggers |= Event.SECOND  # counters, rates and ages change all the time


class DbcOutput:
    """All messages of one layout. Frames are appended to ``frames``, which the owner empties.

    ``silent``: on loss of telemetry messages with values of a lost ESC stop instead of carrying NotAvailable.
    """

    def __init__(
        self, layout: Layout, escs: Sequence[EscTelemetry], gateway: GatewayStatus, now: int, silent: bool = False
    ) -> None:
        self.frames: list[CanFrame | bytes] = []
        self._touched: set[int] = set()
        """ESCs of which something was sent since the frames were taken."""
        self._images_end = False
        """No more images until the frames are taken."""
        self._escs = escs
        self._gateway = gateway
        self._messages = [_Message(plan, silent) for plan in layout.messages]
        self._of_gateway = [(i, m) for i, m in enumerate(self._messages) if Group.GATEWAY in m.plan.paces]
        self._schedule = Schedule(layout.messages, now)
        self._listeners: list[list[tuple[int, _Message]]] = [[] for _ in escs]
        for index, message in enumerate(self._messages):
            for esc in message.plan.escs:
                if message.triggers:
                    self._listeners[esc].append((index, message))
        self._live_steps = [self._steps_of_live(esc) for esc in range(len(escs))]
        """What follows each live frame of an ESC, in order."""

    def _steps_of_live(self, esc: int) -> list[SendLive]:
        steps: list[SendLive] = []
        listeners = [(i, m) for i, m in self._listeners[esc] if m.triggers & Event.LIVE]
        for is_plain, group in groupby(listeners, lambda one: one[1].follows_live):
            if is_plain:
                steps.append(self._compile_live(esc, dict(group)))
            else:
                steps += [partial(self._on_live, index, message) for index, message in group]
        return steps

    def _compile_live(self, esc: int, messages: Mapping[int, _Message]) -> SendLive:
        schedule = self._schedule
        names: dict[str, object] = {f"m{index}": message for index, message in messages.items()}
        names |= {"escs": self._escs, "gateway": self._gateway, "request": schedule.request}
        names |= {"last": schedule.last, "waiting": schedule.waiting, "cycle_waits": schedule.cycle_waits}
        return compile_live({index: message.plan for index, message in messages.items()}, esc, names)

    def start(self, now: int) -> None:
        """Send every message that has no cycle once, so that nobody goes on with values from before a restart or an outage."""
        self._end_images()
        for index, message in enumerate(self._messages):
            message.last.clear()
            if not message.plan.cycle_ns:
                message.owed = list(range(len(message.plan.pages)))
                self._request(index, now)

    def apply(self, esc: int, settings: EscSettings) -> None:
        """Other pole pairs or gear of an ESC: the plans with values that depend on them are compiled anew."""
        known = sources(settings)
        for message in self._messages:
            signals = tuple(
                _rescaled(signal, known) if signal.esc == esc else signal for signal in message.plan.signals
            )
            if signals != message.plan.signals:
                message.plan = replace(message.plan, signals=signals)
                message.pack = compile_pack(message.plan)
        self._live_steps = [self._steps_of_live(each) for each in range(len(self._escs))]

    def bits(self, index: int, now: int, page: int | None) -> int:
        """What a message would hold now, alive counter and CRC 0."""
        return self._messages[index].pack(self._escs, self._gateway, now, 0, page or 0)

    def on_live(self, esc: int, now: int) -> None:
        """A live frame has come, and nothing else is new."""
        touched = self._touched
        if esc in touched:
            self._end_images()
        else:
            touched.add(esc)
        append = self._append_plain if self._images_end else self.frames.append
        for step in self._live_steps[esc]:
            step(now, append)

    def _append_plain(self, frame: CanFrame | bytes) -> None:
        self.frames.append(frame_of(frame))

    def on_event(self, esc: int, events: int, now: int) -> None:
        """Something of an ESC changed: send, or note for later, the messages that follow it."""
        state = self._escs[esc]
        if esc in self._touched:
            self._end_images()
        self._touched.add(esc)
        for index, message in self._listeners[esc]:
            triggers = message.triggers
            if not triggers & events:
                continue
            if message.by_event:
                if triggers & Event.LIVE and triggers & events == Event.LINK and state.up:
                    continue  # live frames set the pace
                gone = not state.up or (events & Event.INFO and state.info is None)
                if gone and len(message.plan.pages) > 1:  # no further event will bring the other pages
                    message.owed = list(range(len(message.plan.pages)))
                self._request(index, now)
            elif self._note_changes(message, now):
                self._request(index, now)

    def _on_live(self, index: int, message: _Message, now: int, _append: object) -> None:
        if message.by_event or self._note_changes(message, now):
            self._request(index, now)

    def on_gateway_change(self, now: int, at_once: bool = False, each_second: bool = False) -> None:
        """The gateway's own state changed: messages with its values that are sent by event or on change follow.

        ``at_once``: without regard to their minimum distance, for the last word. ``each_second``: only its counters went on,
        which is news for messages that have no cycle.
        """
        for index, message in self._of_gateway:
            if each_second and message.plan.cycle_ns:
                continue
            if message.by_event or (message.on_change and self._note_changes(message, now)):
                if at_once:
                    self._send(index, now)
                    while message.owed:
                        self._send(index, now)
                else:
                    self._request(index, now)

    def advance(self, now: int) -> None:
        """Send what is due."""
        heap = self._schedule.heap
        if not heap or now < heap[0][0]:
            return
        for index, cyclic in self._schedule.due(now):
            message = self._messages[index]
            if cyclic and len(message.plan.pages) > 1:
                if message.page not in message.owed:
                    message.owed.append(message.page)
                message.page = (message.page + 1) % len(message.plan.pages)
            if cyclic or message.by_event or message.owed or self._note_changes(message, now):
                self._send(index, now)

    def take(self) -> list[CanFrame | bytes]:
        """The frames so far, images among them; the list is handed over."""
        self._touched.clear()
        self._images_end = False
        frames = self.frames
        if not frames:
            return []
        self.frames = []
        return frames

    def _end_images(self) -> None:
        """What comes now may have the ids of images that wait: from now on they are frames as others."""
        if not self._images_end:
            self._images_end = True
            self.frames = [frame_of(frame) for frame in self.frames]

    def next_deadline(self) -> int | None:
        """When ``advance`` has something to do."""
        return self._schedule.next_deadline()

    def _request(self, index: int, now: int) -> None:
        if self._schedule.request(index, now):
            self._send(index, now)

    def _note_changes(self, message: _Message, now: int) -> bool:
        """True if a page differs from what was sent of it last; with several pages those that do are owed."""
        pack, last = message.pack, message.last
        pages = message.plan.pages
        if len(pages) == 1:
            page = pages[0]
            return pack(self._escs, self._gateway, now, 0, page or 0) != last.get(page)
        changed = [
            place
            for place, page in enumerate(pages)
            if pack(self._escs, self._gateway, now, 0, page or 0) != last.get(page)
        ]
        message.owed += [place for place in changed if place not in message.owed]
        return bool(changed)

    def _send(self, index: int, now: int) -> None:
        message = self._messages[index]
        self._touched |= message.plan.escs
        if message.is_plain:
            message.owed.clear()
            bits = message.pack(self._escs, self._gateway, now, message.alive, 0)
            message.alive = (message.alive + 1) % message.alive_modulus
            data = bits.to_bytes(message.length, "little")
            self.frames.append(CanFrame(message.can_id, data, message.extended, message.fd))
            self._schedule.sent(index, now)
            return
        plan = message.plan
        if message.silent_able and not any(self._escs[esc].up for esc in plan.escs):
            message.owed.clear()
            return
        if message.owed:
            place = message.owed.pop(0)
        else:
            place = message.page
            message.page = (place + 1) % len(plan.pages)
        page = plan.pages[place]
        pack = message.pack
        bits = pack(self._escs, self._gateway, now, message.alive, page or 0)
        if message.on_change:
            message.last[page] = pack(self._escs, self._gateway, now, 0, page or 0)
        message.alive = (message.alive + 1) % message.alive_modulus
        data = bits.to_bytes(plan.length, "little")
        if message.crc_at is not None:
            at = message.crc_at
            data = data[:at] + bytes((e2e.crc(data, at, plan.data_id),)) + data[at + 1 :]
        self.frames.append(CanFrame(plan.can_id, data, plan.extended, plan.fd, place))
        self._schedule.sent(index, now)
        if message.owed:
            self._schedule.wait(index, now)


def _rescaled(signal: SignalPlan, known: Mapping[str, Source]) -> SignalPlan:
    old = signal.source
    if old is None or (new := known[old.name]).per_unit == old.per_unit:
        return signal
    return replace(signal, source=new, slope=signal.slope * old.per_unit / new.per_unit)
