"""Tables as text: CSV and JSON lines."""

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import UTC as UTC_ZONE
from datetime import datetime
from typing import IO, TYPE_CHECKING

from kontronik_can_gw.desk.recordings.blocks import RowBlock
from kontronik_can_gw.desk.recordings.fields import TIME, UTC, Field, Kind, Table
from kontronik_can_gw.desk.recordings.tables.rows import SECOND_NS, Row, rows_of_block
from kontronik_can_gw.native import load
from kontronik_can_gw.signals.unpacker import Value

if TYPE_CHECKING:
    from kontronik_can_gw.native.offline import Lines

_END_OF_YEARS_NS = 253_402_300_800 * SECOND_NS
"""The year 10000."""


def seconds_text(time_ns: int) -> str:
    """Exact decimal seconds: 6 digits where that is exact, else 9."""
    sign = "-" if time_ns < 0 else ""
    seconds, rest = divmod(abs(time_ns), SECOND_NS)
    return f"{sign}{seconds}.{rest:09d}" if rest % 1000 else f"{sign}{seconds}.{rest // 1000:06d}"


def utc_text(wall_ns: int | None) -> str:
    """ISO 8601 with microseconds: ``2023-11-14T22:13:20.123456Z``; empty where it is no date."""
    if wall_ns is None or not -_END_OF_YEARS_NS < wall_ns < _END_OF_YEARS_NS:
        return ""
    second, rest = divmod(wall_ns, SECOND_NS)
    moment = datetime.fromtimestamp(second, UTC_ZONE)
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{rest // 1000:06d}Z"


def csv_text(text: str) -> str:
    """Quoted where it has to be."""
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in '",\r\n') else text


class TextTable:
    """Lines of text, a row each: ``start``, the time, ``utc`` and the Unix time, each cell, ``end``."""

    start = utc = ""
    utc_end = ""
    end = "\n"
    nothing = ""
    """What stands for a value that is not available."""

    def __init__(self, file: IO[bytes], table: Table) -> None:
        self._file = file
        self._table = table
        self._at_once: Lines | None = None
        self._prefixes = [self.prefix(one) for one in table.fields]

    def prefix(self, field: Field) -> str:
        """What stands in front of a cell."""
        raise NotImplementedError

    def text(self, value: str) -> str:
        """A cell of words."""
        raise NotImplementedError

    def cells(self, values: Sequence[Value]) -> Iterable[tuple[str, Value]]:
        """What stands in front of each cell of a row, and its value."""
        return zip(self._prefixes, values, strict=True)

    def write(self, row: Row) -> None:
        """Add a row."""
        pieces = [self.start, seconds_text(row.time_ns)]
        if self._table.has_utc:
            # a single row may have no Unix time, as before a damaged one
            utc = utc_text(row.wall_ns)
            pieces += [self.utc, utc, self.utc_end] if utc else [self.utc.rstrip('"'), self.nothing]
        for prefix, value in self.cells(row.values):
            pieces.append(prefix)
            if isinstance(value, str):
                pieces.append(self.text(value))
            else:  # a float signal may be infinite, which JSON does not know
                missing = value is None or not math.isfinite(value)
                pieces.append(self.nothing if missing else str(value))
        pieces.append(self.end)
        self._file.write("".join(pieces).encode())

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
                self._file.write(part)

    def _lines_at_once(self) -> "Lines":
        from kontronik_can_gw.native.offline import Lines, Style

        parts = (self.start, self.utc, self.utc_end, self.end, self.nothing)
        start, utc, *rest = (part.encode() for part in parts)
        style = Style(start, utc if self._table.has_utc else None, *rest)
        cells = [
            (
                prefix.encode(),
                [(number, self.text(text).encode()) for number, text in one.texts]
                if one.kind is Kind.TEXT
                else None,
            )
            for prefix, one in zip(self._prefixes, self._table.fields, strict=True)
        ]
        return Lines(load.library()[0], style, cells)

    def close(self) -> None:
        """Nothing is held."""

    discard = close


class CsvTable(TextTable):
    """RFC 4180 without its carriage returns: a header of names with units, comma, decimal point, UTF-8; empty where not available."""

    utc = ","
    text = staticmethod(csv_text)  # type: ignore[assignment]

    def __init__(self, file: IO[bytes], table: Table) -> None:
        super().__init__(file, table)
        heads = [f"{TIME} [s]", *([UTC] if table.has_utc else [])]
        heads += [one.header for one in table.fields]
        file.write((",".join(map(csv_text, heads)) + "\n").encode())

    def prefix(self, field: Field) -> str:  # noqa: ARG002  all the same
        return ","


class JsonTable(TextTable):
    """One object a line, keys are the names of the fields; null where not available. ``units``: a first line with the units."""

    start, utc, utc_end, end, nothing = f'{{"{TIME}": ', f', "{UTC}": "', '"', "}\n", "null"

    def __init__(self, file: IO[bytes], table: Table, units: bool = False) -> None:
        super().__init__(file, table)
        self._messages = table.by_message()
        if units:
            known = {TIME: "s"} | {one.name: one.unit for one in table.fields if one.unit}
            file.write((json.dumps({"units": known}, ensure_ascii=False) + "\n").encode())

    def prefix(self, field: Field) -> str:
        return f", {json.dumps(field.name)}: "

    def text(self, value: str) -> str:
        return json.dumps(value, ensure_ascii=False)

    def cells(self, values: Sequence[Value]) -> Iterable[tuple[str, Value]]:
        """Without those of other messages."""
        if not self._table.by_frame:
            return super().cells(values)
        indices = (0, 1, *self._messages[self._table.message_of(values)])
        return ((self._prefixes[index], values[index]) for index in indices)
