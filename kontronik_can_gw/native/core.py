"""The core in C in place of the one in Python (core/python_core.py): the same surface, and what is read of it has the same names."""

import ctypes as c
from collections.abc import Sequence
from typing import Any, cast

from kontronik_can_gw.core.interface import Follower
from kontronik_can_gw.core.messages import own_ids
from kontronik_can_gw.core.output import Owner
from kontronik_can_gw.core.slots import Slot, Slots
from kontronik_can_gw.esc.telemetry import EscSettings, Event
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.native.binding import Frame, frames_in
from kontronik_can_gw.native.header import KCG, structure
from kontronik_can_gw.native.rows import Rows, Settings, SlotRow, held_settings
from kontronik_can_gw.native.scale import END_OF_TIME
from kontronik_can_gw.native.slots import NativeSlot, merge, reserve
from kontronik_can_gw.native.state import NativeEsc, NativeStatus
from kontronik_can_gw.native.tables import Tables
from kontronik_can_gw.native.turns import Turns
from kontronik_can_gw.signals.plan import Layout
from kontronik_can_gw.status import GatewayStatus

_MAX_FRAMES = 256
_LIVE_IN_PYTHON = "a PDO with a value that it does not have is sent in Python"
_Plan, _Esc, _Core = structure("kcg_plan"), structure("kcg_esc"), structure("kcg")
_Sending = structure("kcg_sending")


def _array(kind: Any, rows: Any) -> Any:
    if isinstance(rows, Rows) and rows:
        return (kind * len(rows)).from_buffer(rows.data)
    return (kind * max(1, len(rows)))(*rows)


def _check(esc: int, now: int, escs: int = 1) -> None:
    """What a damaged capture may hold never reaches the core."""
    if not 0 <= esc < escs:
        raise IndexError(f"ESC {esc}")
    if not 0 <= now < END_OF_TIME:
        raise OverflowError(f"time {now}")


