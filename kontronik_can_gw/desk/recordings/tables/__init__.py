"""Tables of ESC values, a row at each time: CSV, JSON lines, Parquet, MF4."""

from kontronik_can_gw.desk.recordings.fields import Field, Table
from kontronik_can_gw.desk.recordings.tables.rows import (
    DISORDER_NS,
    Choice,
    Row,
    Rows,
    fields_of_frames,
    first_of,
)
from kontronik_can_gw.desk.recordings.tables.writers import FORMATS, TableWriter, open_table

__all__ = [
    "DISORDER_NS",
    "FORMATS",
    "Choice",
    "Field",
    "Row",
    "Rows",
    "Table",
    "TableWriter",
    "fields_of_frames",
    "first_of",
    "open_table",
]
