"""Slots of the core: frames that an output sets up, changes and stops while the core runs, as a CANopen node its transmit PDOs.

What makes a slot's frame pending: events of its ESC, its timer (which each frame sent restarts), its owner. It is packed when it is handed
over, so the newest wins; the inhibit time is the minimum distance between two. A slot with ``watched`` bits is made pending by events that
change these only. Slots are handed over before the messages of the layout, in the order in which they became due. Slots that became due
at the same time are ordered by their ``place``.

A paced slot is a measurement at a rate. It goes with the first event after its inhibit time, else by its timer; its distance is the mean of
both on average. It rests while the first of its signals is not available. A slot with a ``seed`` is a transfer (signals/transfer.py):
slots of one id number theirs together.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import NamedTuple, Protocol

from kontronik_can_gw.esc.telemetry import EscTelemetry, Event
from kontronik_can_gw.esc.values import divisor, steps
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.signals.packer import Pack
from kontronik_can_gw.signals.plan import MessagePlan
from kontronik_can_gw.signals.transfer import TRANSFER_ID, transfer
from kontronik_can_gw.status import GatewayStatus
from kontronik_can_gw.times import NEVER


@dataclass(frozen=True, slots=True, eq=False)
class SlotPlan:
    """How a slot is filled and what causes it. ESC 0 of the plan is the slot's."""

    message: MessagePlan
    """Of up to 64 bits, but for a transfer. Its id and send type do not matter."""
    pack: Pack
    triggers: int
    """The events (of telemetry.Event) that are news to it."""
    watched: int
    """Bits of which only a change is news; 0: any event of ``triggers`` is."""
    pack_watched: Pack | None
    """Only what is in ``watched``."""
    needs_live: bool
    """It is not sent while telemetry is lost."""
    only_python: str = ""
    """What in it no core in C can know; empty else."""
    seed: int | None = None
    """It is a transfer of up to 16 bytes, and what its CRC begins with; None: a frame."""
    paced: bool = False


class SlotSettings(NamedTuple):
    """What a slot sends, and when."""

    plan: SlotPlan
    can_id: int
    """11 bits; of a transfer 29."""
    by_event: bool
    """Events and the timer make it pending; else only ``Slot.send`` does."""
    inhibit_ns: int
    timer_ns: int
    """It is sent this long after its last frame at the latest; 0: never for that reason."""
    fill: int = 0
    """Bits that the owner fills, besides those of the plan."""
    page: int = 0
    """Of its frame (frames.CanFrame), of a transfer of the first one."""


class Slot(Protocol):
    """A slot, as its owner sees it. At first it is stopped and has no settings."""

    @property
    def sent(self) -> int:
        """Frames so far."""

    @property
    def is_news(self) -> bool:
        """True if what is in it has changed since its last frame."""

    @property
    def is_pending(self) -> bool:
        """True if a frame is going to be handed over with the next ``take``."""

    def configure(self, settings: SlotSettings | None, now: int) -> None:
        """Other settings, or none. A slot that is given some while it is started begins as at its start."""

    def start(self, now: int) -> None:
        """Send from now on, at once for the first time where it is sent by event."""

    def stop(self) -> None:
        """Send nothing any more."""

    def news(self, now: int) -> None:
        """What is in it has changed without an event of the ESC."""

    def send(self, now: int) -> None:
        """Let it be handed over, whatever its inhibit time is."""


Place = tuple[int, int]
"""Index of the ESC, and number of the slot among this ESC's slots."""


class PendingSlot(NamedTuple):
    """A slot that was pending, with the frames to hand over."""

    since: int
    place: Place
    frames: list[CanFrame]


