"""Tables as text: CSV and JSON lines. Each column keeps the texts of the values that it had."""

import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from datetime import UTC as UTC_ZONE
from datetime import datetime
from operator import getitem
from typing import IO, TYPE_CHECKING

from kontronik_can_gw.desk.recordings.blocks import RowBlock
from kontronik_can_gw.desk.recordings.columns import Known, Values
from kontronik_can_gw.desk.recordings.fields import TIME, UTC, Field, Kind, Table
from kontronik_can_gw.desk.recordings.tables.rows import SECOND_NS, Row, rows_of_block
from kontronik_can_gw.native import load
from kontronik_can_gw.signals.unpacker import Value

if TYPE_CHECKING:
    from kontronik_can_gw.native.offline import Lines

_LINES = 256
"""Lines that gather before they are written."""
_END_OF_YEARS_NS = 253_402_300_800 * SECOND_NS
"""The year 10000."""
Cell = Callable[[Value], str]
"""What gives the text of a value."""
Style = tuple[str, str, str, str, str]
"""As native.offline.Style."""


def seconds_text(time_ns: int) -> str:
    """Exact decimal seconds: 6 digits where that is exact, else 9."""
    sign = "-" if time_ns < 0 else ""
    seconds, rest = divmod(abs(time_ns), SECOND_NS)
    return f"{sign}{seconds}.{rest:09d}" if rest % 1000 else f"{sign}{seconds}.{rest // 1000:06d}"


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


def _csv_cell(_: Field) -> Cell:
    return lambda value: csv_text(value) if isinstance(value, str) else _number(value, "")


def _json_cell(field: Field) -> Cell:
    key = f"{json.dumps(field.name)}: "

    def cell(value: Value) -> str:
        if isinstance(value, str):
            return key + json.dumps(value, ensure_ascii=False)
        return key + _number(value, "null")

    return cell


def _number(value: float | None, nothing: str) -> str:
    """A float signal may be infinite, which JSON does not know."""
    return nothing if value is None or not math.isfinite(value) else str(value)


class _Lines:
    """Lines of text, a row each. A part of a row that is the one of the row before is not put into words again."""

    def __init__(
        self, file: IO[bytes], table: Table, cell: Callable[[Field], Cell], style: Style
    ) -> None:
        self._file = file
        self._table, self._cell, self._style = table, cell, style
        self._at_once: Lines | None = None
        self._utc = UtcText()
        cells = [Known(cell(one)) for one in table.fields]
        self._cells = [[cells[index] for index in part] for part in table.parts()]
        self._parts: list[Values | None] = [None] * len(self._cells)
        self._texts = [""] * len(self._cells)
        self._lines: list[str] = []
        self._separator = ","

    def _in_words(self, parts: Sequence[Values | None]) -> list[str]:
        """The text of each part; of one of another frame the one that it had last."""
        known, texts = self._parts, self._texts
        for index, part in enumerate(parts):
            if part is not known[index] and part is not None:
                known[index] = part
                texts[index] = self._separator.join(map(getitem, self._cells[index], part))
        return texts

    def _put(self, line: str) -> None:
        self._lines.append(line)
        if len(self._lines) >= _LINES:
            self.close()

    def write(self, row: Row) -> None:
        """Add a row."""
        raise NotImplementedError

    def write_block(self, block: RowBlock) -> None:
        """Add many rows."""
        times, wall_ns = block.times, block.wall_ns or 0
        begin, end = block.begin, block.end
        if not 0 <= times[0] + wall_ns <= times[-1] + wall_ns < _END_OF_YEARS_NS:
            found: Iterable[bytes | int] = range(begin, end)
        else:
            if self._at_once is None:
                self._at_once = self._lines_at_once()
            found = self._at_once.of(block.rows, begin, end, block.origin_ns, wall_ns)
        for part in found:
            if isinstance(part, int):
                for row in rows_of_block(replace(block, begin=part, end=part + 1)):
                    self.write(row)
            else:
                self.close()
                self._file.write(part)

    def _lines_at_once(self) -> "Lines":
        from kontronik_can_gw.native.offline import Lines, Style

        head, utc, utc_end, end, nothing = (text.encode() for text in self._style)
        style = Style(head, utc if self._table.has_utc else None, utc_end, end, nothing)
        cells = []
        for one in self._table.fields:
            cell = self._cell(one)
            nothing_here = cell(None)
            prefix = self._separator + nothing_here[: len(nothing_here) - len(self._style[-1])]
            words = None
            if one.kind is Kind.TEXT:
                skip = len(prefix) - len(self._separator)
                words = [(number, cell(text)[skip:].encode()) for number, text in one.texts]
            cells.append((prefix.encode(), words))
        return Lines(load.library()[0], style, cells)

    def close(self) -> None:
        """Write what has gathered."""
        self._file.write("".join(self._lines).encode())
        self._lines.clear()

    def discard(self) -> None:
        """Nothing is held but text."""


class CsvTable(_Lines):
    """RFC 4180 without its carriage returns: a header of names with units, comma, decimal point, UTF-8; empty where not available."""

    def __init__(self, file: IO[bytes], table: Table) -> None:
        super().__init__(file, table, _csv_cell, ("", ",", "", "\n", ""))
        self._has_utc = table.has_utc
        self._nothing = ["," * (len(part) - 1) for part in table.parts()]
        heads = [f"{TIME} [s]", *([UTC] if table.has_utc else [])]
        heads += [one.header for one in table.fields]
        self._put(",".join(map(csv_text, heads)) + "\n")

    def write(self, row: Row) -> None:
        """Add a row."""
        time_ns, wall_ns, parts = row
        texts = self._in_words(parts)
        if None in parts:
            both = zip(parts, texts, self._nothing, strict=True)
            texts = [nothing if part is None else text for part, text, nothing in both]
        utc = f",{self._utc(wall_ns)}" if self._has_utc else ""
        self._put(f"{seconds_text(time_ns)}{utc},{','.join(texts)}\n")


class JsonTable(_Lines):
    """One object a line, keys are the names of the fields; null where not available. ``units``: a first line with the units."""

    def __init__(self, file: IO[bytes], table: Table, units: bool = False) -> None:
        style = (f'{{"{TIME}": ', f', "{UTC}": "', '"', "}\n", "null")
        super().__init__(file, table, _json_cell, style)
        self._separator = ", "
        self._has_utc = table.has_utc
        if units:
            known = {TIME: "s"} | {one.name: one.unit for one in table.fields if one.unit}
            self._put(json.dumps({"units": known}, ensure_ascii=False) + "\n")

    def write(self, row: Row) -> None:
        """Add a row."""
        time_ns, wall_ns, parts = row
        texts = self._in_words(parts)
        if None in parts:
            texts = [text for part, text in zip(parts, texts, strict=True) if part is not None]
        head = f'{{"{TIME}": {seconds_text(time_ns)}'
        if self._has_utc:
            # a single row may have no Unix time, as before a damaged one
            utc = self._utc(wall_ns)
            head = f'{head}, "{UTC}": "{utc}"' if utc else f'{head}, "{UTC}": null'
        self._put(f"{head}, {', '.join(texts)}}}\n")
