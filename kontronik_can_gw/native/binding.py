"""The core in C by ctypes, call by call: a plain shared object, no Python headers, no callbacks."""

import ctypes as c
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.frames import EXTENDED, CanFrame
from kontronik_can_gw.native.header import KCG, functions, structure
from kontronik_can_gw.native.objects import source_number
from kontronik_can_gw.native.rows import NotInCore, Rows, Settings
from kontronik_can_gw.native.settings import held_settings
from kontronik_can_gw.native.tables import END_OF_TIME, Tables

_MAX_FRAMES = 256
Frame, Plan, Esc = structure("kcg_frame"), structure("kcg_plan"), structure("kcg_esc")
_Core = structure("kcg")
_FRAME_SIZE = c.sizeof(Frame)
_SIZED = (
    *("signal", "message", "settings", "plan", "esc", "frame"),
    *("offline", "column", "cell", "turns"),
)
"""In the order of kcg_sizes, kcg_offline_sizes and kcg_turns_size."""
_head = struct.Struct("=IBBB").unpack_from
_new = tuple.__new__


class WrongObject(RuntimeError):
    """A shared object that is not of this version, or not for this machine: the message says which."""


def load(path: Path) -> Any:
    """The shared object with its functions declared. WrongObject where it cannot be used."""
    try:
        library: Any = c.PyDLL(str(path))  # other threads of Python run only while a turn waits
        library.kcg_turn = c.CDLL(str(path)).kcg_turn
        for name, (result, *arguments) in functions():
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
    except (OSError, AttributeError) as error:
        raise WrongObject(f"{path.name}: {error}") from None
    its = [library.kcg_sizes(number) for number in range(7)]
    its += [*map(library.kcg_offline_sizes, range(3)), library.kcg_turns_size()]
    if its != [source_number(), *(c.sizeof(structure(f"kcg_{name}")) for name in _SIZED)]:
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
        self.watched = self._array(c.c_uint64, tables.watched)
        self._kept = [*arrays.values(), self.watched]
        self._plan = Plan(
            *map(c.addressof, arrays.values()), *tables.counts.values(), c.addressof(self.watched)
        )
        size = library.kcg_size(c.byref(self._plan))
        self._memory = (c.c_uint64 * (size // 8 + 1))()
        settings = self._array(Settings, tables.settings)
        self.core = library.kcg_init(self._memory, c.byref(self._plan), settings, now)
        self.state = _Core.from_buffer(self._memory)
        begin = self.state.esc - c.addressof(self._memory)
        self.esc_states = (Esc * len(tables.settings)).from_buffer(self._memory, begin)
        self._frames = (Frame * _MAX_FRAMES)()
        self._raw = memoryview(self._frames).cast("B")

    @staticmethod
    def _array(kind: Any, rows: Any) -> Any:
        if isinstance(rows, Rows) and rows:
            return (kind * len(rows)).from_buffer(rows.data)
        return (kind * max(1, len(rows)))(*rows)

    def follow_all(self, found: int, now: int) -> None:
        """Give ``on_event`` what a call of the core returned, and what else there is."""
        while found >= 0:
            self._on_event(found >> 8, found & 0xFF, now)
            found = self.library.kcg_next_event(self.core)

    def report_only(self, events: int) -> None:
        """Give ``on_event`` these alone: bits of telemetry.Event."""
        self.state.mask = events

    def _check(self, esc: int, now: int) -> None:
        """What a damaged capture may hold never reaches the core."""
        if not 0 <= esc < len(self.esc_states):
            raise IndexError(f"ESC {esc}")
        if not 0 <= now < END_OF_TIME:
            raise OverflowError(f"time {now}")

    def receive(self, esc: int, data: bytes, now: int, since: int) -> None:
        """As Core.receive."""
        self._check(esc, now)
        receive, core = self.library.kcg_receive, self.core
        for begin in range(0, len(data) or 1, KCG.MAX_READ):
            part = data[begin : begin + KCG.MAX_READ] if len(data) > KCG.MAX_READ else data
            while (found := receive(core, esc, part, len(part), now, since)) >= KCG.AGAIN:
                self.follow_all(found & ~KCG.AGAIN, now)
            self.follow_all(found, now)

    def port(self, esc: int, is_open: bool, now: int) -> None:
        """As Core.port."""
        self._check(esc, now)
        self.follow_all(self.library.kcg_port(self.core, esc, is_open, now), now)

    def expire(self, now: int) -> None:
        """As Core.expire."""
        self._check(0, now)
        self.follow_all(self.library.kcg_expire(self.core, now), now)

    def advance(self, now: int) -> None:
        """As Core.advance."""
        self._check(0, now)
        self.follow_all(self.library.kcg_advance(self.core, now), now)

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
        return bool(self.state.pendings)

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
