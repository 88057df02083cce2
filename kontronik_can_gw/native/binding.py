"""The core in C by ctypes, call by call: a plain shared object, no Python headers, no callbacks."""

import ctypes as c
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.frames import EXTENDED, CanFrame
from kontronik_can_gw.native.objects import source_number
from kontronik_can_gw.native.rows import (
    GATEWAY,
    STORED_COUNTS,
    Message,
    NotInCore,
    Settings,
    Signal,
)
from kontronik_can_gw.native.settings import held_settings
from kontronik_can_gw.native.tables import END_OF_TIME, Tables

HELD, BODY, LONGEST = 43, 33, 44
_MAX_FRAMES = 256
_AGAIN = 1 << 30
_MAX_READ = 16384
"""Bytes that the core is given at once: not more frames than it can keep."""
_u8, _u16, _u32, _u64, _i64, _i32, _p = (
    *(c.c_uint8, c.c_uint16, c.c_uint32, c.c_uint64, c.c_int64, c.c_int32, c.c_void_p),
)


class Frame(c.Structure):
    """kcg_frame of a core with 64 data bytes: struct canfd_frame."""

    _fields_ = (
        ("id", _u32),
        ("length", _u8),
        ("flags", _u8),
        ("page", _u8),
        ("reserved", _u8),
        ("data", _u8 * 64),
    )


class Plan(c.Structure):
    """kcg_plan: as Tables.arrays and Tables.counts."""

    _fields_ = (
        *((name, _p) for name in ("message", "signal", "piece", "pair", "constant")),
        *((name, _p) for name in ("esc_of", "listener", "first_listener")),
        ("words", _u32),
        *((name, _u16) for name in ("messages", "escs", "pages", "slots")),
        ("watched", _p),
    )


class Esc(c.Structure):
    """kcg_esc: the state of an ESC."""

    _fields_ = (
        *((name, _u8) for name in ("has_live", "has_info", "had_live", "had_info", "has_time")),
        *((name, _u8) for name in ("turns", "cells", "held_count", "need", "arrivals")),
        *((name, _u8) for name in ("blame", "reported", "link", "layout")),
        *((name, _i32) for name in ("rate", "power")),
        ("settings", Settings),
        ("count", _u64 * STORED_COUNTS),
        ("window", _u32 * 4),
        *((name, _u32) for name in ("base", "blame_until")),
        ("energy", _u64),
        *((name, _i64) for name in ("energy_rest", "run_time", "live_ns", "live_bound")),
        *((name, _i64) for name in ("info_bound", "last_info_ns", "window_ns", "interval")),
        ("arrival_bound", _i64 * (HELD + 1)),
        ("arrival_end", _u32 * (HELD + 1)),
        ("generation", _u32),
        ("live", _u8 * BODY),
        ("info", _u8 * BODY),
        ("held", _u8 * (HELD + LONGEST)),
    )


_FRAME_SIZE = c.sizeof(Frame)
_head = struct.Struct("=IBBB").unpack_from
_new = tuple.__new__
_FUNCTIONS: dict[str, tuple[Any, ...]] = {
    "kcg_sizes": (_u32, _u32),
    "kcg_wire": (c.c_char_p,),
    "kcg_size": (c.c_size_t, _p),
    "kcg_init": (_p, _p, _p, _p, _i64),
    "kcg_receive": (c.c_int, _p, c.c_int, c.c_char_p, c.c_size_t, _i64, _i64),
    "kcg_expire": (c.c_int, _p, _i64),
    "kcg_advance": (c.c_int, _p, _i64),
    "kcg_port": (c.c_int, _p, c.c_int, c.c_int, _i64),
    "kcg_next_event": (c.c_int, _p),
    "kcg_next_deadline": (_i64, _p),
    "kcg_apply": (None, _p, c.c_int, _p),
    "kcg_gateway_changed": (None, _p, c.c_int, _i64),
    "kcg_repeat": (None, _p, _i64),
    "kcg_stop": (None, _p, _i64),
    "kcg_take": (_u32, _p, _i64, _p, _u32),
    "kcg_sent": (None, _p, _i64, _u32),
    "kcg_escs": (_p, _p),
    "kcg_gateway": (_p, _p),
    "kcg_set_mask": (None, _p, _u32),
    "kcg_pending": (_u32, _p),
    "kcg_begin": (None, _p),
    "kcg_turn": (c.c_int, _p),
    "kcg_leave": (None, _p),
    "kcg_watch": (c.c_int, _p),
    "kcg_turns_size": (_u32,),
    "kcg_slot_start": (None, _p, _u32, _i64),
    "kcg_slot_changed": (None, _p, _u32, _i64),
    "kcg_slot_stop": (None, _p, _u32),
    "kcg_slot_news": (None, _p, _u32, _i64),
    "kcg_slot_send": (None, _p, _u32, _i64),
    "kcg_slot_is_news": (c.c_int, _p, _u32),
    "kcg_slot_sent": (_u64, _p, _u32),
}


class WrongObject(RuntimeError):
    """A shared object that is not of this version, or not for this machine: the message says which."""


def load(path: Path) -> Any:
    """The shared object with its functions declared. WrongObject where it cannot be used."""
    try:
        library: Any = c.PyDLL(str(path))  # other threads of Python run only while a turn waits
        library.kcg_turn = c.CDLL(str(path)).kcg_turn
        for name, (result, *arguments) in _FUNCTIONS.items():
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
    except (OSError, AttributeError) as error:
        raise WrongObject(f"{path.name}: {error}") from None
    mine = (source_number(), *map(c.sizeof, (Signal, Message, Settings, Plan, Esc, Frame)))
    its = tuple(library.kcg_sizes(number) for number in range(len(mine)))
    if its != mine:
        raise WrongObject(f"{path.name}: made of other sources than these")
    return library


