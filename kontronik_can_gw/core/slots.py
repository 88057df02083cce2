"""Slots of the core: frames that an output configures, starts and stops while the core runs.

For example, each transmit PDO of a CANopen node is a slot (twin: native/core.c).

A slot becomes pending by events of its ESC, by its timer, which every frame restarts, or by its
owner. It is packed when it is sent, so the newest value wins. The inhibit time is the minimum
distance between two frames. A slot with ``watched`` bits becomes pending only by events that change
these bits. Slots are sent before the messages of the layout, in the order in which they became due,
then in the order of their ``place``.

A paced slot sends a measurement at a rate. It is sent with the first event after its inhibit time,
or by its timer if there is no event. So the average distance is the mean of inhibit time and timer.
It pauses while its first signal is not available.

A slot with a ``seed`` sends transfers (signals/transfer.py). Slots with the same id share one
transfer ID.
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
    """The values of a slot and the events that cause it. ESC 0 of the plan is the slot's ESC."""

    message: MessagePlan
    """The signals, in up to 64 bits or, for a transfer, 16 bytes. Id and send type are not used."""
    pack: Pack
    triggers: int
    """The events (bits of telemetry.Event) that cause it."""
    watched: int = 0
    """If it is not 0, an event causes the slot only if it changes one of these bits."""
    needs_live: bool = False
    """It is not sent while telemetry is lost."""
    only_python: str = ""
    """The part of it that a core in C cannot express, or an empty string."""
    seed: int | None = None
    """The initial value of the CRC of a transfer of up to 16 bytes, or None for a frame."""
    is_paced: bool = False


class SlotSettings(NamedTuple):
    """The frames of a slot, and their times."""

    plan: SlotPlan
    can_id: int
    """11 bits, or 29 bits of a transfer."""
    by_event: bool
    """True if events and the timer cause it, False if only ``Slot.send`` does."""
    inhibit_ns: int
    timer_ns: int
    """The longest time after its last frame, in ns, or 0 for no timer."""
    fill: int = 0
    """Bits that the owner sets in addition to the signals of the plan."""
    page: int = 0
    """Group of its frame (frames.CanFrame), or of the first frame of a transfer."""


class Slot(Protocol):
    """The interface of a slot for its owner. At first it is stopped and has no settings."""

    @property
    def sent(self) -> int:
        """The number of frames sent."""

    @property
    def is_news(self) -> bool:
        """True if its content has changed since its last frame."""

    @property
    def is_pending(self) -> bool:
        """True if the next ``take`` sends a frame."""

    def configure(self, settings: SlotSettings | None, now: int) -> None:
        """Change the settings, or remove them.

        A started slot that had no settings begins as in ``start``.
        """

    def start(self, now: int) -> None:
        """Send from now on. If events cause the slot, send the first frame at once."""

    def stop(self) -> None:
        """Stop sending."""

    def news(self, now: int) -> None:
        """Note that its content has changed without an event of the ESC."""

    def send(self, now: int) -> None:
        """Send a frame without regard to the inhibit time."""


SlotKey = tuple[int, int]
"""Index of the ESC, and number of the slot among this ESC's slots."""


class PendingSlot(NamedTuple):
    """A slot that was pending, with the frames to send."""

    since: int
    place: SlotKey
    frames: list[CanFrame]


