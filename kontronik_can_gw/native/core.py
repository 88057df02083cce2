"""The core in C behind the interface of the core in Python (core/python_core.py)."""

import ctypes as c
from collections.abc import Sequence
from functools import partial
from typing import Any, cast

from kontronik_can_gw.core.interface import Follower
from kontronik_can_gw.core.messages import own_ids
from kontronik_can_gw.core.output import Owner
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.core.slots import PendingSlot, Slot, Slots, SlotSettings
from kontronik_can_gw.esc.telemetry import EscSettings, Event
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.native.binding import Frame, frames_in
from kontronik_can_gw.native.header import KCG, structure
from kontronik_can_gw.native.rows import NotInCore, Settings, SlotRow, TableRows, held_settings
from kontronik_can_gw.native.scale import rescaled
from kontronik_can_gw.native.slots import (
    NativeSlot,
    ReservedRows,
    frame_count,
    reserve,
    slot_rows,
    write_message,
)
from kontronik_can_gw.native.state import NativeEsc, NativeStatus, adopt_places, places_of
from kontronik_can_gw.native.tables import Tables
from kontronik_can_gw.native.turns import Turns
from kontronik_can_gw.status import GatewayStatus
from kontronik_can_gw.times import END_OF_TIME, NEVER

_MAX_FRAMES = 256
_WORD = (1 << 64) - 1
_LIVE_IN_PYTHON = (
    "Python handles each live frame, too: a PDO, record.when or another output needs it"
)
_Core = structure("kcg")
_Plan = structure("kcg_plan")
_Esc = structure("kcg_esc")
_Sending = structure("kcg_sending")


def _array(kind: Any, rows: Any) -> Any:
    """Return a ctypes array of the rows. An empty table has one row of zeros."""
    if isinstance(rows, TableRows) and rows:
        return (kind * len(rows)).from_buffer(rows.data)
    return (kind * max(1, len(rows)))(*rows)


def _part(
    memory: Any,
    kind: Any,
    count: int,
    address: int,
) -> Any:
    """Return an array in the core's memory."""
    return (kind * count).from_buffer(memory, address - c.addressof(memory))


def _check(esc: int, now: int, escs: int = 1) -> None:
    """Refuse arguments that the core does not check. A damaged capture can contain them."""
    if not 0 <= esc < escs:
        raise IndexError(f"ESC {esc}")
    if not 0 <= now < END_OF_TIME:
        raise OverflowError(f"time {now}")


