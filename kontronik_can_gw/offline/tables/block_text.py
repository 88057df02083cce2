"""Blocks of rows as text: the same lines as text.py makes of single rows, column by column."""

import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import UTC as UTC_ZONE
from datetime import datetime
from itertools import chain, repeat
from operator import add
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.offline.tables.blocks import Block, BlockColumn
from kontronik_can_gw.offline.tables.fields import TIME, UTC, Field, Kind

if TYPE_CHECKING:
    from numpy.typing import NDArray

SECOND_NS = 1_000_000_000
ROWS = 4096
"""Lines of CSV at a time; those of JSON are several times as long."""
_MOST_TEXTS = 1 << 16
_MOST_IN_TABLE = 1 << 14
_LARGEST = 1 << 62
_SELDOM = 16
"""A column that changes with fewer than one in so many rows changes seldom."""


def seconds_text(time_ns: int) -> str:
    """Exact decimal seconds: 6 digits where that is exact, else 9."""
    sign = "-" if time_ns < 0 else ""
    seconds, rest = divmod(abs(time_ns), SECOND_NS)
    return f"{sign}{seconds}{_fraction(rest)}"


def _fraction(rest: int) -> str:
    return f".{rest:09d}" if rest % 1000 else f".{rest // 1000:06d}"


class UtcText:
    """Unix times as ISO 8601 with microseconds: ``2023-11-14T22:13:20.123456Z``; empty where it is no date."""

    def __init__(self) -> None:
        self._second = -1
        self._text = ""

    def __call__(self, wall_ns: int | None) -> str:
        if wall_ns is None:
            return ""
        second, rest = divmod(wall_ns, SECOND_NS)
        if second != self._second:
            self._second = second
            try:
                self._text = datetime.fromtimestamp(second, UTC_ZONE).strftime("%Y-%m-%dT%H:%M:%S")
            except (ValueError, OverflowError, OSError):
                self._text = ""
        return f"{self._text}.{rest // 1000:06d}Z" if self._text else ""


def csv_text(text: str) -> str:
    """Quoted where it has to be."""
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in '",\r\n') else text


class _Texts(dict[Any, str]):
    """Texts of values, made once each."""

    def __init__(self, made: Callable[[Any], str]) -> None:
        self._made = made

    def __missing__(self, value: Any) -> str:
        if len(self) >= _MOST_TEXTS:
            self.clear()
        text = self[value] = self._made(value)
        return text


class _ColumnText:
    """The texts of one field, with what stands in front of each."""

    def __init__(self, field: Field, is_csv: bool) -> None:
        prefix = "" if is_csv else json.dumps(field.name) + ": "
        self._nothing = prefix + ("" if is_csv else "null")
        self._is_float = field.kind is Kind.FLOAT
        self._prefix = prefix
        self._quoted: list[str] | None = None
        if field.kind is Kind.TEXT:
            quote = csv_text if is_csv else lambda text: json.dumps(text, ensure_ascii=False)
            self._quoted = [*(prefix + quote(text) for _, text in field.texts), self._nothing]  # the place -1 is none
        self._floats = _Texts(self._of_float)
        self._table: Any = None
        self._first = 0  # of the table

    def of(self, column: BlockColumn) -> list[str]:
        """Of as many as the column has."""
        texts = self._texts(column)
        if column.valid is None:
            return texts
        nothing = self._nothing
        return [text if there else nothing for text, there in zip(texts, column.valid.tolist(), strict=True)]

    def _texts(self, column: BlockColumn) -> list[str]:
        numbers = column.numbers
        if self._quoted is not None:
            return list(map(self._quoted.__getitem__, numbers.tolist()))
        if numbers.dtype.kind == "f":
            return list(map(self._floats.__getitem__, numbers.tolist()))
        low, high = int(numbers.min()), int(numbers.max())
        if not self._has(low, high, len(numbers), column.divisor):
            return self._made(column.values.tolist())
        found: list[str] = self._table[numbers - self._first].tolist()
        return found

    def _has(self, low: int, high: int, count: int, divisor: int) -> bool:
        """Make the texts of all numbers in this range, where that is worth it."""
        import numpy as np  # who has blocks has it

        behind = self._first if self._table is None else self._first + len(self._table)
        if self._table is not None and self._first <= low and high < behind:
            return True
        if high - low > 4 * count:
            return False
        first, last = (low, high) if self._table is None else (min(low, self._first), max(high, behind - 1))
        if last - first >= _MOST_IN_TABLE:  # a counter, which goes on for ever
            return False
        room = (last - first) // 4  # it may go on a little
        numbers = np.arange(max(first - room, -_LARGEST), min(last + room, _LARGEST) + 1)
        self._table = np.array(self._made((numbers if divisor == 1 else numbers / divisor).tolist()), object)
        self._first = int(numbers[0])
        return True

    def _made(self, values: list[Any]) -> list[str]:
        """Texts of finite numbers."""
        texts = list(map(str, values))
        return [self._prefix + text for text in texts] if self._prefix else texts

    def _of_float(self, value: float) -> str:
        # a float signal may be infinite, which JSON does not know
        return f"{self._prefix}{value}" if math.isfinite(value) else self._nothing


