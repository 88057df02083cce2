"""Tables as text: CSV (RFC 4180 without its carriage returns) and JSON lines."""

import json
import math
from collections.abc import Callable
from datetime import UTC as UTC_ZONE
from datetime import datetime
from functools import cached_property, partial
from typing import IO, TYPE_CHECKING

from kontronik_can_gw.desk.recordings.fields import TIME, UTC, Kind, Table
from kontronik_can_gw.desk.recordings.recording import Block, PlayedBlock, Sample
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.native import load

if TYPE_CHECKING:
    from kontronik_can_gw.native.offline import Lines


def seconds_text(time_ns: int) -> str:
    """Exact decimal seconds: 6 digits where that is exact, else 9."""
    seconds, rest = divmod(time_ns, SECOND)
    return f"{seconds}.{rest:09d}" if rest % 1000 else f"{seconds}.{rest // 1000:06d}"


def utc_text(wall_ns: int) -> str:
    """ISO 8601 with microseconds: ``2023-11-14T22:13:20.123456Z``."""
    second, rest = divmod(wall_ns, SECOND)
    moment = datetime.fromtimestamp(second, UTC_ZONE)
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{rest // 1000:06d}Z"


def csv_text(text: str) -> str:
    """Quoted where it has to be."""
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in '",\r\n') else text


class TextTable:
    """A row each line: ``start``, the time, ``utc`` and the Unix time, each cell after its prefix, ``end``. ``nothing``: not available.

    CSV has a header of names with units, JSON an object a line, with the names of the fields as keys.
    """

    def __init__(self, file: IO[bytes], table: Table, is_json: bool) -> None:
        self._file, self._table = file, table
        self._text: Callable[[str], str] = csv_text
        if is_json:
            self._text = partial(json.dumps, ensure_ascii=False)
            self._start, self._utc, self._utc_end = f'{{"{TIME}": ', f', "{UTC}": "', '"'
            self._end, self._nothing = "}\n", "null"
            self._prefixes = [f", {json.dumps(one.name)}: " for one in table.fields]
            return
        self._start, self._utc, self._utc_end, self._end, self._nothing = "", ",", "", "\n", ""
        self._prefixes = [","] * len(table.fields)
        heads = [f"{TIME} [s]", *([UTC] if table.has_utc else [])]
        heads += [one.header for one in table.fields]
        file.write((",".join(map(csv_text, heads)) + "\n").encode())

    def write(self, block: Block) -> None:
        """Add rows."""
        wall_ns = block.wall_ns or 0
        if not isinstance(block, PlayedBlock) or block.times[0] + wall_ns < 0:
            self._write(block)
            return
        begin, end, origin_ns = block.begin, block.end, self._table.origin_ns
        for made in self._lines.of(block.made, begin, end, origin_ns, wall_ns):
            if isinstance(made, int):
                self._write(block.part(made - begin, made - begin + 1))
            else:
                self._file.write(made)

    def _write(self, block: Block) -> None:
        lines = (self._line(row, block.wall_ns) for row in block.rows())
        self._file.write("".join(lines).encode())

    def _line(self, row: Sample, wall_ns: int | None) -> str:
        pieces = [self._start, seconds_text(row.time_ns - self._table.origin_ns)]
        if self._table.has_utc:
            pieces += (self._utc, utc_text(row.time_ns + (wall_ns or 0)), self._utc_end)
        for prefix, value in zip(self._prefixes, row.values, strict=True):
            pieces.append(prefix)
            if isinstance(value, str):
                pieces.append(self._text(value))
            else:  # a float signal may be infinite, which JSON does not know
                missing = value is None or not math.isfinite(value)
                pieces.append(self._nothing if missing else str(value))
        return "".join((*pieces, self._end))

    @cached_property
    def _lines(self) -> "Lines":
        """The same by the core in C."""
        from kontronik_can_gw.native.offline import Lines, Style

        parts = (self._start, self._utc, self._utc_end, self._end, self._nothing)
        start, utc, *rest = (part.encode() for part in parts)
        style = Style(start, utc if self._table.has_utc else None, *rest)
        cells = [
            (
                prefix.encode(),
                [(number, self._text(text).encode()) for number, text in one.texts]
                if one.kind is Kind.TEXT
                else None,
            )
            for prefix, one in zip(self._prefixes, self._table.fields, strict=True)
        ]
        return Lines(load.library()[0], style, cells)

    def close(self) -> None:
        """Nothing is held."""

    discard = close
