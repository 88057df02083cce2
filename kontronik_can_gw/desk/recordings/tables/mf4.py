"""Tables as MF4 measurement files by asammdf (an extra): signals with units and value texts.

Numbers are floats, NaN where not available; texts are raw numbers with a conversion, ``NotAvailable`` where not available. All signals
share one channel group and one time, of a table of CAN frames those of each message.
"""

from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from kontronik_can_gw.desk.recordings.can_logs.mf4 import asammdf_module, quiet, save_mf4, set_start
from kontronik_can_gw.desk.recordings.columns import Values
from kontronik_can_gw.desk.recordings.fields import Field, Kind, Table
from kontronik_can_gw.desk.recordings.tables.rows import SECOND_NS, Row
from kontronik_can_gw.signals.unpacker import Value

ROWS = 8192
NOT_AVAILABLE = "NotAvailable"


class Mf4Table:
    """Writes at ``close``, from asammdf's temporary file in the target's folder."""

    def __init__(self, path: Path, table: Table) -> None:
        module = asammdf_module()
        self._path = path
        self._provenance = table.provenance
        self._nothing: list[Values] = [(None,) * len(part) for part in table.parts()]
        with quiet():
            self._mdf: Any = module.MDF(version="4.10", temporary_folder=str(path.parent))
            set_start(self._mdf, table.start_wall_ns or 0)
            self._by_frame = table.by_frame
            named: dict[Value, tuple[str, Sequence[int]]] = {
                None: ("ESC values", range(len(table.fields)))
            }
            if table.by_frame:
                messages = dict.fromkeys(one.message for one in table.fields[2:])
                named = {message: (message, table.indices(message)) for message in messages}
            self._groups = {
                key: _Group(self._mdf, module, table.fields, indices, name)
                for key, (name, indices) in named.items()
            }

    def write(self, row: Row) -> None:
        """Add a row."""
        parts = zip(row.parts, self._nothing, strict=True)
        values = list(chain.from_iterable(nothing if p is None else p for p, nothing in parts))
        self._groups[values[1] if self._by_frame else None].write(row.time_ns, values)

    def close(self) -> None:
        """Write the file."""
        for group in self._groups.values():
            group.flush()
        save_mf4(self._mdf, self._path, self._provenance)

    def discard(self) -> None:
        """Close asammdf's temporary file."""
        with quiet():
            self._mdf.close()


class _Group:
    """One channel group."""

    def __init__(
        self, mdf: Any, module: Any, fields: Sequence[Field], indices: Sequence[int], name: str
    ) -> None:
        import numpy as np

        self._np = np
        self._mdf = mdf
        self._times: list[int] = []
        self._rows: list[Sequence[Value]] = []
        self._last = -(1 << 62)
        self._codes: list[tuple[int, str, dict[Value, int]]] = []
        """Of each field its index, type and the codes of its texts."""
        signals = []
        for index in indices:
            one = fields[index]
            codes: dict[Value, int] = {}
            conversion: dict[str, object] | None = None
            kind = "<f4" if one.kind is Kind.FLAG else "<f8"
            if one.kind is Kind.TEXT:
                texts = {number: text for number, text in one.texts if text != NOT_AVAILABLE}
                missing = next(
                    (number for number, text in one.texts if text == NOT_AVAILABLE),
                    max(texts, default=-1) + 1,
                )
                texts[missing] = NOT_AVAILABLE
                codes = {text: number for number, text in texts.items()} | {None: missing}
                kind = "<i8" if min(texts) < 0 else "<u1" if max(texts) < 256 else "<u4"
                conversion = {"default": ""}
                for place, (number, text) in enumerate(sorted(texts.items())):
                    conversion |= {f"val_{place}": number, f"text_{place}": text}
            self._codes.append((index, kind, codes))
            signals.append(
                module.Signal(
                    samples=np.array([], dtype=kind),
                    timestamps=np.array([], dtype="<f8"),
                    name=one.name,
                    unit=one.unit,
                    conversion=conversion,
                    comment=one.message,
                )
            )
        self._number = mdf.append(signals, acq_name=name, comment=name, common_timebase=True)

    def write(self, time_ns: int, values: Sequence[Value]) -> None:
        """Add a row; what is earlier than its predecessor gets that one's time, for a master channel only rises."""
        self._last = max(self._last, time_ns)
        self._times.append(self._last)
        self._rows.append(values)
        if len(self._rows) >= ROWS:
            self.flush()

    def flush(self) -> None:
        """Hand what has gathered to asammdf."""
        np = self._np
        if not self._rows:
            return
        columns = list(zip(*self._rows, strict=True))
        times = np.array(self._times, dtype=np.int64) / SECOND_NS
        arrays = [(times, None)]
        for index, kind, codes in self._codes:
            column = [codes[value] for value in columns[index]] if codes else columns[index]
            arrays.append((np.array(column, dtype=kind), None))
        self._rows.clear()
        self._times.clear()
        with quiet():
            self._mdf.extend(self._number, arrays)
