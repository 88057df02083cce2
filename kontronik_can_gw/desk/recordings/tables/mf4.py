"""Tables as MF4 measurement files: signals with units and value texts.

Numbers are floats, NaN where not available; texts are raw numbers with a conversion, ``NotAvailable`` where not available. All signals
share one channel group and one time, of a table of CAN frames those of each message.
"""

from pathlib import Path
from typing import Any

from kontronik_can_gw.desk.recordings.blocks import RowBlock
from kontronik_can_gw.desk.recordings.fields import Field, Kind, Table
from kontronik_can_gw.desk.recordings.mf4 import Mf4File
from kontronik_can_gw.desk.recordings.tables.rows import Row, rows_of_block
from kontronik_can_gw.signals.unpacker import Value

NOT_AVAILABLE = "NotAvailable"


class Mf4Table:
    """Writes at ``close``."""

    def __init__(self, path: Path, table: Table) -> None:
        self._file = file = Mf4File(path, table.start_wall_ns or 0, table.provenance)
        self.close, self.discard = file.save, file.discard
        self._table = table
        self._codes: list[dict[Value, int]] = [{} for _ in table.fields]
        self._groups = {
            message: (indices, file.group([*map(self._signal, indices)], message or "ESC values"))
            for message, indices in table.by_message().items()
        }

    def _signal(self, index: int) -> Any:
        """An empty signal of a field."""
        import numpy as np

        one, conversion = self._table.fields[index], None
        kind = "<f4" if one.kind is Kind.FLAG else "<f8"
        if one.kind is Kind.TEXT:
            kind, self._codes[index], conversion = _texts(one)
        return self._file.module.Signal(
            samples=np.array([], dtype=kind),
            timestamps=np.array([], dtype="<f8"),
            name=one.name,
            unit=one.unit,
            conversion=conversion,
            comment=one.message,
        )

    def write(self, row: Row) -> None:
        """Add a row."""
        indices, group = self._groups[self._table.message_of(row.values)]
        values, codes = row.values, self._codes
        of_group = [codes[i][values[i]] if codes[i] else values[i] for i in indices]
        group.write(row.time_ns, of_group)

    def write_block(self, block: RowBlock) -> None:
        """Add many rows."""
        for row in rows_of_block(block):
            self.write(row)


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
