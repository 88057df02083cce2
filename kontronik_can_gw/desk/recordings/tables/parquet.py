"""Tables as Parquet by pyarrow (an extra): typed columns, units and provenance in the metadata."""

import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from kontronik_can_gw.desk.recordings.blocks import RowBlock
from kontronik_can_gw.desk.recordings.fields import TIME, UTC, Field, Kind, Table
from kontronik_can_gw.desk.recordings.tables.rows import SECOND_NS, Row, rows_of_block
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.signals.unpacker import Value

ROWS = 4096
"""Rows that gather as such."""
_FAR = 1 << 63
_EXACT = 1 << 53
GROUP = 1 << 16
"""Rows of a row group, whose columns stay in memory until it is full."""


def _is_exact(block: RowBlock) -> bool:
    """True where times are within what a float and an int64 hold."""
    last: int = block.times[-1]
    return last - block.origin_ns < _EXACT and abs(last + (block.wall_ns or 0)) < _FAR


class ParquetTable:
    """Columns as in CSV. Flags int8, whole numbers int64, others float64, texts dictionaries of strings; null where not available."""

    def __init__(self, path: Path, table: Table) -> None:
        try:
            import pyarrow as pa  # type: ignore[import-untyped]
            from pyarrow import parquet
        except ImportError:
            raise RunError(
                "Parquet needs pyarrow: pip install 'kontronik-can-gw[parquet]'"
            ) from None
        self._pa: Any = pa
        self._table = table
        # the same text may stand for several numbers
        self._codes: list[dict[Value, int]] = [
            {text: code for code, text in enumerate(dict.fromkeys(text for _, text in one.texts))}
            for one in table.fields
        ]
        self._texts = [pa.array(list(codes), pa.string()) for codes in self._codes]
        self._numbers = [
            (
                pa.array([number for number, _ in one.texts], pa.int64()),
                pa.array([codes[text] for _, text in one.texts], pa.int32()),
            )
            for one, codes in zip(table.fields, self._codes, strict=True)
        ]
        """Of a column of texts: its numbers, and the place in ``_texts`` of each."""
        self._rows: list[Row] = []
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
        with_dictionary = [name for name in self._schema.names if name not in plain]
        self._writer: Any = parquet.ParquetWriter(
            str(path),
            self._schema,
            use_dictionary=with_dictionary,
            memory_pool=pa.system_memory_pool(),  # the others keep what they were given once
            write_statistics=[name for name in (f"{TIME} [s]", UTC) if name in self._schema.names],
        )
        self._batches: list[Any] = []
        self._held = 0

    def write(self, row: Row) -> None:
        """Add a row."""
        self._rows.append(row)
        if len(self._rows) >= ROWS:
            self._gather()

    def write_block(self, block: RowBlock) -> None:
        """Add many rows."""
        if not _is_exact(block):
            for row in rows_of_block(block):
                self.write(row)
            return
        self._gather()
        pa, begin, count = self._pa, block.begin, len(block)
        from pyarrow import compute

        def array(kind: Any, values: Any, valid: Any = None) -> Any:
            buffers = [None if valid is None else pa.py_buffer(valid), pa.py_buffer(values)]
            return pa.Array.from_buffers(kind, begin + count, buffers)[begin:]

        times = array(pa.int64(), block.rows.times)
        # what it cannot hold exactly was excluded above
        since = compute.subtract(times, block.origin_ns).cast(pa.float64(), safe=False)
        arrays = [compute.divide(since, float(SECOND_NS))]
        if self._table.has_utc:
            wall = compute.add(times, block.wall_ns)
            arrays.append(wall.cast(pa.timestamp("ns", tz="UTC")))
        for index, one in enumerate(self._table.fields):
            values, valid = block.rows.values(index), block.rows.valid[index]
            is_real = block.rows.is_real[index]
            found = array(pa.float64() if is_real else pa.int64(), values, valid)
            if one.kind is Kind.TEXT:
                numbers, codes = self._numbers[index]
                found = codes.take(compute.index_in(found, numbers))
                found = pa.DictionaryArray.from_arrays(found, self._texts[index])
            elif one.kind is Kind.FLAG:
                found = found.cast(pa.int8(), safe=False)
            arrays.append(found)
        self._hold(arrays)

    def close(self) -> None:
        """Write the rest and the end."""
        self._gather()
        self._write_group()
        self._writer.close()

    def discard(self) -> None:
        """Release the file."""
        with suppress(OSError):  # there is no room for its end
            self._writer.close()

    def _gather(self) -> None:
        """Turn the rows into columns."""
        if not self._rows:
            return
        pa = self._pa
        times, walls, rows = zip(*self._rows, strict=True)
        arrays = [pa.array([time_ns / SECOND_NS for time_ns in times], pa.float64())]
        if self._table.has_utc:
            # one out of range comes from a damaged clock
            known = [wall if wall is not None and -_FAR <= wall < _FAR else None for wall in walls]
            arrays.append(pa.array(known, pa.int64()).cast(pa.timestamp("ns", tz="UTC")))
        columns = enumerate(zip(*rows, strict=True))
        arrays += [self._array(index, column) for index, column in columns]
        self._rows = []
        self._hold(arrays)

    def _hold(self, arrays: list[Any]) -> None:
        batch = self._pa.RecordBatch.from_arrays(arrays, schema=self._schema)
        self._batches.append(batch)
        self._held += batch.num_rows
        if self._held >= GROUP:
            self._write_group()

    def _array(self, index: int, column: Sequence[Value]) -> Any:
        pa, one = self._pa, self._table.fields[index]
        if one.kind is not Kind.TEXT:
            return pa.array(column, self._type(one))
        codes = self._codes[index]
        indices = pa.array([codes.get(value) for value in column], pa.int32())
        return pa.DictionaryArray.from_arrays(indices, self._texts[index])

    def _write_group(self) -> None:
        if self._batches:
            table = self._pa.Table.from_batches(self._batches, self._schema)
            self._batches, self._held = [], 0
            self._writer.write_table(table, GROUP)

    def _type(self, one: Field) -> Any:
        pa = self._pa
        if one.kind is Kind.TEXT:
            return pa.dictionary(pa.int32(), pa.string())
        return {Kind.FLAG: pa.int8(), Kind.WHOLE: pa.int64(), Kind.FLOAT: pa.float64()}[one.kind]
