"""Writes tables as CSV, JSON lines or Parquet.

CSV follows RFC 4180 without its carriage returns. Parquet needs pyarrow, an extra.
"""

import json
import math
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC as UTC_ZONE
from datetime import datetime
from functools import cached_property, lru_cache, partial
from itertools import repeat
from typing import IO, TYPE_CHECKING, Any

from kontronik_can_gw.desk.libraries import missing_library
from kontronik_can_gw.desk.recordings.fields import (
    TIME,
    TRUSTED,
    UTC,
    ColumnType,
    Table,
    TableColumn,
)
from kontronik_can_gw.desk.recordings.recording import PlayedBlock, RowBlock
from kontronik_can_gw.native import load
from kontronik_can_gw.times import SECOND

if TYPE_CHECKING:
    from kontronik_can_gw.desk.recordings.offline import Lines

_MAX_INT64 = 1 << 63
_KEPT_TEXTS = 1024
"""Number of texts that are kept for each column. More would cost memory and save little time."""
GROUP = 1 << 16
"""Number of rows in a row group. Its columns stay in memory until it is full."""


def seconds_text(time_ns: int) -> str:
    """Return exact decimal seconds: 6 decimals if they are exact, 9 decimals otherwise.

    Twin in C: seconds_text of native/offline.c.
    """
    seconds, rest = divmod(time_ns, SECOND)
    if rest % 1000:
        return f"{seconds}.{rest:09d}"
    return f"{seconds}.{rest // 1000:06d}"


def utc_text(wall_ns: int) -> str:
    """Return a time as ISO 8601 with microseconds: ``2023-11-14T22:13:20.123456Z``.

    Twin in C: utc_text of native/offline.c.
    """
    second, rest = divmod(wall_ns, SECOND)
    return f"{_second_text(second)}.{rest // 1000:06d}Z"


@lru_cache
def _second_text(second: int) -> str:
    moment = datetime.fromtimestamp(second, UTC_ZONE)
    return f"{moment:%Y-%m-%dT%H:%M:%S}"


def csv_text(text: str) -> str:
    """Return a text as CSV, in quotes if it needs them."""
    if not any(character in text for character in '",\r\n'):
        return text
    doubled = text.replace('"', '""')
    return f'"{doubled}"'


class _Texts(dict[Any, str]):
    """The texts of a column's cells, by value. All values have the same type.

    Texts that were used are kept.
    """

    def __init__(self, prefix: str, text_of: Callable[[Any], str]) -> None:
        super().__init__()
        self._prefix = prefix
        self._text_of = text_of

    def __missing__(self, value: Any) -> str:
        text = self._prefix + self._text_of(value)
        # 0.0 is equal to -0.0, which has another text
        is_float_zero = value == 0 and isinstance(value, float)
        if not is_float_zero:
            if len(self) >= _KEPT_TEXTS:
                self.clear()
            self[value] = text
        return text