class NativeCore:
    """As Core. NotInCore where the core in C cannot express the layout or an ESC's settings.

    ``slots``: number of slots of each ESC that C runs. Python runs further slots, and slots with values that C does not have.
    """

    language = "C"

    def __init__(
        self,
        library: Any,
        escs: Sequence[EscSettings],
        layout: Layout,
        now: int,
        silent: bool,
        slots: int = 0,
    ) -> None:
        tables = Tables(layout, escs, silent)
        self._places = reserve(tables, slots)
        self.slots_of_esc = len(self._places[0])
        self.library = library
        self._make(tables, now)
        self.status = cast(GatewayStatus, NativeStatus.from_buffer(self.state.gateway))
        self.status.esc_count = len(escs)
        self.escs = [NativeEsc(*pair) for pair in zip(escs, self.esc_states, strict=True)]
        self.own_ids: dict[int, Owner] = own_ids(layout)
        self._slots = Slots(self.escs, self.status)
        self._followers: Sequence[Follower] = ()
        self.choose_events()
        self.link_changes: list[int] = []
        self.shortest_timeout_ns = min(esc.timeout_ns for esc in escs)
        self.packs_at_once = False

    def _make(self, tables: Tables, now: int) -> None:
        """``state``, ``esc_states``: what is in the core's memory."""
        self.pages = tables.pages
        arrays = {name: _array(*table) for name, table in tables.arrays.items()}
        self.messages, self.signals, self.pieces, self.constants = (
            arrays[name] for name in ("message", "signal", "piece", "constant")
        )
        self.slot_rows = _array(SlotRow, tables.slots)
        self._kept = [*arrays.values(), self.slot_rows]
        self.plan = _Plan(
            *map(c.addressof, arrays.values()), *tables.counts.values(), c.addressof(self.slot_rows)
        )
        size = self.library.kcg_size(c.byref(self.plan))
        self._memory = (c.c_uint64 * (size // 8 + 1))()
        settings = _array(Settings, tables.settings)
        self.core = self.library.kcg_init(self._memory, c.byref(self.plan), settings, now)
        self.state = _Core.from_buffer(self._memory)
        begin = self.state.esc - c.addressof(self._memory)
        self.esc_states = (_Esc * len(tables.settings)).from_buffer(self._memory, begin)
        count = self.plan.messages + self.plan.slots
        begin = self.state.sending - c.addressof(self._memory)
        self.sending = (_Sending * count).from_buffer(self._memory, begin)
        begin = self.state.pending - c.addressof(self._memory)
        self.pending = (c.c_uint16 * count).from_buffer(self._memory, begin)
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
        """Be given the events that somebody in Python follows."""
        events = Event.LINK | self._slots.triggers  # which is followed here in any case
        for wanted, _ in self._followers:
            events |= wanted
        self.reports_live = bool(events & Event.LIVE)
        """True while somebody follows each live frame."""
        self.note = _LIVE_IN_PYTHON if self.reports_live else ""
        self.state.mask = events

    def slot(self, esc: int) -> Slot:
        places = self._places[esc]
        return NativeSlot(self, places.pop(0) if places else None, esc, self._slots.add(esc))

    def receive(self, esc: int, data: bytes, now: int, since: int) -> None:
        _check(esc, now, len(self.escs))
        receive, core = self.library.kcg_receive, self.core
        for begin in range(0, len(data) or 1, KCG.MAX_READ):
            part = data[begin : begin + KCG.MAX_READ] if len(data) > KCG.MAX_READ else data
            while (found := receive(core, esc, part, len(part), now, since)) >= KCG.AGAIN:
                self._follow_all(found & ~KCG.AGAIN, now)
            self._follow_all(found, now)

    def port(self, esc: int, is_open: bool, now: int) -> None:
        _check(esc, now, len(self.escs))
        self._follow_all(self.library.kcg_port(self.core, esc, is_open, now), now)

    def expire(self, now: int) -> None:
        _check(0, now)
        self._follow_all(self.library.kcg_expire(self.core, now), now)

    def advance(self, now: int) -> None:
        _check(0, now)
        self._follow_all(self.library.kcg_advance(self.core, now), now)
        self._slots.advance(now)

    def advance_in_python(self, now: int) -> None:
        """The same for what C does not know: the slots in Python."""
        self._slots.advance(now)

    def next_deadline(self) -> int:
        found: int = self.library.kcg_next_deadline(self.core)
        return min(found, self._slots.next_deadline())

    def deadline_in_python(self) -> int:
        """When ``advance_in_python`` has something to do; 0 while one of these slots is pending."""
        return 0 if self._slots.is_pending else self._slots.next_deadline()

    def turns(self) -> Turns:
        """Whole turns of a loop with this core."""
        return Turns(self.library, self.core, len(self.escs))

    def follow(self, found: int, now: int) -> None:
        """Follow an event that a turn came back with; if there are others it comes back with each."""
        self._follow(found >> 8, found & 0xFF, now)

    def follow_others(self, now: int) -> None:
        """Follow these, where the rest of the turn is the loop's."""
        self._follow_all(self.library.kcg_next_event(self.core), now)

    @property
    def is_pending(self) -> bool:
        return bool(self.state.pendings) or self._slots.is_pending

    def take(self, now: int) -> list[CanFrame]:
        frames: list[CanFrame] = []
        in_python = self._slots.take_each(now)
        library, core = self.library, self.core
        while count := library.kcg_take(core, now, self._frames, _MAX_FRAMES):
            found = frames_in(self._raw, 0, count)
            frames += merge(self, found, in_python) if in_python else found
            library.kcg_sent(core, now, count)
        for slot in in_python:
            frames += slot.frames
        return frames

    def apply(self, esc: int, settings: EscSettings) -> None:
        _check(esc, 0, len(self.escs))
        self.library.kcg_apply(self.core, esc, c.byref(held_settings(settings)))
        self.escs[esc].apply(settings)
        self.shortest_timeout_ns = min(each.settings.timeout_ns for each in self.escs)

    def gateway_changed(self, now: int) -> None:
        self.library.kcg_gateway_changed(self.core, 0, now)

    def repeat(self, now: int) -> None:
        _check(0, now)
        self.library.kcg_repeat(self.core, now)

    def stop(self, now: int) -> None:
        self.library.kcg_stop(self.core, now)

    def pack(self, now: int) -> None:
        """Nothing: this core packs when it hands over."""

    def _follow_all(self, found: int, now: int) -> None:
        """Follow what a call of the core returned, and what else there is."""
        while found >= 0:
            self._follow(found >> 8, found & 0xFF, now)
            found = self.library.kcg_next_event(self.core)

    def _follow(self, esc: int, events: int, now: int) -> None:
        if events & Event.LINK:
            self.link_changes.append(esc)
        for wanted, follow in self._followers:
            if events & wanted:
                follow(esc, events, now)
        self._slots.on_event(esc, events, now)