class PythonSlot:
    """A slot in plain Python."""

    def __init__(self, owner: "Slots", place: SlotKey) -> None:
        esc = place[0]
        self.place = place
        self.sent = 0
        self.is_news = False
        self.due = NEVER
        """The time at which ``advance`` must be called."""
        self.triggers = 0
        """The events for which ``on_event`` must be called."""
        self.can_id = 0
        self.transfer_id = 0
        """The next transfer ID of this id, in the first slot with it."""
        self._owner = owner
        self._esc = esc
        self._escs = (owner.escs[esc],)
        self._settings: SlotSettings | None = None
        self._is_started = False
        self._last_ns = -NEVER
        self._last_watched = -1
        self._timer_due = self._deferred_until = NEVER

    @property
    def is_pending(self) -> bool:
        return self.place in self._owner.pending

    def configure(self, settings: SlotSettings | None, now: int) -> None:
        before = self._settings
        self._settings = settings
        if settings is not None:
            self.can_id = settings.can_id
        if not self._is_started:
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
        self._is_started = True
        self._last_ns = -NEVER
        self._last_watched = -1
        if (settings := self._settings) is not None:
            self.triggers = settings.plan.triggers
            self._restart_timer(settings, now)
            self.news(now)
        self._set_due()

    def stop(self) -> None:
        self._is_started = False
        self._rest()

    def news(self, now: int) -> None:
        settings = self._settings
        if not self._is_started or settings is None:
            return
        self.is_news = True
        owner = self._owner
        if owner.is_quiet or not settings.by_event or self.place in owner.pending:
            return
        until = self._last_ns + settings.inhibit_ns
        if now >= until:
            self._deferred_until = NEVER
            owner.pending[self.place] = now
        elif self._deferred_until == NEVER and not settings.plan.is_paced:
            # A paced slot waits for the next event or its timer instead.
            self._deferred_until = until
        self._set_due()

    def send(self, now: int) -> None:
        if self._is_started and self._settings is not None and not self._owner.is_quiet:
            self._owner.pending.setdefault(self.place, now)

    def on_event(self, now: int) -> None:
        """Handle an event of ``triggers``."""
        settings = self._settings
        if settings is None or self.place in self._owner.pending:
            return
        plan = settings.plan
        # A deferred frame is sent in any case, so nothing is compared then.
        if plan.watched and self._deferred_until == NEVER:
            watched = plan.pack(self._escs, self._owner.status, now, 0, 0) & plan.watched
            if watched == self._last_watched:
                return
            self._last_watched = watched
        self.news(now)

    def advance(self, now: int) -> None:
        """Handle the end of the timer or of the inhibit time."""
        if now >= self._timer_due:
            assert self._settings is not None
            self._restart_timer(self._settings, now)
        self._deferred_until = NEVER
        self.news(now)
        self._set_due()

    def frames(self, now: int) -> list[CanFrame]:
        """Return the frames to send now. There are none if it needs live data that is lost."""
        settings = self._settings
        escs = self._escs
        assert settings is not None
        plan = settings.plan
        if plan.is_paced and not self._is_known(plan):
            self._last_ns = -NEVER
            self._timer_due = NEVER
            self._set_due()
            return []
        if plan.needs_live and escs[0].live is None:
            return []
        self.is_news = False
        self._last_ns = self._moment(settings, now) if plan.is_paced else now
        self._deferred_until = NEVER
        self._restart_timer(settings, self._last_ns)
        self._set_due()
        bits = plan.pack(escs, self._owner.status, now, 0, 0)
        bits |= settings.fill
        self._last_watched = bits & plan.watched
        self.sent += 1
        data = bits.to_bytes(plan.message.length, "little")
        if plan.seed is None:
            return [CanFrame(settings.can_id, data, page=settings.page)]
        first = self._owner.first_of(settings.can_id)
        number = first.transfer_id
        first.transfer_id = (number + 1) & TRANSFER_ID
        return transfer(settings.can_id, plan.seed, data, number, page=settings.page)

    def _is_known(self, plan: SlotPlan) -> bool:
        source = plan.message.signals[0].source
        esc = self._escs[0]
        assert source is not None
        found = steps(source, esc, self._owner.status, 0)
        return found is not None and divisor(source, esc) is not None

    def _moment(self, settings: SlotSettings, now: int) -> int:
        """Return the planned time of a paced frame that is sent at ``now``.

        The next distance counts from this time, so the rate is kept. If the frame is more than a
        period too early or too late, the rate starts anew at ``now``.
        """
        period = (settings.inhibit_ns + settings.timer_ns) // 2
        planned = self._last_ns + period
        return planned if self._last_ns < now < planned + period else now

    def _restart_timer(self, settings: SlotSettings, now: int) -> None:
        runs = settings.timer_ns and settings.by_event
        self._timer_due = now + settings.timer_ns if runs else NEVER

    def _rest(self) -> None:
        """Cancel everything that is due."""
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
        self.pending: dict[SlotKey, int] = {}
        """The slots that ``take`` sends, and the times at which they became due."""
        self.moved: set[int] = set()
        """ESCs of slots whose ``due`` changed."""
        self.is_quiet = False
        """True if no slot sends."""
        self._of: list[list[PythonSlot]] = [[] for _ in escs]
        self._due = [NEVER] * len(escs)

    def add(self, esc: int) -> PythonSlot:
        """Add a slot of an ESC."""
        slots = self._of[esc]
        slot = PythonSlot(self, (esc, len(slots)))
        slots.append(slot)
        return slot

    def first_of(self, can_id: int) -> PythonSlot:
        """Return the slot that numbers the transfers of an id."""
        return next(slot for slots in self._of for slot in slots if slot.can_id == can_id)

    @property
    def triggers(self) -> int:
        """The events for which ``on_event`` must be called."""
        found = Event.NONE
        for slots in self._of:
            for slot in slots:
                found |= slot.triggers
        return found

    def on_event(self, esc: int, events: int, now: int) -> None:
        """Mark the slots that follow these events of an ESC (bits of telemetry.Event)."""
        if self.is_quiet:
            return
        for slot in self._of[esc]:
            if events & slot.triggers:
                slot.on_event(now)

    def set_quiet(self, is_quiet: bool) -> None:
        """Begin or end quiet mode. Slots that are pending at its begin are not sent."""
        self.is_quiet = is_quiet
        if is_quiet:
            self.pending = {}

    def next_deadline(self) -> int:
        """Return the time at which ``advance`` must be called."""
        if self.is_quiet:
            return NEVER
        while self.moved:
            esc = self.moved.pop()
            self._due[esc] = min([slot.due for slot in self._of[esc]])
        return min(self._due)

    def advance(self, now: int) -> None:
        """Mark the slots whose timer or inhibit time is over."""
        if now < self.next_deadline():
            return
        for slots, due in zip(self._of, self._due, strict=True):
            if now >= due:
                for slot in slots:
                    if now >= slot.due:
                        slot.advance(now)

    @property
    def pending_since(self) -> int:
        """The time since which the oldest slot is pending, or NEVER."""
        return min(self.pending.values(), default=NEVER)

    def take(self, now: int, most: int | None = None) -> list[PendingSlot]:
        """Return the pending slots in their order, at most ``most``, each with its frames."""
        found = []
        for key, since in sorted(self.pending.items(), key=itemgetter(1, 0))[:most]:
            del self.pending[key]
            esc, number = key
            frames = self._of[esc][number].frames(now)
            found.append(PendingSlot(since, key, frames))
        return found
