"""Tables as Parquet by pyarrow (an extra): typed columns, units and provenance in the metadata."""

import json
from contextlib import suppress
from typing import IO, Any

from kontronik_can_gw.desk.recordings.fields import TIME, UTC, Field, Kind, Table
from kontronik_can_gw.desk.recordings.recording import Block, PlayedBlock
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.telemetry import SECOND

_MAX_INT64 = 1 << 63
GROUP = 1 << 16
"""Rows of a row group, whose columns stay in memory until it is full."""


class ParquetTable:
    """Columns as in CSV.

    Flags int8, whole numbers int64 (uint64 where they need it), others float64, texts dictionaries of strings; null where not available.
    """

    def __init__(self, file: IO[bytes], table: Table) -> None:
        try:
            import pyarrow as pa  # type: ignore[import-untyped]
            from pyarrow import compute, parquet
        except ImportError:
            raise RunError(
                "Parquet needs pyarrow: pip install 'kontronik-can-gw[parquet]'"
            ) from None
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
