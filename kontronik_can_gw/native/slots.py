"""Slots of the core in C (core.h, kcg_slot_start): their rows and their interface."""

from functools import lru_cache
from typing import Any, NamedTuple, Protocol

from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.core.slots import PythonSlot, SlotPlan, SlotSettings
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.frames import EXTENDED
from kontronik_can_gw.native.header import KCG
from kontronik_can_gw.native.rows import Message, NotInCore, Piece, Signal, SlotRow
from kontronik_can_gw.native.tables import MAX_ROWS, Tables
from kontronik_can_gw.signals.plan import MessageLayout

MAX_SIGNALS = 8
"""Number of signals of a slot."""
_MAX_PLANS = 256
"""Number of plans whose rows are kept."""
_MAX_IN_ONE_FRAME = 7
"""Largest transfer in bytes that one frame can hold."""


class ReservedRows(NamedTuple):
    """The number of a slot, and the indices of its message, first signal and first piece."""

    number: int
    message: int
    signal: int
    piece: int


def reserve(tables: Tables, slots: int) -> list[list[ReservedRows]]:
    """Add empty rows for ``slots`` slots of each ESC, or for as many as there is room.

    Return the places of each ESC.
    """
    count = len(tables.listeners_of)
    used = max(
        len(tables.signals),
        len(tables.messages),
        len(tables.listeners),
        tables.pages,
    )
    room = (MAX_ROWS - used) // (MAX_SIGNALS * count)
    slots = min(slots, room)
    places = []
    for esc in range(count):
        own_places = [_add(tables, esc) for _ in range(slots)]
        places.append(own_places)
    for own, listeners in zip(places, tables.listeners_of, strict=True):
        listeners[:0] = [place.message for place in own]
    return places


def _add(tables: Tables, esc: int) -> ReservedRows:
    place = ReservedRows(
        number=len(tables.slots),
        message=len(tables.messages),
        signal=len(tables.signals),
        piece=len(tables.pieces),
    )
    tables.messages.append(
        Message(
            words=1,
            pages=1,
            first_signal=place.signal,
            first_page=tables.pages,
            first_word=len(tables.constants),
            first_esc=len(tables.esc_of),
            escs=1,
        )
    )
    for _ in range(MAX_SIGNALS):
        tables.signals.append(Signal())
        tables.pieces.append(Piece())
    tables.constants += [0, 0]
    tables.pages += 1
    tables.esc_of.append(esc)
    tables.slots.append(SlotRow())
    return place


def frame_count(message: Any) -> int:
    """Return the number of frames of a row of kcg_message (twin: core.c, parts_of)."""
    is_long = message.flags & KCG.TRANSFER and message.length > _MAX_IN_ONE_FRAME
    return (int(message.length) + 8) // 7 if is_long else 1


@lru_cache(_MAX_PLANS)
def slot_rows(plan: SlotPlan, protocol: str) -> Tables:
    """Return the rows of a slot for ESC 0. NotInCore if the core in C cannot express it."""
    if plan.only_python:
        raise NotInCore(plan.only_python)
    layout = MessageLayout("", "", (plan.message,))
    settings = EscSettings(protocol=protocol)
    tables = Tables(CoreSettings((settings,), layout))
    if tables.of_settings:
        raise NotInCore("its rows would contain the settings of an ESC")
    rows = max(len(tables.signals), len(tables.pieces))
    if rows > MAX_SIGNALS or tables.pairs:
        raise NotInCore(f"too many values in one frame ({len(tables.signals)})")
    return tables


def write_message(message: Any, settings: SlotSettings, signals: int) -> None:
    """Write a row of kcg_message for a slot with this number of signals."""
    plan = settings.plan
    is_transfer = plan.seed is not None
    message.id = settings.can_id | (EXTENDED if is_transfer else 0)
    message.length = plan.message.length
    message.words = 2 if plan.message.length > 8 else 1
    flags = KCG.EVENT * settings.by_event | KCG.SILENT_ON_LOSS * plan.needs_live
    message.flags = flags | KCG.TRANSFER * is_transfer | KCG.PACED * plan.is_paced
    message.triggers = plan.triggers
    message.signals = signals
    message.cycle = settings.timer_ns
    message.delay = settings.inhibit_ns


class SlotHost(Protocol):
    """The part of ``NativeCore`` that a slot needs."""

    library: Any
    core: Any
    """The address of kcg."""

    def write_slot(
        self,
        place: ReservedRows,
        esc: int,
        settings: SlotSettings,
    ) -> bool:
        """Write the rows of a slot. Return False if the core in C cannot express it."""

    def choose_events(self) -> None:
        """Ask C for the events that slots in Python follow now."""


class NativeSlot:
    """A Slot that runs in C if the core has all of its values. Otherwise ``python`` runs it.

    ``place`` is None if C has no room for it.
    """

    def __init__(
        self,
        host: SlotHost,
        place: ReservedRows | None,
        esc: int,
        python: PythonSlot,
    ) -> None:
        self._host = host
        self._place = place
        self._esc = esc
        self._python = python
        self._is_started = False
        self.is_in_c = False

    @property
    def sent(self) -> int:
        sent = self._python.sent
        if self._place is not None:
            sent += self._call("sent")
        return sent

    @property
    def is_news(self) -> bool:
        return bool(self._call("is_news")) if self.is_in_c else self._python.is_news

    @property
    def is_pending(self) -> bool:
        return bool(self._call("is_pending")) if self.is_in_c else self._python.is_pending

    def configure(self, settings: SlotSettings | None, now: int) -> None:
        was_in_c = self.is_in_c
        self.is_in_c = False
        if settings is not None and self._place is not None:
            self.is_in_c = self._host.write_slot(self._place, self._esc, settings)
        self._python.configure(None if self.is_in_c else settings, now)
        if was_in_c and not self.is_in_c:
            self._call("stop")
        elif self.is_in_c and self._is_started:
            self._call("changed" if was_in_c else "start", now)
        self._host.choose_events()

    def start(self, now: int) -> None:
        self._is_started = True
        self._python.start(now)
        if self.is_in_c:
            self._call("start", now)
        self._host.choose_events()

    def stop(self) -> None:
        self._is_started = False
        self._python.stop()
        if self.is_in_c:
            self._call("stop")
        self._host.choose_events()

    def news(self, now: int) -> None:
        if self.is_in_c:
            self._call("news", now)
        else:
            self._python.news(now)

    def send(self, now: int) -> None:
        if self.is_in_c:
            self._call("send", now)
        else:
            self._python.send(now)

    def _call(self, name: str, *arguments: int) -> int:
        assert self._place is not None
        function = getattr(self._host.library, f"kcg_slot_{name}")
        found: int = function(self._host.core, self._place.number, *arguments)
        return found
