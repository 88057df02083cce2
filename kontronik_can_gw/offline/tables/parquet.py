"""Tables as Parquet by pyarrow (an extra): typed columns, units and provenance in the metadata."""

import json
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.offline.tables.blocks import Block, BlockColumn
from kontronik_can_gw.offline.tables.fields import TIME, UTC, Field, Kind, Table
from kontronik_can_gw.offline.tables.rows import SECOND_NS, Row

ROWS = 16_384
"""Rows that gather as such."""
GROUP = 1 << 16
"""Rows of a row group, whose columns stay in memory until it is full."""
_MOST_SAME = 64


class ParquetTable:
    """Columns as in CSV. Flags int8, whole numbers int64, others float64, texts dictionaries of strings; null where not available."""

    def __init__(self, path: Path, table: Table) -> None:
        try:
            import pyarrow as pa  # type: ignore[import-untyped]
            from pyarrow import parquet
        except ImportError:
            raise RunError("Parquet needs pyarrow: pip install 'kontronik-can-gw[parquet]'") from None
        self._pa: Any = pa
        self._np: Any = None
        with suppress(ImportError):  # it nearly always comes with pyarrow
            import numpy as np

            self._np = np
        self._table = table
        # the same text may stand for several numbers
        self._codes = [
            {text: code for code, text in enumerate(dict.fromkeys(text for _, text in one.texts))}
            for one in table.fields
        ]
        self._rows: list[Row] = []
        heads = [pa.field(f"{TIME} [s]", pa.float64(), metadata={"unit": "s"})]
        if table.has_utc:
            heads.append(pa.field(UTC, pa.timestamp("ns", tz="UTC")))
        heads += [
            pa.field(
                one.header, self._type(one), metadata={"signal": one.name, "unit": one.unit, "message": one.message}
            )
            for one in table.fields
        ]
        provenance = json.dumps(dict(table.provenance), ensure_ascii=False)
        self._schema = pa.schema(heads, metadata={"kontronik_can_gw": provenance})
        # a dictionary costs more than it saves where every value is another one, or takes one byte
        plain = [f"{TIME} [s]", *(one.header for one in table.fields if one.kind is Kind.FLAG)]
        with_dictionary = [name for name in self._schema.names if name not in plain]
        self._writer: Any = parquet.ParquetWriter(
            str(path),
            self._schema,
            use_dictionary=with_dictionary,
            memory_pool=pa.system_memory_pool(),  # the others keep what they were given once
            write_statistics=[name for name in (f"{TIME} [s]", UTC) if name in self._schema.names],
        )
        self._batches: list[Any] = []
        self._same: dict[tuple[float | None, Any, int], Any] = {}
        self._held = 0
        self._thread = ThreadPoolExecutor(1)
        self._writing: Future[None] | None = None

    def write(self, row: Row) -> None:
        """Add a row."""
        self._rows.append(row)
        if len(self._rows) >= ROWS:
            self._gather_rows()

    def write_block(self, block: Block) -> None:
        """Add many rows."""
        self._gather_rows()
        pa, count = self._pa, len(block)
        arrays = [self._held_by(_seconds(block.times_ns), pa.float64())]
        if self._table.has_utc:
            kind = pa.timestamp("ns", tz="UTC")
            walls = block.walls_ns
            arrays.append(pa.nulls(count, kind) if walls is None else self._held_by(walls.astype("<i8"), kind))
        for one, codes, column in zip(self._table.fields, self._codes, block.columns, strict=True):
            arrays.append(self._array(one, codes, column, count))
        self._gather(arrays)

    def close(self) -> None:
        """Write the rest and the end."""
        self._gather_rows()
        self._write_group()
        self._end_thread()
        self._writer.close()

    def discard(self) -> None:
        """Release the file."""
        with suppress(Exception):  # it is told already
            self._end_thread()
        with suppress(OSError):  # there is no room for its end
            self._writer.close()

    def _gather_rows(self) -> None:
        if not self._rows:
            return
        pa, rows = self._pa, self._rows
        times, walls, values = zip(*rows, strict=True)
        arrays = [self._listed([time_ns / SECOND_NS for time_ns in times], pa.float64())]
        if self._table.has_utc:
            kind = pa.timestamp("ns", tz="UTC")
            arrays.append(self._listed([_in_range(w) for w in walls], pa.int64()).cast(kind))
        columns = zip(*values, strict=True)
        for one, codes, column in zip(self._table.fields, self._codes, columns, strict=True):
            kind = self._type(one)
            if one.kind is Kind.TEXT:
                indices = self._listed([codes.get(value) for value in column], pa.int32())
                arrays.append(pa.DictionaryArray.from_arrays(indices, self._texts(codes)))
            else:
                arrays.append(self._listed(column, kind))
        self._rows = []
        self._gather(arrays)

    def _gather(self, arrays: list[Any]) -> None:
        batch = self._pa.RecordBatch.from_arrays(arrays, schema=self._schema)
        self._batches.append(batch)
        self._held += batch.num_rows
        if self._held >= GROUP:
            self._write_group()

    def _array(self, one: Field, codes: dict[str, int], column: BlockColumn, count: int) -> Any:
        """A column of a block."""
        pa = self._pa
        if one.kind is Kind.TEXT:
            if not codes:
                return pa.nulls(count, self._type(one))
            places = [codes[text] for _, text in one.texts]
            if column.is_same:
                place = None if self._is_missing(column) else places[int(column.numbers[0])]
                indices = self._repeated(place, pa.int32(), count)
            else:
                found = self._np.array(places, "<i4")[column.numbers]  # the place -1 is not valid
                indices = self._held_by(found, pa.int32(), column.valid)
            return pa.DictionaryArray.from_arrays(indices, self._texts(codes))
        kind = self._type(one)
        if column.is_same:
            return self._repeated(None if self._is_missing(column) else column.values[0].item(), kind, count)
        return self._held_by(column.values.astype(kind.to_pandas_dtype(), copy=False), kind, column.valid)

    def _held_by(self, values: Any, kind: Any, valid: Any = None) -> Any:
        """An array of numpy as one of pyarrow, without a copy. (``pyarrow.array`` imports pandas, for what is none of it.)"""
        pa, np = self._pa, self._np
        there = None if valid is None else pa.py_buffer(np.packbits(valid, bitorder="little"))
        return pa.Array.from_buffers(kind, len(values), [there, pa.py_buffer(np.ascontiguousarray(values))])

    def _texts(self, codes: dict[str, int]) -> Any:
        pa = self._pa
        if not codes or self._np is None:
            return pa.array(list(codes), pa.string())
        encoded = [text.encode() for text in codes]
        ends = self._np.cumsum([0, *map(len, encoded)]).astype("<i4")
        return pa.Array.from_buffers(
            pa.string(), len(encoded), [None, pa.py_buffer(ends), pa.py_buffer(b"".join(encoded))]
        )

    def _listed(self, values: Sequence[Any], kind: Any) -> Any:
        """Numbers, or None, as an array."""
        np = self._np
        if np is None:
            return self._pa.array(values, kind)
        there = None if None not in values else np.array([value is not None for value in values])
        numbers = values if there is None else [0 if value is None else value for value in values]
        return self._held_by(np.array(numbers, kind.to_pandas_dtype()), kind, there)

    @staticmethod
    def _is_missing(column: BlockColumn) -> bool:
        return column.valid is not None and not column.valid[0]

    def _repeated(self, value: float | None, kind: Any, count: int) -> Any:
        """The same value again and again; such an array serves many columns and blocks."""
        key = (value, kind, count)
        found = self._same.get(key)
        if found is None:
            if len(self._same) > _MOST_SAME:
                self._same.clear()
            if value is None:
                found = self._pa.nulls(count, kind)
            else:
                found = self._held_by(self._np.full(count, value, kind.to_pandas_dtype()), kind)
            self._same[key] = found
        return found

    def _write_group(self) -> None:
        """Let a row group be written beside what is done next; the one before is finished first."""
        if self._batches:
            table = self._pa.Table.from_batches(self._batches, self._schema)
            self._batches, self._held = [], 0
            self._wait()
            self._writing = self._thread.submit(self._writer.write_table, table, GROUP)

    def _wait(self) -> None:
        if self._writing is not None:
            writing, self._writing = self._writing, None
            writing.result()

    def _end_thread(self) -> None:
        try:
            self._wait()
        finally:
            self._thread.shutdown()

    def _type(self, one: Field) -> Any:
        pa = self._pa
        if one.kind is Kind.TEXT:
            return pa.dictionary(pa.int32(), pa.string())
        return {Kind.FLAG: pa.int8(), Kind.WHOLE: pa.int64(), Kind.FLOAT: pa.float64()}[one.kind]


def _seconds(times_ns: Any) -> Any:
    if int(times_ns[-1]) < 1 << 53:
        return times_ns / SECOND_NS
    return [time_ns / SECOND_NS for time_ns in times_ns.tolist()]  # as exact as can be


def _in_range(wall_ns: int | None) -> int | None:
    return wall_ns if wall_ns is not None and -(1 << 63) <= wall_ns < 1 << 63 else None
