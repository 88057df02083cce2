"""The formats of tables, all with the same methods."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Protocol

from kontronik_can_gw.desk.recordings.blocks import RowBlock
from kontronik_can_gw.desk.recordings.fields import Table
from kontronik_can_gw.desk.recordings.tables.rows import Row
from kontronik_can_gw.desk.recordings.tables.text import CsvTable, JsonTable


class TableWriter(Protocol):
    """Writes the rows of one table."""

    def write(self, row: Row) -> None:
        """Add a row."""

    def write_block(self, block: RowBlock) -> None:
        """Add many rows."""

    def close(self) -> None:
        """Write what is held back, and the end."""

    def discard(self) -> None:
        """Release what is held; the table is not to be kept."""


@contextmanager
def open_table(
    target: IO[bytes] | Path, form: str, table: Table, units_line: bool = False
) -> Iterator[TableWriter]:
    """A writer, closed at the end. ``target``: a file that is open for bytes, of Parquet and MF4 a path.

    RunError where a library is missing. ``units_line``: of JSON lines, a first line with the units.
    """
    writer: TableWriter
    if isinstance(target, Path):
        if form == "parquet":
            from kontronik_can_gw.desk.recordings.tables.parquet import ParquetTable

            writer = ParquetTable(target, table)
        else:
            from kontronik_can_gw.desk.recordings.tables.mf4 import Mf4Table

            writer = Mf4Table(target, table)
    elif form == "jsonl":
        writer = JsonTable(target, table, units_line)
    else:
        writer = CsvTable(target, table)
    try:
        yield writer
        writer.close()
    except BaseException:
        writer.discard()
        raise
