"""Tables as Parquet by pyarrow (an extra): typed columns, units and provenance in the metadata."""

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.offline.tables.fields import TIME, UTC, Field, Kind, Table
from kontronik_can_gw.offline.tables.rows import SECOND_NS, Row

ROWS = 16_384
"""Rows of a row group, which stay in memory until it is full."""


class ParquetTable:
    """Columns as in CSV. Flags int8, whole numbers int64, others float64, texts dictionaries of strings; null where not available."""

    def __init__(self, path: Path, table: Table) -> None:
        try:
            import pyarrow as pa  # type: ignore[import-untyped]
            from pyarrow import parquet
        except ImportError:
            raise RunError("Parquet needs pyarrow: pip install 'kontronik-can-gw[parquet]'") from None
        self._pa: Any = pa
        self._table = table
        self._codes = [{text: code for code, (_, text) in enumerate(one.texts)} for one in table.fields]
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
        self._writer: Any = parquet.ParquetWriter(str(path), self._schema)

    def write(self, row: Row) -> None:
        """Add a row."""
        self._rows.append(row)
        if len(self._rows) >= ROWS:
            self._flush()

    def close(self) -> None:
        """Write the rest and the end."""
        if self._rows:
            self._flush()
        self._writer.close()

    def discard(self) -> None:
        """Release the file."""
        with suppress(OSError):  # there is no room for its end
            self._writer.close()

    def _flush(self) -> None:
        pa, rows = self._pa, self._rows
        times, walls, values = zip(*rows, strict=True)
        arrays = [pa.array([time_ns / SECOND_NS for time_ns in times], pa.float64())]
        if self._table.has_utc:
            arrays.append(pa.array([_in_range(w) for w in walls], pa.timestamp("ns", tz="UTC")))
        columns = zip(*values, strict=True)
        for one, codes, column in zip(self._table.fields, self._codes, columns, strict=True):
            kind = self._type(one)
            if one.kind is Kind.TEXT:
                indices = pa.array([codes.get(value) for value in column], pa.int32())
                arrays.append(pa.DictionaryArray.from_arrays(indices, pa.array(list(codes), pa.string())))
            else:
                arrays.append(pa.array(column, kind))
        self._rows = []
        self._writer.write_batch(pa.RecordBatch.from_arrays(arrays, schema=self._schema))

    def _type(self, one: Field) -> Any:
        pa = self._pa
        if one.kind is Kind.TEXT:
            return pa.dictionary(pa.int32(), pa.string())
        return {Kind.FLAG: pa.int8(), Kind.WHOLE: pa.int64(), Kind.FLOAT: pa.float64()}[one.kind]


def _in_range(wall_ns: int | None) -> int | None:
    return wall_ns if wall_ns is not None and -(1 << 63) <= wall_ns < 1 << 63 else None