class Handle:
    """A core at work. ``on_event``: ESC, events, time; called between two readings, as the core in Python does."""

    def __init__(
        self,
        library: Any,
        tables: Tables,
        now: int,
        on_event: Callable[[int, int, int], None],
    ) -> None:
        if tables.wire not in ("", library.kcg_wire().decode()):
            raise NotInCore(f"fields on the wire: {tables.wire}")
        self.library = library
        self._on_event = on_event
        self.pages = tables.pages
        arrays = {name: self._array(*table) for name, table in tables.arrays.items()}
        self.messages, self.signals, self.pieces, self.constants = (
            arrays[name] for name in ("message", "signal", "piece", "constant")
        )
        self.watched = self._array(_u64, tables.watched)
        self._kept = [*arrays.values(), self.watched]
        self._plan = Plan(
            *map(c.addressof, arrays.values()), *tables.counts.values(), c.addressof(self.watched)
        )
        size = library.kcg_size(c.byref(self._plan))
        self._memory = (_u64 * (size // 8 + 1))()
        settings = self._array(Settings, tables.settings)
        self.core = library.kcg_init(self._memory, c.byref(self._plan), settings, now)
        begin = c.addressof(self._memory)
        at = library.kcg_escs(self.core) - begin, library.kcg_gateway(self.core) - begin
        self.escs = (Esc * len(tables.settings)).from_buffer(self._memory, at[0])
        self.gateway = (_i64 * len(GATEWAY)).from_buffer(self._memory, at[1])
        self._frames = (Frame * _MAX_FRAMES)()
        self._raw = memoryview(self._frames).cast("B")

    @staticmethod
    def _array(kind: Any, rows: Sequence[Any]) -> Any:
        if not rows or isinstance(rows[0], int):
            return (kind * max(1, len(rows)))(*rows)
        return (kind * len(rows)).from_buffer_copy(b"".join(rows))  # of rows it would keep them all

    def follow(self, found: int, now: int) -> None:
        """Give ``on_event`` what a call of the core returned, and what else there is."""
        while found >= 0:
            self._on_event(found >> 8, found & 0xFF, now)
            found = self.library.kcg_next_event(self.core)

    def report_only(self, events: int) -> None:
        """Give ``on_event`` these alone: bits of telemetry.Event."""
        self.library.kcg_set_mask(self.core, events)

    def _check(self, esc: int, now: int) -> None:
        """What a damaged capture may hold never reaches the core."""
        if not 0 <= esc < len(self.escs):
            raise IndexError(f"ESC {esc}")
        if not 0 <= now < END_OF_TIME:
            raise OverflowError(f"time {now}")

    def receive(self, esc: int, data: bytes, now: int, since: int) -> None:
        """As Core.receive."""
        self._check(esc, now)
        receive, core = self.library.kcg_receive, self.core
        for begin in range(0, len(data) or 1, _MAX_READ):
            part = data[begin : begin + _MAX_READ] if len(data) > _MAX_READ else data
            while (found := receive(core, esc, part, len(part), now, since)) >= _AGAIN:
                self.follow(found & ~_AGAIN, now)
            self.follow(found, now)

    def port(self, esc: int, is_open: bool, now: int) -> None:
        """As Core.port."""
        self._check(esc, now)
        self.follow(self.library.kcg_port(self.core, esc, is_open, now), now)

    def expire(self, now: int) -> None:
        """As Core.expire."""
        self._check(0, now)
        self.follow(self.library.kcg_expire(self.core, now), now)

    def advance(self, now: int) -> None:
        """As Core.advance."""
        self._check(0, now)
        self.follow(self.library.kcg_advance(self.core, now), now)

    def next_deadline(self) -> int:
        """As Core.next_deadline."""
        found: int = self.library.kcg_next_deadline(self.core)
        return found

    def apply(self, esc: int, settings: EscSettings) -> None:
        """As Core.apply."""
        self._check(esc, 0)
        self.library.kcg_apply(self.core, esc, c.byref(held_settings(settings)))

    def gateway_changed(self, now: int) -> None:
        """As Core.gateway_changed."""
        self.library.kcg_gateway_changed(self.core, 0, now)

    def repeat(self, now: int) -> None:
        """As Core.repeat."""
        self._check(0, now)
        self.library.kcg_repeat(self.core, now)

    def stop(self, now: int) -> None:
        """As Core.stop."""
        self.library.kcg_stop(self.core, now)

    @property
    def is_pending(self) -> bool:
        """As Core.is_pending."""
        return bool(self.library.kcg_pending(self.core))

    def take(self, now: int) -> list[CanFrame]:
        """As Core.take."""
        frames: list[CanFrame] = []
        library, core = self.library, self.core
        while count := library.kcg_take(core, now, self._frames, _MAX_FRAMES):
            frames += frames_in(self._raw, 0, count)
            library.kcg_sent(core, now, count)
        return frames


def frames_in(raw: memoryview, begin: int, count: int) -> list[CanFrame]:
    """As CanFrames: ``count`` of kcg_frame in memory from ``begin`` on."""
    frames = []
    for at in range(begin, begin + count * _FRAME_SIZE, _FRAME_SIZE):
        number, length, flags, page = _head(raw, at)
        data = bytes(raw[at + 8 : at + 8 + length])
        of = (number & ~EXTENDED, data, number >= EXTENDED, flags != 0, page, False, False)
        frames.append(_new(CanFrame, of))
    return frames