class BlockText:
    """Makes the lines of blocks, as bytes. Columns that change seldom are put together, so that a line has fewer parts."""

    def __init__(self, fields: Sequence[Field], is_csv: bool, has_utc: bool) -> None:
        self._columns = [_ColumnText(field, is_csv) for field in fields]
        self._is_csv = is_csv
        self._has_utc = has_utc
        self._utc = UtcText()
        self._between = "," if is_csv else ", "
        self._begin = "" if is_csv else f'{{"{TIME}": '
        self._end = "\n" if is_csv else "}\n"
        self._fractions = _Texts(_fraction)

    def lines(self, block: Block) -> Iterator[bytes]:
        """All lines, some at a time."""
        rows = ROWS if self._is_csv else ROWS // 4
        for first in range(0, len(block), rows):
            yield self._some(block.of(first, first + rows))

    def _some(self, block: Block) -> bytes:
        rows = len(block)
        parts: list[Iterable[str]] = [self._times(block.times_ns)]
        if self._has_utc:
            parts.append(self._utc_texts(block, rows))
        slow: list[tuple[_ColumnText, BlockColumn, NDArray[Any] | None]] = []
        for text, column in zip(self._columns, block.columns, strict=True):
            changes = None if column.is_same else _changes(column)
            if changes is None or len(changes) <= rows // _SELDOM:
                slow.append((text, column, changes))
                continue
            if slow:
                parts.append(self._together(slow, rows))
                slow = []
            parts.append(text.of(column))
        if slow:
            parts.append(self._together(slow, rows))
        lines = map(self._between.join, zip(*parts, strict=True))
        return (self._end.join(lines) + self._end).encode()

    def _together(self, slow: "list[tuple[_ColumnText, BlockColumn, NDArray[Any] | None]]", rows: int) -> Iterable[str]:
        """Columns that change seldom as one."""
        import numpy as np

        changes = [found for _, _, found in slow if found is not None]
        if not changes:
            return repeat(self._between.join(text.of(column)[0] for text, column, _ in slow), rows)
        starts = np.unique(np.concatenate([[0], *changes]))
        texts = [
            repeat(text.of(column)[0], len(starts)) if found is None else text.of(column.at(starts))
            for text, column, found in slow
        ]
        lengths = np.diff(starts, append=rows).tolist()
        return chain.from_iterable(map(repeat, map(self._between.join, zip(*texts, strict=True)), lengths))

    def _times(self, times_ns: "NDArray[Any]") -> Iterable[str]:
        begin = self._begin
        if int(times_ns[0]) < 0:
            return [begin + seconds_text(time_ns) for time_ns in times_ns.tolist()]
        seconds = times_ns // SECOND_NS
        fractions = map(self._fractions.__getitem__, (times_ns - seconds * SECOND_NS).tolist())
        texts = {second: f"{begin}{second}" for second in range(int(seconds[0]), int(seconds[-1]) + 1)}
        return map(add, map(texts.__getitem__, seconds.tolist()), fractions)

    def _utc_texts(self, block: Block, rows: int) -> list[str]:
        walls: list[int | None] = [None] * rows if block.walls_ns is None else block.walls_ns.tolist()
        texts = [self._utc(wall_ns) for wall_ns in walls]
        return texts if self._is_csv else [f'"{UTC}": ' + (f'"{text}"' if text else "null") for text in texts]


def _changes(column: BlockColumn) -> "NDArray[Any]":
    """The rows at which something else begins."""
    numbers, valid = column.numbers, column.valid
    other = numbers[1:] != numbers[:-1]
    if valid is not None:
        other |= valid[1:] != valid[:-1]
    found: NDArray[Any] = other.nonzero()[0] + 1
    return found
