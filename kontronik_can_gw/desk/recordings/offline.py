"""Frames and rows of a recording that the core in C plays (player.py), and their text."""

import ctypes as c
from collections.abc import Iterator, Sequence
from itertools import starmap
from typing import Any, NamedTuple

from kontronik_can_gw.esc.values import Divisor, Value
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.native.binding import Frame, frames_in
from kontronik_can_gw.native.header import KCG, structure

ROWS = 1 << 13
_TEXT = 1 << 20
_Word = structure("kcg_word")
_Cell = structure("kcg_cell")
Style: Any = structure("kcg_style")
"""Texts of lines: before the time, around the Unix time (or None), at the end, for no value."""


def _address(memory: bytearray) -> int:
    """Return the address of memory. While it is used, the memory must exist and must not grow."""
    return c.addressof(c.c_char.from_buffer(memory))


class FrameRoom:
    """Memory for frames, their times and their text. It is used again and again."""

    def __init__(self, library: Any, size: int) -> None:
        self.library = library
        self.size = size
        self.frames = (Frame * size)()
        self.times = (c.c_int64 * size)()
        self._text: Any = None

    def move_to(self, other: "FrameRoom", begin: int, count: int) -> None:
        """Copy ``count`` frames from index ``begin`` on to the beginning of another room."""
        size = c.sizeof(Frame)
        first_frame = c.addressof(self.frames) + size * begin
        c.memmove(other.frames, first_frame, size * count)
        first_time = c.addressof(self.times) + 8 * begin
        c.memmove(other.times, first_time, 8 * count)

    def candump(
        self,
        begin: int,
        end: int,
        shift_ns: int,
        channel: str,
    ) -> memoryview:
        """Return lines of a candump log (see Frames.candump)."""
        name = channel.encode()
        count = end - begin
        longest_line = len(name) + 190
        if self._text is None or len(self._text) < count * longest_line:
            self._text = c.create_string_buffer(self.size * longest_line)
        frames = c.byref(self.frames, begin * c.sizeof(Frame))
        times = c.byref(self.times, begin * 8)
        length = self.library.kcg_candump(
            frames,
            times,
            count,
            shift_ns,
            name,
            self._text,
        )
        return memoryview(self._text).cast("B")[:length]


class Frames:
    """Frames that were sent, with ``times`` in ns that do not decrease.

    They remain valid until ``take_frames`` has been called twice more.
    """

    def __init__(self, room: FrameRoom, begin: int, end: int) -> None:
        self._room = room
        self._begin = begin
        self._end = end
        all_times = memoryview(room.times).cast("B").cast("q")
        self.times = all_times[begin:end]

    def __len__(self) -> int:
        return self._end - self._begin

    def part(self, begin: int, end: int) -> "Frames":
        """Return the frames ``begin`` to ``end``."""
        return Frames(self._room, self._begin + begin, self._begin + end)

    def __iter__(self) -> Iterator[tuple[int, CanFrame]]:
        memory = memoryview(self._room.frames).cast("B")
        first_byte = self._begin * c.sizeof(Frame)
        frames = frames_in(memory, first_byte, len(self))
        return zip(self.times, frames, strict=True)

    def candump(self, shift_ns: int, channel: str) -> memoryview:
        """Return lines of a candump log, with the microseconds of time + ``shift_ns``.

        They are valid until the next call.
        """
        return self._room.candump(self._begin, self._end, shift_ns, channel)


class ColumnOf(NamedTuple):
    """A value for a column. ``esc`` is the index of the ESC, or None for the gateway."""

    value: Value
    esc: int | None

    @property
    def form(self) -> Any:
        """Return how steps become a number of the value's unit (kcg_column.form)."""
        per_unit = self.value.per_unit
        if self.value.divisor is Divisor.ONE:
            if self.value.names or per_unit == 1:
                return KCG.WHOLE
            if 10**6 % per_unit == 0:
                return KCG.DIVIDED
        return KCG.ROUNDED


class Rows:
    """Rows, stored as columns.

    ``times`` are in ns. Each column has ``values`` (int64 or float64) and ``valid``: a bit for each
    row, lowest bit first.
    """

    def __init__(self, columns: Sequence[ColumnOf]) -> None:
        self.columns = columns
        self.count = 0
        self._times = bytearray(8 * ROWS)
        self._values = [bytearray(8 * ROWS) for _ in columns]
        self.valid = [bytearray(ROWS // 8) for _ in columns]
        self.is_real = [column.form != KCG.WHOLE for column in columns]

    @property
    def times(self) -> memoryview:
        return memoryview(self._times).cast("q")[: self.count]

    def values(self, column: int) -> Any:
        """Return the values of a column. Values of rows that are not valid have no meaning."""
        values = memoryview(self._values[column])
        if self.is_real[column]:
            return values.cast("d")[: self.count]
        return values.cast("q")[: self.count]

    def numbers(self, column: int, begin: int, end: int) -> list[float | None]:
        """Return the values of the rows ``begin`` to ``end``, with None for not available."""
        found: list[float | None] = self.values(column)[begin:end].tolist()
        first = begin >> 3
        last = (end + 7) >> 3
        valid = self.valid[column][first:last]
        for at, bits in enumerate(valid, first):
            if bits == 0xFF:
                continue
            first_row = max(8 * at, begin)
            last_row = min(8 * at + 8, end)
            for row in range(first_row, last_row):
                if not bits >> (row & 7) & 1:
                    found[row - begin] = None
        return found

    def addresses(self) -> list[int]:
        """Return addresses: of the times, of each column's values, of each column's valid bits."""
        arrays = [self._times, *self._values, *self.valid]
        return [_address(array) for array in arrays]


class Lines:
    """Text of rows. Each cell has a text before it, and texts of numbers or None for the number."""

    def __init__(
        self,
        library: Any,
        style: Style,
        cells: Sequence[tuple[bytes, Sequence[tuple[int, bytes]] | None]],
    ) -> None:
        self._library = library
        self._style = style
        self._cells = (_Cell * max(1, len(cells)))()
        self._longest = 128
        self._kept: list[Any] = []
        self._out = c.create_string_buffer(_TEXT)
        for cell, (prefix, words) in zip(self._cells, cells, strict=False):
            cell.prefix = prefix
            self._longest += len(prefix) + 32
            if words is not None:
                room = max(1, len(words))
                table = (_Word * room)(*starmap(_Word, words))
                self._kept.append(table)
                cell.word = c.addressof(table)
                cell.words = len(words)
                lengths = [len(text) for _, text in words]
                self._longest += max(lengths, default=0)

    def of(
        self,
        rows: Rows,
        begin: int,
        end: int,
        origin_ns: int,
        wall_ns: int,
    ) -> Iterator[bytes | int]:
        """Yield lines of the rows ``begin`` to ``end``, or the index of a row that C cannot write.

        With ``wall_ns`` added, times are Unix times.
        """
        times, *addresses = rows.addresses()
        count = len(rows.columns)
        for at in range(count):
            cell = self._cells[at]
            cell.values = addresses[at]
            cell.valid = addresses[count + at]
            cell.is_real = rows.is_real[at]
        done = c.c_uint32(begin)
        while done.value < end:
            length = self._library.kcg_lines(
                self._cells,
                count,
                c.byref(self._style),
                times,
                done.value,
                end,
                origin_ns,
                wall_ns,
                self._out,
                _TEXT,
                self._longest,
                c.byref(done),
            )
            if length:
                yield c.string_at(self._out, length)
            elif done.value < end:
                yield done.value
                done.value += 1
