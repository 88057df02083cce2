"""Tables as text: CSV (RFC 4180 without its carriage returns) and JSON lines; and as Parquet by pyarrow (an extra)."""

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
from kontronik_can_gw.desk.recordings.fields import TIME, UTC, Field, Kind, Table
from kontronik_can_gw.desk.recordings.recording import Block, PlayedBlock
from kontronik_can_gw.native import load
from kontronik_can_gw.times import SECOND

if TYPE_CHECKING:
    from kontronik_can_gw.native.offline import Lines

_MAX_INT64 = 1 << 63
_KEPT_TEXTS = 1024
"""Texts that are kept for each column. More would need more memory than they save time."""
GROUP = 1 << 16
"""Rows of a row group, whose columns stay in memory until it is full."""


def seconds_text(time_ns: int) -> str:
    """Exact decimal seconds: 6 digits where that is exact, else 9."""
    seconds, rest = divmod(time_ns, SECOND)
    return f"{seconds}.{rest:09d}" if rest % 1000 else f"{seconds}.{rest // 1000:06d}"


def utc_text(wall_ns: int) -> str:
    """ISO 8601 with microseconds: ``2023-11-14T22:13:20.123456Z``."""
    second, rest = divmod(wall_ns, SECOND)
    return f"{_second_text(second)}.{rest // 1000:06d}Z"


@lru_cache
def _second_text(second: int) -> str:
    return f"{datetime.fromtimestamp(second, UTC_ZONE):%Y-%m-%dT%H:%M:%S}"


def csv_text(text: str) -> str:
    """Quoted where it has to be."""
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in '",\r\n') else text


class _Texts(dict[Any, str]):
    """Text of a cell by its value, of which all have one type. Texts that were used are kept."""

    def __init__(self, prefix: str, text_of: Callable[[Any], str]) -> None:
        super().__init__()
        self._prefix, self._text_of = prefix, text_of

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
        heads = map(self._head_of_line, block.times, repeat(block.wall_ns or 0))
        cells = [
            map(texts.__getitem__, column)
            for texts, column in zip(self._texts, block.columns, strict=True)
        ]
        lines = map("".join, zip(heads, *cells, repeat(self._end)))
        self._file.write("".join(lines).encode())

    def _head_of_line(self, time_ns: int, wall_ns: int) -> str:
        text = self._start + seconds_text(time_ns - self._table.origin_ns)
        if self._table.has_utc:
            text += self._utc + utc_text(time_ns + wall_ns) + self._utc_end
        return text

    @cached_property
    def _texts(self) -> "list[_Texts]":
        """The text of each column's cells, with the prefix."""
        return [_Texts(prefix, self._cell) for prefix in self._prefixes]

    def _cell(self, value: Any) -> str:
        if isinstance(value, str):
            return self._text(value)
        # a float signal may be infinite, which JSON does not know
        is_missing = value is None or not math.isfinite(value)
        return self._nothing if is_missing else str(value)

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


class ParquetTable:
    """Columns as in CSV, typed, with units and provenance in the metadata.

    Flags int8, whole numbers int64 (uint64 where they need it), others float64, texts dictionaries of strings; null where not available.
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
        self._texts = [
            (
                pa.array([number for number, _ in one.texts], pa.int64()),
                pa.array([text for _, text in one.texts], pa.string()),
            )
            for one in table.fields
        ]
        """Of a column of texts: its numbers, and the text of each."""
        heads = [pa.field(f"{TIME} [s]", pa.float64(), metadata={"unit": "s"})]
        if table.has_utc:
            heads.append(pa.field(UTC, pa.timestamp("ns", tz="UTC")))
        heads += [
            pa.field(
                one.header,
                self._type(one),
                metadata={"signal": one.name, "unit": one.unit, "message": one.message},
            )
            for one in table.fields
        ]
        provenance = json.dumps(dict(table.provenance), ensure_ascii=False)
        self._schema = pa.schema(heads, metadata={"kontronik_can_gw": provenance})
        # a dictionary costs more than it saves where every value is another one, or takes one byte
        plain = [f"{TIME} [s]", *(one.header for one in table.fields if one.kind is Kind.FLAG)]
        self._writer: Any = parquet.ParquetWriter(
            file,
            self._schema,
            use_dictionary=[name for name in self._schema.names if name not in plain],
            memory_pool=pa.system_memory_pool(),  # the others keep what they were given once
            write_statistics=[name for name in (f"{TIME} [s]", UTC) if name in self._schema.names],
        )
        self._batches: list[Any] = []
        self._held = 0

    def write(self, block: Block) -> None:
        """Add rows."""
        pa, compute, wall_ns = self._pa, self._compute, block.wall_ns or 0
        if isinstance(block, PlayedBlock):
            buffers = [None, pa.py_buffer(block.times)]
            times = pa.Array.from_buffers(pa.int64(), len(block), buffers)
        else:
            times = pa.array(block.times, pa.int64())
        since = compute.subtract(times, self._table.origin_ns).cast(pa.float64(), safe=False)
        arrays = [compute.divide(since, float(SECOND))]
        if self._table.has_utc:
            wall = compute.add(times, wall_ns)
            arrays.append(wall.cast(pa.timestamp("ns", tz="UTC")))
        arrays += [
            self._played(block, index, one)
            if isinstance(block, PlayedBlock)
            else pa.array(block.columns[index], self._type(one))
            for index, one in enumerate(self._table.fields)
        ]
        self._batches.append(pa.RecordBatch.from_arrays(arrays, schema=self._schema))
        self._held += len(block)
        if self._held >= GROUP:
            self._write_group()

    def close(self) -> None:
        """Write the rest and the end."""
        self._write_group()
        self._writer.close()

    def discard(self) -> None:
        """Release the file."""
        with suppress(OSError):  # there is no room for its end
            self._writer.close()

    def _played(self, block: PlayedBlock, index: int, one: Field) -> Any:
        """A column of the core in C, as it is."""
        pa, made, begin, end = self._pa, block.made, block.begin, block.end
        kind = pa.float64() if made.is_real[index] else pa.int64()
        buffers = [pa.py_buffer(made.valid[index]), pa.py_buffer(made.values(index))]
        found = pa.Array.from_buffers(kind, end, buffers)[begin:]
        if one.kind is Kind.FLAG:
            return found.cast(pa.int8(), safe=False)
        if one.kind is not Kind.TEXT:
            return found
        numbers, texts = self._texts[index]
        return texts.take(self._compute.index_in(found, numbers)).dictionary_encode()

    def _write_group(self) -> None:
        if self._batches:
            table = self._pa.Table.from_batches(self._batches, self._schema)
            self._batches, self._held = [], 0
            self._writer.write_table(table.unify_dictionaries(), GROUP)

    def _type(self, one: Field) -> Any:
        pa = self._pa
        if one.kind is Kind.TEXT:
            return pa.dictionary(pa.int32(), pa.string())
        whole = pa.uint64() if _MAX_INT64 <= one.high <= 2 * _MAX_INT64 else pa.int64()
        return {Kind.FLAG: pa.int8(), Kind.WHOLE: whole, Kind.FLOAT: pa.float64()}[one.kind]
