"""Tables as MF4 measurement files by asammdf (an extra): signals with units and value texts.

Numbers are floats, NaN where not available; texts are raw numbers with a conversion, ``NotAvailable`` where not available. All signals
share one channel group and one time, of a table of CAN frames those of each message.
"""

from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from kontronik_can_gw.desk.recordings.blocks import RowBlock
from kontronik_can_gw.desk.recordings.can_logs.mf4 import Mf4File, quiet
from kontronik_can_gw.desk.recordings.columns import Values
from kontronik_can_gw.desk.recordings.fields import Field, Kind, Table
from kontronik_can_gw.desk.recordings.tables.rows import Row, rows_of_block
from kontronik_can_gw.signals.unpacker import Value

ROWS = 8192
NOT_AVAILABLE = "NotAvailable"


class Mf4Table:
    """Writes at ``close``."""

    def __init__(self, path: Path, table: Table) -> None:
        self._file = file = Mf4File(path, table.start_wall_ns or 0, table.provenance)
        self.discard = file.discard
        self._nothing: list[Values] = [(None,) * len(part) for part in table.parts()]
        self._by_frame = table.by_frame
        named: dict[Value, tuple[str, Sequence[int]]] = {
            None: ("ESC values", range(len(table.fields)))
        }
        if table.by_frame:
            messages = dict.fromkeys(one.message for one in table.fields[2:])
            named = {message: (message, table.indices(message)) for message in messages}
        self._groups = {
            key: _Group(file, table.fields, indices, name) for key, (name, indices) in named.items()
        }

    def write(self, row: Row) -> None:
        """Add a row."""
        parts = zip(row.parts, self._nothing, strict=True)
        values = list(chain.from_iterable(nothing if p is None else p for p, nothing in parts))
        self._groups[values[1] if self._by_frame else None].write(row.time_ns, values)

    def write_block(self, block: RowBlock) -> None:
        """Add many rows."""
        for row in rows_of_block(block):
            self.write(row)

    def close(self) -> None:
        """Write the file."""
        for group in self._groups.values():
            group.flush()
        self._file.save()


class _Group:
    """One channel group."""

    def __init__(
        self, file: Mf4File, fields: Sequence[Field], indices: Sequence[int], name: str
    ) -> None:
        import numpy as np

        self._np = np
        self._file = file
        self._times: list[int] = []
        self._rows: list[Sequence[Value]] = []
        self._last = -(1 << 62)
        self._codes: list[tuple[int, str, dict[Value, int]]] = []
        """Of each field its index, type and the codes of its texts."""
        signals = []
        for index in indices:
            one = fields[index]
            kind, codes, conversion = "<f8", dict[Value, int](), None
            if one.kind is Kind.TEXT:
                kind, codes, conversion = _texts(one)
            elif one.kind is Kind.FLAG:
                kind = "<f4"
            self._codes.append((index, kind, codes))
            signals.append(
                file.module.Signal(
                    samples=np.array([], dtype=kind),
                    timestamps=np.array([], dtype="<f8"),
                    name=one.name,
                    unit=one.unit,
                    conversion=conversion,
                    comment=one.message,
                )
            )
        with quiet():
            self._number = file.mdf.append(
                signals, acq_name=name, comment=name, common_timebase=True
            )

    def write(self, time_ns: int, values: Sequence[Value]) -> None:
        """Add a row; what is earlier than its predecessor gets that one's time, for a master channel only rises."""
        self._last = max(self._last, time_ns)
        self._times.append(self._last)
        self._rows.append(values)
        if len(self._rows) >= ROWS:
            self.flush()

    def flush(self) -> None:
        """Hand what has gathered to asammdf."""
        if not self._rows:
            return
        columns = list(zip(*self._rows, strict=True))
        arrays: list[Any] = []
        for index, kind, codes in self._codes:
            column = [codes[value] for value in columns[index]] if codes else columns[index]
            arrays.append(self._np.array(column, dtype=kind))
        self._file.extend(self._number, self._times, arrays)
        self._rows.clear()
        self._times.clear()


def _texts(one: Field) -> tuple[str, dict[Value, int], dict[str, object] | None]:
    """Type, codes and conversion of a field of texts."""
    texts = {number: text for number, text in one.texts if text != NOT_AVAILABLE}
    free = max(texts, default=-1) + 1
    missing = next((number for number, text in one.texts if text == NOT_AVAILABLE), free)
    texts[missing] = NOT_AVAILABLE
    kind = "<i8" if min(texts) < 0 else "<u1" if max(texts) < 256 else "<u4"
    conversion: dict[str, object] = {"default": ""}
    for place, (number, text) in enumerate(sorted(texts.items())):
        conversion |= {f"val_{place}": number, f"text_{place}": text}
    return kind, {text: number for number, text in texts.items()} | {None: missing}, conversion
