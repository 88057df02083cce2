"""What comes of a recording that the core in C plays at full speed (player.py): frames and rows in blocks, and their text (offline.c)."""

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
_Word, _Cell = structure("kcg_word"), structure("kcg_cell")
Style: Any = structure("kcg_style")
"""Of lines: what stands before the time, before and after the Unix time (None: none), at the end, for what is not available."""


def _address(memory: bytearray) -> int:
    """Of memory that is there, and is not made longer, while the address is used."""
    return c.addressof(c.c_char.from_buffer(memory))


class FrameRoom:
    """Room for frames, their times and the text of both, used again and again."""

    def __init__(self, library: Any, size: int) -> None:
        self.library, self.size = library, size
        self.frames, self.times = (Frame * size)(), (c.c_int64 * size)()
        self._text: Any = None

    def move_to(self, other: "FrameRoom", begin: int, count: int) -> None:
        """Copy some to the beginning of another one."""
        for mine, its, size in (
            (self.frames, other.frames, c.sizeof(Frame)),
            (self.times, other.times, 8),
        ):
            c.memmove(its, c.addressof(mine) + size * begin, size * count)

    def candump(self, begin: int, end: int, shift_ns: int, channel: str) -> memoryview:
        """As Frames.candump."""
        name, count = channel.encode(), end - begin
        room = count * (len(name) + 190)
        if self._text is None or len(self._text) < room:
            self._text = c.create_string_buffer(self.size * (len(name) + 190))
        length = self.library.kcg_candump(
            c.byref(self.frames, begin * c.sizeof(Frame)),
            c.byref(self.times, begin * 8),
            *(count, shift_ns, name, self._text),
        )
        return memoryview(self._text).cast("B")[:length]


class Frames:
    """Frames that were sent: ``times`` in ns, which do not decrease. They are there until the one after the next is taken."""

    def __init__(self, room: FrameRoom, begin: int, end: int) -> None:
        self._room, self._begin, self._end = room, begin, end
        self.times = memoryview(room.times).cast("B").cast("q")[begin:end]

    def __len__(self) -> int:
        return self._end - self._begin

    def part(self, begin: int, end: int) -> "Frames":
        """Some of them."""
        return Frames(self._room, self._begin + begin, self._begin + end)

    def __iter__(self) -> Iterator[tuple[int, CanFrame]]:
        memory = memoryview(self._room.frames).cast("B")
        frames = frames_in(memory, self._begin * c.sizeof(Frame), len(self))
        return zip(self.times, frames, strict=True)

    def candump(self, shift_ns: int, channel: str) -> memoryview:
        """Lines of a candump log, with microseconds of the time and ``shift_ns``; to be written before others are asked for."""
        return self._room.candump(self._begin, self._end, shift_ns, channel)


class ColumnOf(NamedTuple):
    """A value that is wanted in a column. ``esc``: its index, None for the gateway."""

    value: Value
    esc: int | None

    @property
    def form(self) -> Any:
        """How steps become a number of its unit."""
        per_unit = self.value.per_unit
        if self.value.divisor is Divisor.ONE:
            if self.value.names or per_unit == 1:
                return KCG.WHOLE
            if 10**6 % per_unit == 0:
                return KCG.DIVIDED
        return KCG.ROUNDED


class Rows:
    """Rows as columns: ``times`` in ns, and of each column ``values`` (int64 or float64) and ``valid`` (a bit a row, lowest first)."""

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
        """What stands where a row is not valid has no meaning."""
        values = memoryview(self._values[column])
        return (values.cast("d") if self.is_real[column] else values.cast("q"))[: self.count]

    def numbers(self, column: int, begin: int, end: int) -> list[float | None]:
        """Of the rows ``begin`` to ``end``; None where not available."""
        found: list[float | None] = self.values(column)[begin:end].tolist()
        first = begin >> 3
        for at, bits in enumerate(self.valid[column][first : (end + 7) >> 3], first):
            if bits == 0xFF:
                continue
            for row in range(max(8 * at, begin), min(8 * at + 8, end)):
                if not bits >> (row & 7) & 1:
                    found[row - begin] = None
        return found

    def addresses(self) -> list[int]:
        """Of the times, then of each column's values and valid bits."""
        every = (self._times, *self._values, *self.valid)
        return [*map(_address, every)]


class Lines:
    """Text of rows. Each cell: what stands before it, and texts by number; None for a number itself."""

    def __init__(
        self,
        library: Any,
        style: Style,
        cells: Sequence[tuple[bytes, Sequence[tuple[int, bytes]] | None]],
    ) -> None:
        self._library, self._style = library, style
        self._cells = (_Cell * max(1, len(cells)))()
        self._longest = 128
        self._kept: list[Any] = []
        self._out = c.create_string_buffer(_TEXT)
        for cell, (prefix, words) in zip(self._cells, cells, strict=False):
            cell.prefix = prefix
            self._longest += len(prefix) + 32
            if words is not None:
                table = (_Word * max(1, len(words)))(*starmap(_Word, words))
                self._kept.append(table)
                cell.word, cell.words = c.addressof(table), len(words)
                self._longest += max((len(text) for _, text in words), default=0)

    def of(
        self, rows: Rows, begin: int, end: int, origin_ns: int, wall_ns: int
    ) -> Iterator[bytes | int]:
        """Lines of the rows ``begin`` to ``end``; for a row that needs another way its index. ``wall_ns`` added, times are Unix times."""
        times, *addresses = rows.addresses()
        count = len(rows.columns)
        for at in range(count):
            cell = self._cells[at]
            cell.values, cell.valid = addresses[at], addresses[count + at]
            cell.is_real = rows.is_real[at]
        done = c.c_uint32(begin)
        while done.value < end:
            length = self._library.kcg_lines(
                *(self._cells, count, c.byref(self._style), times, done.value, end),
                *(origin_ns, wall_ns, self._out, _TEXT, self._longest, c.byref(done)),
            )
            if length:
                yield c.string_at(self._out, length)
            elif done.value < end:
                yield done.value
                done.value += 1
