"""Blocks of rows as text: the same lines as text.py makes of single rows, column by column."""

import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import UTC as UTC_ZONE
from datetime import datetime
from itertools import repeat
from typing import Any

from kontronik_can_gw.offline.tables.blocks import Block, BlockColumn
from kontronik_can_gw.offline.tables.fields import TIME, UTC, Field, Kind

SECOND_NS = 1_000_000_000
ROWS = 4096
"""Rows at a time."""
_MOST_TEXTS = 1 << 16


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
        nothing = "" if is_csv else "null"
        self._nothing = prefix + nothing
        self._made: Callable[[Any], str] = lambda value: f"{prefix}{value}"
        if field.kind is Kind.TEXT:
            quote = csv_text if is_csv else lambda text: json.dumps(text, ensure_ascii=False)
            texts = [prefix + quote(text) for _, text in field.texts]
            self._made = lambda place: texts[place] if place >= 0 else self._nothing
        elif field.kind is Kind.FLOAT:
            # a float signal may be infinite, which JSON does not know
            self._made = lambda value: f"{prefix}{value}" if math.isfinite(value) else self._nothing
        self._known: _Texts | None = _Texts(self._made)
        """None where hardly a value comes twice."""

    def of(self, column: BlockColumn) -> list[str]:
        """Of length 1 where all rows have the same."""
        values = column.values.tolist()
        known = self._known
        if known is None:
            texts = list(map(self._made, values))
        else:
            before = len(known)
            texts = list(map(known.__getitem__, values))
            if len(values) > 1 and len(known) - before > len(values) // 2:
                self._known = None
        if column.valid is None:
            return texts
        nothing = self._nothing
        return [text if there else nothing for text, there in zip(texts, column.valid.tolist(), strict=True)]


class BlockText:
    """Makes the lines of blocks, as bytes."""

    def __init__(self, fields: Sequence[Field], is_csv: bool, has_utc: bool) -> None:
        self._columns = [_ColumnText(field, is_csv) for field in fields]
        self._is_csv = is_csv
        self._has_utc = has_utc
        self._utc = UtcText()
        self._between = "," if is_csv else ", "
        self._begin = "" if is_csv else f'{{"{TIME}": '
        self._end = "\n" if is_csv else "}\n"
        self._seconds = _Texts(lambda second: f"{self._begin}{second}")
        self._fractions = _Texts(_fraction)

    def lines(self, block: Block) -> Iterator[bytes]:
        """All lines, some at a time."""
        for first in range(0, len(block), ROWS):
            yield self._some(block.of(first, first + ROWS))

    def _some(self, block: Block) -> bytes:
        rows = len(block)
        parts: list[Iterable[str]] = [self._times(block.times_ns.tolist())]
        if self._has_utc:
            parts.append(self._utc_texts(block, rows))
        same: list[str] = []
        for text, column in zip(self._columns, block.columns, strict=True):
            texts = text.of(column)
            if len(texts) == 1 and rows > 1:
                same.append(texts[0])
                continue
            if same:
                parts.append(repeat(self._between.join(same), rows))
                same = []
            parts.append(texts)
        if same:
            parts.append(repeat(self._between.join(same), rows))
        lines = map(self._between.join, zip(*parts, strict=True))
        return (self._end.join(lines) + self._end).encode()

    def _times(self, times_ns: list[int]) -> list[str]:
        if times_ns[0] < 0:
            return [self._begin + seconds_text(time_ns) for time_ns in times_ns]
        seconds, fractions = self._seconds, self._fractions
        return [seconds[time_ns // SECOND_NS] + fractions[time_ns % SECOND_NS] for time_ns in times_ns]

    def _utc_texts(self, block: Block, rows: int) -> list[str]:
        walls: list[int | None] = [None] * rows if block.walls_ns is None else block.walls_ns.tolist()
        texts = [self._utc(wall_ns) for wall_ns in walls]
        return texts if self._is_csv else [f'"{UTC}": ' + (f'"{text}"' if text else "null") for text in texts]