class TextTable:
    """A table with one row in a line.

    CSV has a header of names with units. JSON has an object in each line, whose keys are the names
    of the fields. In both, a line has these pieces: start, time, Unix time, the cells after their
    prefixes, end.
    """

    def __init__(self, file: IO[bytes], table: Table, is_json: bool) -> None:
        self._file = file
        self._table = table
        self._text: Callable[[str], str] = csv_text
        self._start = ""
        self._utc = ","
        """Text before the Unix time."""
        self._utc_end = ""
        """Text after the Unix time."""
        self._trusted = ","
        """Text before the cell of TRUSTED."""
        self._makers: dict[bool | None, Lines] = {}
        self._end = "\n"
        self._nothing = ""
        """Cell of a value that is not available."""
        self._prefixes = [","] * len(table.fields)
        if is_json:
            self._text = partial(json.dumps, ensure_ascii=False)
            self._start = f'{{"{TIME}": '
            self._utc = f', "{UTC}": "'
            self._utc_end = '"'
            self._trusted = f', "{TRUSTED}": '
            self._end = "}\n"
            self._nothing = "null"
            self._prefixes = [f", {json.dumps(one.name)}: " for one in table.fields]
            return
        heads = [f"{TIME} [s]"]
        if table.has_utc:
            heads.append(UTC)
        if table.has_trust:
            heads.append(TRUSTED)
        heads += [one.header for one in table.fields]
        line = ",".join(map(csv_text, heads)) + "\n"
        file.write(line.encode())

    def write(self, block: RowBlock) -> None:
        """Add rows."""
        wall_ns = block.wall_ns or 0
        if not isinstance(block, PlayedBlock) or block.times[0] + wall_ns < 0:
            self._write(block)
            return
        begin = block.begin
        origin_ns = self._table.origin_ns
        lines = self._lines(block.is_trusted)
        for piece in lines.of(block.made, begin, block.end, origin_ns, wall_ns):
            if isinstance(piece, int):  # the number of a row that C cannot write
                row = piece - begin
                self._write(block.part(row, row + 1))
            else:
                self._file.write(piece)

    def _write(self, block: RowBlock) -> None:
        wall_ns = block.wall_ns or 0
        after_utc = self._after_utc(block.is_trusted)
        heads = map(self._head_of_line, block.times, repeat(wall_ns), repeat(after_utc))
        cells = []
        for texts, column in zip(self._texts, block.columns, strict=True):
            cells.append(map(texts.__getitem__, column))
        lines = map("".join, zip(heads, *cells, repeat(self._end)))
        self._file.write("".join(lines).encode())

    def _after_utc(self, is_trusted: bool | None) -> str:
        """Return the text after the Unix time, with the cell of TRUSTED."""
        if not self._table.has_trust:
            return self._utc_end
        cell = self._nothing if is_trusted is None else str(int(is_trusted))
        return f"{self._utc_end}{self._trusted}{cell}"

    def _head_of_line(self, time_ns: int, wall_ns: int, after_utc: str) -> str:
        text = self._start + seconds_text(time_ns - self._table.origin_ns)
        if self._table.has_utc:
            text += self._utc + utc_text(time_ns + wall_ns) + after_utc
        return text

    @cached_property
    def _texts(self) -> "list[_Texts]":
        """The texts of the cells with their prefixes, for each column."""
        return [_Texts(prefix, self._cell) for prefix in self._prefixes]

    def _cell(self, value: Any) -> str:
        if isinstance(value, str):
            return self._text(value)
        # a float signal may be infinite, but JSON has no infinite numbers
        if value is None or not math.isfinite(value):
            return self._nothing
        return str(value)

    def _lines(self, is_trusted: bool | None) -> "Lines":
        """Return the maker of the same lines in C."""
        if is_trusted not in self._makers:
            self._makers[is_trusted] = self._make_lines(is_trusted)
        return self._makers[is_trusted]

    def _make_lines(self, is_trusted: bool | None) -> "Lines":
        from kontronik_can_gw.desk.recordings.offline import Lines, Style

        utc = None
        if self._table.has_utc:
            utc = self._utc.encode()
        style = Style(
            self._start.encode(),
            utc,
            self._after_utc(is_trusted).encode(),
            self._end.encode(),
            self._nothing.encode(),
        )
        cells = []
        for prefix, one in zip(self._prefixes, self._table.fields, strict=True):
            texts = None
            if one.kind is ColumnType.TEXT:
                texts = []
                for number, text in one.texts:
                    texts.append((number, self._text(text).encode()))
            cells.append((prefix.encode(), texts))
        return Lines(load.library()[0], style, cells)

    def close(self) -> None:
        """Do nothing, because no rows are held back."""

    discard = close


