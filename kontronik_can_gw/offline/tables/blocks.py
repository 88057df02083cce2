"""Many rows of a table at once, in columns. Made by offline/bulk; here nothing needs numpy."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.dbc_output.unpacker import Value

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class BlockColumn:
    """The values of one signal: numbers in steps of 1 / ``divisor`` (in all blocks the same), of a text its place
    in the column's texts.

    Of length 1 where all rows have the same. ``valid``: which of the numbers are available; None: all.
    """

    numbers: "NDArray[Any]"
    valid: "NDArray[Any] | None" = None
    divisor: int = 1

    @property
    def values(self) -> "NDArray[Any]":
        """The numbers as they are meant."""
        return self.numbers if self.divisor == 1 else self.numbers / self.divisor

    @property
    def is_same(self) -> bool:
        """True where all rows have the same."""
        return len(self.numbers) == 1

    def of(self, first: int, behind: int) -> "BlockColumn":
        """Of some of the rows."""
        if self.is_same:
            return self
        valid = self.valid
        return BlockColumn(self.numbers[first:behind], None if valid is None else valid[first:behind], self.divisor)

    def at(self, rows: "NDArray[Any]") -> "BlockColumn":
        """Of rows by their numbers."""
        if self.is_same:
            return self
        return BlockColumn(self.numbers[rows], None if self.valid is None else self.valid[rows], self.divisor)

    def listed(self, rows: int, texts: Sequence[str] = ()) -> list[Value]:
        """The values as the streaming way has them."""
        values: list[Value] = self.values.tolist()
        if texts:
            values = [texts[place] if isinstance(place, int) and place >= 0 else None for place in values]
        if self.valid is not None:
            values = [value if there else None for value, there in zip(values, self.valid.tolist(), strict=True)]
        return values * rows if self.is_same else values


@dataclass(frozen=True)
class Block:
    """Rows that follow each other. ``walls_ns``: their Unix times, None where unknown; a column for each chosen signal."""

    times_ns: "NDArray[Any]"
    walls_ns: "NDArray[Any] | None"
    columns: Sequence[BlockColumn]

    def __len__(self) -> int:
        return len(self.times_ns)

    @property
    def time_ns(self) -> int:
        """Of the first row."""
        return int(self.times_ns[0])

    @property
    def last_ns(self) -> int:
        """Of the last row."""
        return int(self.times_ns[-1])

    def since(self, origin_ns: int) -> "Block":
        """With the times counted from there."""
        return Block(self.times_ns - origin_ns, self.walls_ns, self.columns) if origin_ns else self

    def rows_before(self, time_ns: int) -> int:
        """How many rows are earlier; times do not decrease."""
        return int(self.times_ns.searchsorted(time_ns))

    def of(self, first: int, behind: int) -> "Block":
        """Some of the rows."""
        if first == 0 and behind >= len(self):
            return self
        walls = self.walls_ns
        return Block(
            self.times_ns[first:behind],
            None if walls is None else walls[first:behind],
            [column.of(first, behind) for column in self.columns],
        )

    def rows(self, texts: Sequence[Sequence[str]]) -> Iterator[tuple[int, int | None, tuple[Value, ...]]]:
        """Time, Unix time and values of each row. ``texts``: of each column."""
        count = len(self)
        walls: list[int | None] = [None] * count if self.walls_ns is None else self.walls_ns.tolist()
        listed = [found.listed(count, known) for found, known in zip(self.columns, texts, strict=True)]
        yield from zip(self.times_ns.tolist(), walls, zip(*listed, strict=True), strict=True)
