"""Plays a recording with the core in C at full speed (offline.c): a capture, or bytes of one ESC.

A Player leaves rare entries to the caller, which gives them to the same core through its Gateway.
The Player is one of the Gateway's outputs, so that its rows contain their events.
"""

import ctypes as c
from bisect import bisect_left
from collections.abc import Sequence

from kontronik_can_gw.core.output import Output
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.desk.recordings.offline import ROWS, ColumnOf, FrameRoom, Frames, Rows
from kontronik_can_gw.esc.decoder import Counters
from kontronik_can_gw.native.core import NativeCore
from kontronik_can_gw.native.header import KCG, structure
from kontronik_can_gw.native.tables import Places, bind, places_of
from kontronik_can_gw.signals.plan import MessageLayout

_FRAMES = 1 << 12
_u32 = c.c_uint32


_Offline = structure("kcg_offline")
_Column = structure("kcg_column")


class Player(Output):
    """Plays a recording.

    It makes rows of the values in ``columns``, or frames if ``columns`` is None.
    """

    def __init__(self, columns: Sequence[ColumnOf] | None = None) -> None:
        super().__init__()
        self._columns = columns
        self._state = _Offline()
        self._payload = b""
        self._count = 0

    def bind(self, core: NativeCore, now: int) -> None:
        """Use this core for playing. Raises NotInCore if it does not have one of the values."""
        library = core.library
        self._library = library
        self._settings = core.escs[0].settings
        self._state.core = core.core
        if self._columns is None:
            size = max(_FRAMES, 2 * core.pages)
            self._state.room = size
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
            esc_number = count if esc is None else esc
            return esc_number, value.group.value == "info"

        order = sorted(range(len(columns)), key=place)
        rows = max(1, len(order))
        table = (_Column * rows)()
        self._table = table
        ages = []
        for at, number in enumerate(order):
            value, esc = columns[number]
            row = table[at]
            where: Places = ([], [])
            if esc is not None:
                where = places_of(core.escs[esc].protocol)
            bind(row.of, value, where, esc)
            row.of.esc = 255 if esc is None else esc
            row.per_unit = value.per_unit
            row.form = columns[number].form
            if row.of.kind == KCG.OF_AGE:
                ages.append(at)
        places = [place(number) for number in order]
        begins = []
        for esc_number in range(count + 1):
            begins.append(bisect_left(places, (esc_number, False)))
            begins.append(bisect_left(places, (esc_number, True)))
        self._order = order
        self._first = (_u32 * len(begins))(*begins)
        self._ages = (_u32 * max(1, len(ages)))(*ages)
        state = self._state
        state.column = c.addressof(table)
        state.first = c.addressof(self._first)
        state.age = c.addressof(self._ages)
        state.ages = len(ages)

    def _new_rows(self) -> None:
        assert self._columns is not None
        self._rows = Rows(self._columns)
        times, *addresses = self._rows.addresses()
        self._state.row_time = times
        self._state.rows = 0
        values = addresses[: len(self._columns)]
        valid = addresses[len(self._columns) :]
        for at, number in enumerate(self._order):
            column = self._table[at]
            column.values = values[number]
            column.valid = valid[number]

    # --- captures

    def begin(self, payload: bytes) -> bool:
        """Take a data block (of version 2). Return False, and take nothing, if it is damaged."""
        if not self._library.kcg_is_intact(payload, len(payload)):
            return False
        self._payload = payload
        self._count = int.from_bytes(payload[:4], "little")
        self._state.index = 0
        self._state.data_at = 4 + 16 * self._count
        return True

    @property
    def next_kind(self) -> int | None:
        """Kind of the next entry, or None at the end of the block."""
        index = self._state.index
        return self._payload[12 + 16 * index] if index < self._count else None

    def skip(self) -> tuple[int, int]:
        """Skip the next entry, which the caller plays. Return its index and its data's offset."""
        state = self._state
        at = 4 + 16 * state.index
        found = state.index, state.data_at
        state.index += 1
        length = self._payload[at + 12 : at + 16]
        state.data_at += int.from_bytes(length, "little")
        return found

    def play(self, last_ns: int) -> tuple[bool, int]:
        """Play further entries. Return whether the next one is for the caller, and the last time.

        If it is not, the block has ended, or there is no room.
        """
        state = self._state
        state.last = last_ns
        payload = self._payload
        why = self._library.kcg_play(c.byref(state), payload, len(payload))
        return why == KCG.OTHER_ENTRY, state.last

    # --- plain bytes of one ESC

    def set_bytes(self, period_ns: int) -> None:
        """Prepare for plain bytes: they get a time for each live frame, every ``period_ns``."""
        self._finder = NativeCore(
            self._library, CoreSettings([self._settings], MessageLayout("", "", ())), 0
        )
        self._finder.state.mask = 0  # no events
        self._state.finder = self._finder.core
        self._state.period = period_ns

    def play_bytes(self, data: bytes, begin: int, ended: bool) -> bool:
        """Play the stream from ``begin`` on, which is not after ``position``.

        Return True if there was no room for all of it.
        """
        state = self._state
        state.base = begin
        why = self._library.kcg_play_bytes(c.byref(state), data, len(data), ended)
        state.sure = state.count
        return bool(why == KCG.IS_FULL)

    @property
    def position(self) -> int:
        """Number of bytes that were played."""
        return int(self._state.fed)

    @property
    def counters(self) -> Counters:
        """Counters of the core that finds the frames."""
        return self._finder.escs[0].counters

    # --- results

    def on_event(self, esc: int, events: int, now: int) -> None:
        self._library.kcg_row_event(c.byref(self._state), esc, events, now)

    def take_frames(self, final: bool = False) -> Frames:
        """Return the frames that are certain.

        Frames of the last iteration are certain after the next entry, or with ``final`` (the end).
        """
        state = self._state
        sure = state.count if final else state.sure
        if self._columns is not None or not sure:
            return Frames(FrameRoom(self._library, 0), 0, 0)
        taken, other = self._rooms
        taken.move_to(other, sure, state.count - sure)
        state.count -= sure
        state.sure = 0
        self._rooms.reverse()
        self._set_room()
        return Frames(taken, 0, sure)

    @property
    def is_full(self) -> bool:
        """True if rows must be taken before more can be played."""
        return bool(self._state.rows + KCG.MAX_ROWS > self._state.room)

    def rows_so_far(self) -> Rows:
        """Return the complete rows. Later rows are appended to them, until ``take_rows``."""
        self._rows.count = self._state.rows
        return self._rows

    def take_rows(self, final: bool = False) -> Rows:
        """Return the complete rows, and with ``final`` also the row that is open."""
        if final:
            self._library.kcg_close_row(c.byref(self._state))
        found = self.rows_so_far()
        self._new_rows()
        return found