class NativeCore:
    """The core in C (twin: PythonCore).

    Raises NotInCore if it cannot express the layout or an ESC's settings. Python runs the slots for
    which C has no room, and slots with values that C does not have.
    """

    language = "C"

    def __init__(
        self,
        library: Any,
        settings: CoreSettings,
        now: int,
    ) -> None:
        escs = settings.escs
        tables = Tables(settings)
        self._places = reserve(tables, settings.slots)
        self.slots_of_esc = len(self._places[0])
        self.library = library
        self._make(tables, now)
        self.status = cast(GatewayStatus, NativeStatus.from_buffer(self.state.gateway))
        self.status.esc_count = len(escs)
        self.escs: list[NativeEsc] = []
        for esc, state in zip(escs, self.esc_states, strict=True):
            self.escs.append(NativeEsc(esc, state))
        self.own_ids: dict[int, Owner] = own_ids(settings.layout)
        count = self.plan.messages
        self.places = partial(places_of, self.sending, count)
        self.adopt_places = partial(
            adopt_places, self.messages, self.sending, self.state, self._heap, count
        )
        self._slots = Slots(self.escs, self.status)
        self._followers: Sequence[Follower] = ()
        self.choose_events()
        self.link_changes: list[int] = []

    def _make(self, tables: Tables, now: int) -> None:
        """Start the core. ``state``, ``esc_states``, ``sending`` and ``pending`` are its memory."""
        self.pages = tables.pages
        self._of_settings = tables.of_settings
        arrays = {}
        addresses = {}
        for name, (kind, rows) in tables.arrays.items():
            array = _array(kind, rows)
            arrays[name] = array
            addresses[name] = c.addressof(array)
        self.messages = arrays["message"]
        self.signals = arrays["signal"]
        self.pieces = arrays["piece"]
        self.constants = arrays["constant"]
        self.slot_rows = _array(SlotRow, tables.slots)
        self._kept = [*arrays.values(), self.slot_rows]
        slot_row = c.addressof(self.slot_rows)
        self.plan = _Plan(**addresses, **tables.counts, slot_row=slot_row)
        plan = c.byref(self.plan)
        size = self.library.kcg_size(plan)
        self._memory = (c.c_uint64 * (size // 8 + 1))()
        settings = _array(Settings, tables.settings)
        memory = self._memory
        self.core = self.library.kcg_init(memory, plan, settings, now)
        state = _Core.from_buffer(memory)
        self.state = state
        escs = len(tables.settings)
        count = self.plan.messages + self.plan.slots
        self.esc_states = _part(memory, _Esc, escs, state.esc)
        self.sending = _part(memory, _Sending, count, state.sending)
        self.pending = _part(memory, c.c_uint16, count, state.pending)
        self._heap = _part(memory, c.c_uint16, count, state.heap)
        self._frames = (Frame * _MAX_FRAMES)()
        self._raw = memoryview(self._frames).cast("B")

    @property
    def followers(self) -> Sequence[Follower]:
        return self._followers

    @followers.setter
    def followers(self, given: Sequence[Follower]) -> None:
        self._followers = given
        self.choose_events()

    def choose_events(self) -> None:
        """Let the core report the events that Python code follows."""
        events = Event.LINK | Event.QUIET | self._slots.triggers  # always needed here
        for wanted, _ in self._followers:
            events |= wanted
        self.reports_live = bool(events & Event.LIVE)
        """True while a follower needs each live frame."""
        self.note = _LIVE_IN_PYTHON if self.reports_live else ""
        self.state.mask = events

    def slot(self, esc: int) -> Slot:
        places = self._places[esc]
        place = places.pop(0) if places else None
        python = self._slots.add(esc)
        return NativeSlot(self, place, esc, python)

    def write_slot(
        self,
        place: ReservedRows,
        esc: int,
        settings: SlotSettings,
    ) -> bool:
        """Write the rows of a slot. Return False if the core in C cannot express it."""
        plan = settings.plan
        try:
            rows = slot_rows(plan, self.escs[esc].settings.protocol)
        except NotInCore:
            return False
        for number, row in enumerate(rows.signals):
            self.signals[place.signal + number] = row
            signal = self.signals[place.signal + number]
            signal.first_piece += place.piece
            if row.esc == 0:
                signal.esc = esc
        for number, row in enumerate(rows.pieces):
            self.pieces[place.piece + number] = row
        slot_row = self.slot_rows[place.number]
        slot_row.watched = plan.watched
        slot_row.crc_seed = plan.seed or 0
        slot_row.page = settings.page
        message = self.messages[place.message]
        write_message(message, settings, len(rows.signals))
        for word in range(2):
            fill = settings.fill >> 64 * word & _WORD
            self.constants[message.first_word + word] = fill
        return True

    def receive(
        self,
        esc: int,
        data: bytes,
        now: int,
        since: int,
    ) -> None:
        _check(esc, now, len(self.escs))
        receive = self.library.kcg_receive
        core = self.core
        for begin in range(0, len(data) or 1, KCG.MAX_READ):
            part = data
            if len(data) > KCG.MAX_READ:
                part = data[begin : begin + KCG.MAX_READ]
            event = receive(core, esc, part, len(part), now, since)
            while event >= KCG.AGAIN:
                self._dispatch_all(event & ~KCG.AGAIN, now)
                event = receive(core, esc, part, len(part), now, since)
            self._dispatch_all(event, now)

    def port(self, esc: int, is_open: bool, now: int) -> None:
        _check(esc, now, len(self.escs))
        event = self.library.kcg_port(self.core, esc, is_open, now)
        self._dispatch_all(event, now)

    def expire(self, now: int) -> None:
        _check(0, now)
        event = self.library.kcg_expire(self.core, now)
        self._dispatch_all(event, now)

    def advance(self, now: int) -> None:
        _check(0, now)
        event = self.library.kcg_advance(self.core, now)
        self._dispatch_all(event, now)
        self._slots.advance(now)

    def advance_in_python(self, now: int) -> None:
        """Let time pass for the slots in Python only."""
        self._slots.advance(now)

    def next_deadline(self) -> int:
        found: int = self.library.kcg_next_deadline(self.core)
        return min(found, self._slots.next_deadline())

    def deadline_in_python(self) -> int:
        """Return the deadline of ``advance_in_python``. 0 while one of its slots is pending."""
        return 0 if self._slots.pending else self._slots.next_deadline()

    def turns(self) -> Turns:
        """Return the iterations of a loop with this core."""
        return Turns(self.library, self.core, len(self.escs))

    def dispatch(self, event: int, now: int) -> None:
        """Pass on an event that an iteration returned. Further events are returned one by one."""
        self._dispatch(event >> 8, event & 0xFF, now)

    def dispatch_others(self, now: int) -> None:
        """Pass on all further events of an iteration, if the loop makes the rest of it."""
        event = self.library.kcg_next_event(self.core)
        self._dispatch_all(event, now)

    @property
    def is_pending(self) -> bool:
        return bool(self.state.pendings or self._slots.pending)

    def take(self, now: int) -> list[CanFrame]:
        frames: list[CanFrame] = []
        in_python = self._slots.take(now)
        library = self.library
        core = self.core
        while count := library.kcg_take(core, now, self._frames, _MAX_FRAMES):
            found = frames_in(self._raw, 0, count)
            frames += _merged(self, found, in_python) if in_python else found
            library.kcg_sent(core, now, count)
        for slot in in_python:
            frames += slot.frames
        return frames

    def take_oldest(self, now: int) -> list[CanFrame]:
        count = self.state.pendings
        pending = self.pending[:count]
        messages = self.plan.messages
        ages = [(self.sending[index].since, index < messages, index) for index in pending]
        since, _, index = min(ages, default=(NEVER, False, 0))
        if self._slots.pending_since <= since:
            return self._slots.take(now, 1)[0].frames
        others = [each for each in pending if each != index]
        self.pending[0] = index
        self.state.pendings = 1
        taken = self.library.kcg_take(self.core, now, self._frames, _MAX_FRAMES)
        self.library.kcg_sent(self.core, now, taken)
        for place, other in enumerate(others, self.state.pendings):
            self.pending[place] = other
        self.state.pendings += len(others)
        return frames_in(self._raw, 0, taken)

    def apply(self, esc: int, settings: EscSettings) -> None:
        _check(esc, 0, len(self.escs))
        row = held_settings(settings)
        self.library.kcg_apply(self.core, esc, c.byref(row))
        for index, (made, signal) in self._of_settings.items():
            if signal.esc == esc:
                self.signals[index] = rescaled(made, signal, settings)
        self.escs[esc].apply(settings)

    def gateway_changed(self, now: int) -> None:
        self.library.kcg_gateway_changed(self.core, 0, now)

    def repeat(self, now: int) -> None:
        _check(0, now)
        self.library.kcg_repeat(self.core, now)

    def stop(self, now: int) -> None:
        self.library.kcg_stop(self.core, now)

    def _dispatch_all(self, event: int, now: int) -> None:
        """Pass on the event that a call of the core returned, and all further ones."""
        while event >= 0:
            self._dispatch(event >> 8, event & 0xFF, now)
            event = self.library.kcg_next_event(self.core)

    def _dispatch(self, esc: int, events: int, now: int) -> None:
        if events & Event.LINK:
            self.link_changes.append(esc)
        if events & Event.QUIET:
            self._slots.set_quiet(bool(self.status.is_quiet))
        for wanted, follow in self._followers:
            if events & wanted:
                follow(esc, events, now)
        self._slots.on_event(esc, events, now)


def _merged(
    core: NativeCore,
    frames: list[CanFrame],
    in_python: list[PendingSlot],
) -> list[CanFrame]:
    """Return the frames of kcg_take, with those of slots in Python at their places.

    Slots that were placed are removed from ``in_python``. The others come after all frames.
    """
    merged: list[CanFrame] = []
    first_slot = core.plan.messages
    at = 0
    place = 0
    while at < len(frames):
        index = core.pending[place]
        place += 1
        key = None
        if index >= first_slot:
            which = divmod(index - first_slot, core.slots_of_esc)
            key = core.sending[index].since, which
        while in_python and (key is None or in_python[0][:2] < key):
            merged += in_python.pop(0).frames
        end = at + frame_count(core.messages[index])
        merged += frames[at:end]
        at = end
    return merged