class PythonSlot:
    """A slot in plain Python."""

    def __init__(self, owner: "Slots", place: Place) -> None:
        esc = place[0]
        self.place = place
        self.sent = 0
        self.is_news = False
        self.due = NEVER
        """When ``advance`` has something to do."""
        self.triggers = 0
        """The events that it is to be given."""
        self.can_id = self.transfer_id = 0
        """Of the transfers of this id, if it is the first slot of it."""
        self._owner = owner
        self._esc = esc
        self._escs = (owner.escs[esc],)
        self._settings: SlotSettings | None = None
        self._started = False
        self._last_ns = -NEVER
        self._last_watched = -1
        self._timer_due = self._deferred_until = NEVER

    @property
    def is_pending(self) -> bool:
        return self.place in self._owner.pending

    def configure(self, settings: SlotSettings | None, now: int) -> None:
        before, self._settings = self._settings, settings
        if settings is not None:
            self.can_id = settings.can_id
        if not self._started:
            return
        if settings is None:
            self._rest()
        elif before is None:
            self.start(now)
        else:
            self.triggers = settings.plan.triggers
            if not settings.by_event:
                self._deferred_until = NEVER
            self._restart_timer(settings, now)
            self._set_due()

    def start(self, now: int) -> None:
        self._rest()
        self._started = True
        self._last_ns = -NEVER
        self._last_watched = -1
        if (settings := self._settings) is not None:
            self.triggers = settings.plan.triggers
            self._restart_timer(settings, now)
            self.news(now)
        self._set_due()

    def stop(self) -> None:
        self._started = False
        self._rest()

    def news(self, now: int) -> None:
        settings = self._settings
        if not self._started or settings is None:
            return
        self.is_news = True
        if not settings.by_event or self.place in self._owner.pending:
            return
        if now >= (until := self._last_ns + settings.inhibit_ns):
            self._deferred_until = NEVER
            self._owner.let_go(self, now)
        elif self._deferred_until == NEVER and not settings.plan.paced:
            self._deferred_until = until
        self._set_due()

    def send(self, now: int) -> None:
        if self._started and self._settings is not None:
            self._owner.let_go(self, now)

    def on_event(self, now: int) -> None:
        """An event of ``triggers`` happened."""
        if (settings := self._settings) is None or self.place in self._owner.pending:
            return
        if self._deferred_until == NEVER and (pack := settings.plan.pack_watched) is not None:
            watched = pack(self._escs, self._owner.status, now, 0, 0)
            if watched == self._last_watched:
                return
            self._last_watched = watched
        self.news(now)

    def advance(self, now: int) -> None:
        """The timer, or what the inhibit time held back: one of them is due."""
        if now >= self._timer_due:
            assert self._settings is not None
            self._restart_timer(self._settings, now)
        self._deferred_until = NEVER
        self.news(now)
        self._set_due()

    def frames(self, now: int) -> list[CanFrame]:
        """What is handed over now; nothing while it needs live data and there is none."""
        settings, escs = self._settings, self._escs
        assert settings is not None
        plan = settings.plan
        if plan.paced and not self._is_known(plan):
            self._last_ns, self._timer_due = -NEVER, NEVER
            self._set_due()
            return []
        if plan.needs_live and escs[0].live is None:
            return []
        self.is_news = False
        self._last_ns = self._moment(settings, now) if plan.paced else now
        self._deferred_until = NEVER
        self._restart_timer(settings, self._last_ns)
        self._set_due()
        bits = plan.pack(escs, self._owner.status, now, 0, 0) | settings.fill
        self._last_watched = bits & plan.watched
        self.sent += 1
        data = bits.to_bytes(plan.message.length, "little")
        if plan.seed is None:
            return [CanFrame(settings.can_id, data, page=settings.page)]
        first = self._owner.first_of(settings.can_id)
        number, first.transfer_id = first.transfer_id, first.transfer_id + 1 & TRANSFER_ID
        return transfer(settings.can_id, plan.seed, data, number, page=settings.page)

    def _is_known(self, plan: SlotPlan) -> bool:
        source, esc = plan.message.signals[0].source, self._escs[0]
        assert source is not None
        found = steps(source, esc, self._owner.status, 0)
        return found is not None and divisor(source, esc) is not None

    def _moment(self, settings: SlotSettings, now: int) -> int:
        """When a paced frame that goes now was to go: from there on its pace is kept, unless it was lost."""
        period = (settings.inhibit_ns + settings.timer_ns) // 2
        planned = self._last_ns + period
        return planned if planned - period < now < planned + period else now

    def _restart_timer(self, settings: SlotSettings, now: int) -> None:
        runs = settings.timer_ns and settings.by_event
        self._timer_due = now + settings.timer_ns if runs else NEVER

    def _rest(self) -> None:
        """Nothing is due."""
        self.triggers = 0
        self.is_news = False
        self._timer_due = self._deferred_until = NEVER
        self._owner.pending.pop(self.place, None)
        self._set_due()

    def _set_due(self) -> None:
        due = min(self._timer_due, self._deferred_until)
        if due != self.due:
            self.due = due
            self._owner.moved.add(self._esc)


class Slots:
    """All slots of a core."""

    def __init__(self, escs: Sequence[EscTelemetry], status: GatewayStatus) -> None:
        self.escs = escs
        self.status = status
        self.pending: dict[Place, int] = {}
        """The slots that ``take`` hands over, and the time since when each is pending."""
        self.moved: set[int] = set()
        """ESCs with slots of which ``due`` changed."""
        self._of: list[list[PythonSlot]] = [[] for _ in escs]
        self._due = [NEVER] * len(escs)

    def add(self, esc: int) -> PythonSlot:
        """Adds a slot of an ESC."""
        slots = self._of[esc]
        slot = PythonSlot(self, (esc, len(slots)))
        slots.append(slot)
        return slot

    def first_of(self, can_id: int) -> PythonSlot:
        """The slot that numbers the transfers of an id."""
        return next(slot for slots in self._of for slot in slots if slot.can_id == can_id)

    @property
    def triggers(self) -> int:
        """The events that ``on_event`` is to be given."""
        found = Event.NONE
        for slots in self._of:
            for slot in slots:
                found |= slot.triggers
        return found

    def on_event(self, esc: int, events: int, now: int) -> None:
        """Something of an ESC changed: bits of telemetry.Event."""
        for slot in self._of[esc]:
            if events & slot.triggers:
                slot.on_event(now)

    def let_go(self, slot: PythonSlot, now: int) -> None:
        """Let a slot be handed over."""
        self.pending.setdefault(slot.place, now)

    def next_deadline(self) -> int:
        """When ``advance`` has something to do."""
        while self.moved:
            esc = self.moved.pop()
            self._due[esc] = min([slot.due for slot in self._of[esc]])
        return min(self._due)

    def advance(self, now: int) -> None:
        """Let time pass."""
        if now < self.next_deadline():
            return
        for slots, due in zip(self._of, self._due, strict=True):
            if now >= due:
                for slot in slots:
                    if now >= slot.due:
                        slot.advance(now)

    @property
    def is_pending(self) -> bool:
        """True while ``take`` has something to do."""
        return bool(self.pending)

    def take(self, now: int) -> list[CanFrame]:
        """The frames of pending slots, in their order."""
        frames: list[CanFrame] = []
        for slot in self.take_each(now):
            frames += slot.frames
        return frames

    def take_each(self, now: int) -> list[PendingSlot]:
        """The pending slots in their order, each with its frames."""
        if not self.pending:
            return []
        pending, self.pending = self.pending, {}
        return [
            PendingSlot(since, (esc, number), self._of[esc][number].frames(now))
            for (esc, number), since in sorted(pending.items(), key=itemgetter(1, 0))
        ]