class ParquetTable:
    """A Parquet file with the columns of the CSV, and units and provenance as metadata.

    Flags are int8, whole numbers int64 (uint64 if needed), other numbers float64, and texts
    dictionaries of strings. Null means not available.
    """

    def __init__(self, file: IO[bytes], table: Table) -> None:
        try:
            import pyarrow as pa  # type: ignore[import-untyped]
            from pyarrow import compute, parquet
        except ImportError:
            raise missing_library("Parquet", "parquet") from None
        self._pa: Any = pa
        self._compute: Any = compute
        self._table = table
        self._texts = []
        """Numbers and texts of each column. Empty for a column without texts."""
        for one in table.fields:
            texts = dict(one.texts)
            pair = (pa.array([*texts], pa.int64()), pa.array([*texts.values()], pa.string()))
            self._texts.append(pair)
        heads = [pa.field(f"{TIME} [s]", pa.float64(), metadata={"unit": "s"})]
        if table.has_utc:
            heads.append(pa.field(UTC, pa.timestamp("ns", tz="UTC")))
        if table.has_trust:
            heads.append(pa.field(TRUSTED, pa.int8()))
        for one in table.fields:
            about = {
                "signal": one.name,
                "unit": one.unit,
                "message": one.message,
            }
            heads.append(pa.field(one.header, self._type(one), metadata=about))
        provenance = json.dumps(dict(table.provenance), ensure_ascii=False)
        self._schema = pa.schema(heads, metadata={"kontronik_can_gw": provenance})
        # a dictionary costs more than it saves if all values differ, or if a value takes one byte
        plain = {one.header for one in table.fields if one.kind is ColumnType.FLAG}
        plain.add(f"{TIME} [s]")
        names = self._schema.names
        self._writer: Any = parquet.ParquetWriter(
            file,
            self._schema,
            use_dictionary=[name for name in names if name not in plain],
            memory_pool=pa.system_memory_pool(),  # other pools never return memory
            write_statistics=[name for name in (f"{TIME} [s]", UTC) if name in names],
        )
        self._batches: list[Any] = []
        self._held = 0

    def write(self, block: RowBlock) -> None:
        """Add rows."""
        pa = self._pa
        compute = self._compute
        wall_ns = block.wall_ns or 0
        if isinstance(block, PlayedBlock):
            buffers = [None, pa.py_buffer(block.times)]
            times = pa.Array.from_buffers(pa.int64(), len(block), buffers)
        else:
            times = pa.array(block.times, pa.int64())
        elapsed_ns = compute.subtract(times, self._table.origin_ns)
        elapsed_ns = elapsed_ns.cast(pa.float64(), safe=False)
        arrays = [compute.divide(elapsed_ns, float(SECOND))]
        if self._table.has_utc:
            wall = compute.add(times, wall_ns)
            arrays.append(wall.cast(pa.timestamp("ns", tz="UTC")))
        if self._table.has_trust:
            cell = None if block.is_trusted is None else int(block.is_trusted)
            arrays.append(pa.array([cell] * len(block), pa.int8()))
        for index, one in enumerate(self._table.fields):
            if isinstance(block, PlayedBlock):
                array = self._played(block, index, one)
            else:
                array = pa.array(block.columns[index], self._type(one))
            arrays.append(array)
        batch = pa.RecordBatch.from_arrays(arrays, schema=self._schema)
        self._batches.append(batch)
        self._held += len(block)
        if self._held >= GROUP:
            self._write_group()

    def close(self) -> None:
        """Write the remaining rows and the end of the file."""
        self._write_group()
        self._writer.close()

    def discard(self) -> None:
        """Release the file."""
        with suppress(OSError):  # there is no room for its end
            self._writer.close()

    def _played(self, block: PlayedBlock, index: int, one: TableColumn) -> Any:
        """Return a column of the C core without copying it."""
        pa = self._pa
        made = block.made
        kind = pa.int64()
        if made.is_real[index]:
            kind = pa.float64()
        valid = pa.py_buffer(made.valid[index])
        values = pa.py_buffer(made.values(index))
        found = pa.Array.from_buffers(kind, block.end, [valid, values])
        found = found[block.begin :]
        if one.kind is ColumnType.FLAG:
            return found.cast(pa.int8(), safe=False)
        if one.kind is not ColumnType.TEXT:
            return found
        numbers, texts = self._texts[index]
        places = self._compute.index_in(found, numbers)
        return texts.take(places).dictionary_encode()

    def _write_group(self) -> None:
        if self._batches:
            table = self._pa.Table.from_batches(self._batches, self._schema)
            self._batches = []
            self._held = 0
            self._writer.write_table(table.unify_dictionaries(), GROUP)

    def _type(self, one: TableColumn) -> Any:
        pa = self._pa
        if one.kind is ColumnType.TEXT:
            return pa.dictionary(pa.int32(), pa.string())
        if one.kind is ColumnType.FLAG:
            return pa.int8()
        if one.kind is ColumnType.FLOAT:
            return pa.float64()
        if _MAX_INT64 <= one.high <= 2 * _MAX_INT64:
            return pa.uint64()
        return pa.int64()
