"""Plays a recording by the core in C at full speed (offline.c): a capture's entries, or the plain bytes of one ESC.

What a Player leaves to the caller, entries that come now and then, is given to the same core by the calls of its Gateway, whose outputs
include the Player for the sake of its rows.
"""

import ctypes as c
from bisect import bisect_left
from collections.abc import Sequence

from kontronik_can_gw.core.output import Output
from kontronik_can_gw.esc.decoder import Counters
from kontronik_can_gw.native.core import NativeCore
from kontronik_can_gw.native.header import KCG, structure
from kontronik_can_gw.native.offline import ROWS, ColumnOf, FrameRoom, Frames, Rows
from kontronik_can_gw.native.tables import bind, places_of
from kontronik_can_gw.signals.plan import Layout

_FRAMES = 1 << 12
_u32 = c.c_uint32


_Offline, _Column = structure("kcg_offline"), structure("kcg_column")


class Player(Output):
    """Plays a recording. ``columns``: rows of these values are wanted; None: frames. A follower of its core for the rows' sake."""

    def __init__(self, columns: Sequence[ColumnOf] | None = None) -> None:
        super().__init__()
        self._columns = columns
        self._state = _Offline()
        self._payload = b""
        self._count = 0

    def bind(self, core: NativeCore, now: int) -> None:
        """Take the core that is to be played. NotInCore where it does not have one of the values."""
        self._library = library = core.library
        self._settings = core.escs[0].settings
        self._state.core = core.core
        if self._columns is None:
            self._state.room = size = max(_FRAMES, 2 * core.pages)
            self._rooms = [FrameRoom(library, size) for _ in range(2)]
            self._set_room()
            return
        self._state.room = ROWS
        self._state.gateway_ns = now - 100_000_000
        self._set_columns(core, self._columns)
        self._new_rows()

    def _set_room(self) -> None:
        room = self._rooms[0]
        self._state.frame = c.addressof(room.frames)
        self._state.frame_time = c.addressof(room.times)

    def _set_columns(self, core: NativeCore, columns: Sequence[ColumnOf]) -> None:
        count = len(core.escs)

        def place(number: int) -> tuple[int, bool]:
            value, esc = columns[number]
            return count if esc is None else esc, value.group.value == "info"

        order = sorted(range(len(columns)), key=place)
        self._table = table = (_Column * max(1, len(order)))()
        ages = []
        for at, number in enumerate(order):
            value, esc = columns[number]
            row = table[at]
            where = ([], []) if esc is None else places_of(core.escs[esc].protocol)
            bind(row.of, value, where, esc)
            row.of.esc = 255 if esc is None else esc
            row.per_unit, row.form = value.per_unit, columns[number].form
            if row.of.kind == KCG.OF_AGE:
                ages.append(at)
        places = [place(number) for number in order]
        begins = [bisect_left(places, (n, is_info)) for n in range(count + 1) for is_info in (0, 1)]
        self._order = order
        self._first = (_u32 * len(begins))(*begins)
        self._ages = (_u32 * max(1, len(ages)))(*ages)
        state = self._state
        state.column, state.first = c.addressof(table), c.addressof(self._first)
        state.age, state.ages = c.addressof(self._ages), len(ages)

    def _new_rows(self) -> None:
        assert self._columns is not None
        self._rows = Rows(self._columns)
        times, *addresses = self._rows.addresses()
        self._state.row_time, self._state.rows = times, 0
        values, valid = addresses[: len(self._columns)], addresses[len(self._columns) :]
        for at, number in enumerate(self._order):
            self._table[at].values, self._table[at].valid = values[number], valid[number]

    # --- captures

    def begin(self, payload: bytes) -> bool:
        """Take a data block (of version 2); False where it is damaged: nothing of it is taken."""
        if not self._library.kcg_is_intact(payload, len(payload)):
            return False
        self._payload = payload
        self._count = int.from_bytes(payload[:4], "little")
        self._state.index, self._state.data_at = 0, 4 + 16 * self._count
        return True

    @property
    def next_kind(self) -> int | None:
        """Of the next entry; None at the end of the block."""
        index = self._state.index
        return self._payload[12 + 16 * index] if index < self._count else None

    def skip(self) -> tuple[int, int]:
        """Index of the next entry, and where its data begin: the caller plays it."""
        state, at = self._state, 4 + 16 * self._state.index
        found = state.index, state.data_at
        state.index += 1
        state.data_at += int.from_bytes(self._payload[at + 12 : at + 16], "little")
        return found

    def play(self, last_ns: int) -> tuple[bool, int]:
        """Play on. True at an entry that is the caller's; else the block ends, or there is no room. And the time of the last entry."""
        state = self._state
        state.last = last_ns
        why = self._library.kcg_play(c.byref(state), self._payload, len(self._payload))
        return why == KCG.OTHER_ENTRY, state.last

    # --- plain bytes of one ESC

    def set_bytes(self, period_ns: int) -> None:
        """Times: a live frame each ``period_ns``."""
        layout = Layout("", "", ())
        self._finder = NativeCore(self._library, [self._settings], layout, 0, False)
        self._finder.state.mask = 0  # no events
        self._state.finder = self._finder.core
        self._state.period = period_ns

    def play_bytes(self, data: bytes, begin: int, ended: bool) -> bool:
        """The stream from ``begin`` on, which is not after ``position``. True where there was no room for all of it."""
        state = self._state
        state.base = begin
        why = self._library.kcg_play_bytes(c.byref(state), data, len(data), ended)
        state.sure = state.count
        return bool(why == KCG.IS_FULL)

    @property
    def position(self) -> int:
        """Bytes that were played."""
        return int(self._state.fed)

    @property
    def counters(self) -> Counters:
        """Of what found the frames."""
        return self._finder.escs[0].counters

    # --- what came of it

    def on_event(self, esc: int, events: int, now: int) -> None:
        self._library.kcg_row_event(c.byref(self._state), esc, events, now)

    def take_frames(self, final: bool = False) -> Frames:
        """The frames that are sure: those of the last turn are only by the next entry, or because there is none (``final``)."""
        state = self._state
        sure = state.count if final else state.sure
        if self._columns is not None or not sure:
            return Frames(FrameRoom(self._library, 0), 0, 0)
        taken, other = self._rooms
        taken.move_to(other, sure, state.count - sure)
        state.count, state.sure = state.count - sure, 0
        self._rooms.reverse()
        self._set_room()
        return Frames(taken, 0, sure)

    @property
    def is_full(self) -> bool:
        """True where rows must be taken before more is played."""
        return bool(self._state.rows + KCG.MAX_ROWS > self._state.room)

    def rows_so_far(self) -> Rows:
        """The rows that are complete. Later ones are appended to them, until ``take_rows``."""
        self._rows.count = self._state.rows
        return self._rows

    def take_rows(self, final: bool = False) -> Rows:
        """The rows that are complete; ``final``: also the one that is open."""
        if final:
            self._library.kcg_close_row(c.byref(self._state))
        found = self.rows_so_far()
        self._new_rows()
        return found
