"""Tables as text: CSV and JSON lines. The function that makes a row's line is generated from the fields."""

import json
import math
from collections.abc import Callable, Sequence
from datetime import UTC as UTC_ZONE
from datetime import datetime
from typing import IO

from kontronik_can_gw.desk.recordings.tables.fields import TIME, UTC, Field, Kind, Table
from kontronik_can_gw.desk.recordings.tables.rows import SECOND_NS, Row
from kontronik_can_gw.signals.unpacker import Value

_Line = Callable[[str, str, Sequence[Value]], str]


def seconds_text(time_ns: int) -> str:
    """Exact decimal seconds: 6 digits where that is exact, else 9."""
    sign = "-" if time_ns < 0 else ""
    seconds, rest = divmod(abs(time_ns), SECOND_NS)
    return f"{sign}{seconds}.{rest:09d}" if rest % 1000 else f"{sign}{seconds}.{rest // 1000:06d}"


class UtcText:
    """Unix times as ISO 8601 with microseconds: ``2023-11-14T22:13:20.123456Z``; empty where it is no date."""

    def __init__(self) -> None:
        self._second = -1
        self._text = ""

    def __call__(self, wall_ns: int | None) -> str:
        if wall_ns is None:
            return ""
        second, rest = divmod(wall_ns, SECOND_NS)
        if second != self._second:
            self._second = second
            try:
                self._text = datetime.fromtimestamp(second, UTC_ZONE).strftime("%Y-%m-%dT%H:%M:%S")
            except (ValueError, OverflowError, OSError):
                self._text = ""
        return f"{self._text}.{rest // 1000:06d}Z" if self._text else ""


def csv_text(text: str) -> str:
    """Quoted where it has to be."""
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in '",\r\n') else text


class CsvTable:
    """RFC 4180 without its carriage returns: a header of names with units, comma, decimal point, UTF-8; empty where not available."""

    def __init__(self, file: IO[bytes], table: Table) -> None:
        self._write = file.write
        self._utc = UtcText()
        self._line = _compiled(table.fields, "csv", table.has_utc)
        heads = [
            f"{TIME} [s]",
            *([UTC] if table.has_utc else []),
            *(one.header for one in table.fields),
        ]
        file.write((",".join(map(csv_text, heads)) + "\n").encode())

    def write(self, row: Row) -> None:
        """Add a row."""
        time_ns, wall_ns, values = row
        self._write(self._line(seconds_text(time_ns), self._utc(wall_ns), values).encode())

    def close(self) -> None:
        """Nothing is held back."""

    def discard(self) -> None:
        """Nothing is held."""


class JsonTable:
    """One object a line, keys are the names of the signals; null where not available. ``units``: a first line with the units."""

    def __init__(self, file: IO[bytes], table: Table, units: bool = False) -> None:
        self._write = file.write
        self._utc = UtcText()
        self._by_message: dict[Value, _Line] = {}
        fields = table.fields
        if table.by_frame:
            for message in dict.fromkeys(one.message for one in fields[2:]):
                indices = [0, 1, *table.indices(message)]
                self._by_message[message] = _compiled(fields, "json", table.has_utc, indices)
        else:
            self._line = _compiled(fields, "json", table.has_utc)
        if units:
            known = {TIME: "s"} | {one.name: one.unit for one in fields if one.unit}
            file.write((json.dumps({"units": known}, ensure_ascii=False) + "\n").encode())

    def write(self, row: Row) -> None:
        """Add a row."""
        time_ns, wall_ns, values = row
        line = self._by_message[values[1]] if self._by_message else self._line
        self._write(line(seconds_text(time_ns), self._utc(wall_ns), values).encode())

    def close(self) -> None:
        """Nothing is held back."""

    def discard(self) -> None:
        """Nothing is held."""


def _compiled(
    fields: Sequence[Field], form: str, has_utc: bool, only: Sequence[int] | None = None
) -> _Line:
    """A function from time, UTC and values to a line."""
    is_csv = form == "csv"
    nothing = "" if is_csv else "null"
    names: dict[str, object] = {"finite": _finite}
    parts = ["{t}"] if is_csv else [f'{{{{"{TIME}": {{t}}']
    if has_utc:
        # where a single row has no Unix time, as in front of a damaged one
        parts.append("{u}" if is_csv else f'"{UTC}": {{w}}')
    for index in range(len(fields)) if only is None else only:
        one = fields[index]
        if one.kind is Kind.TEXT:
            quote = csv_text if is_csv else lambda text: json.dumps(text, ensure_ascii=False)
            names[f"q{index}"] = {None: nothing} | {text: quote(text) for _, text in one.texts}
            value = f"q{index}[v{index}]"
        elif one.kind is Kind.FLOAT:
            # a float signal may be infinite, which JSON does not know
            value = f"finite(v{index}, n)"
        else:
            value = f"n if v{index} is None else v{index}"
        key = "" if is_csv else json.dumps(one.name).replace("{", "{{").replace("}", "}}") + ": "
        parts.append(f"{key}{{{value}}}")
    names["n"] = nothing
    text = (",".join(parts) if is_csv else ", ".join(parts) + "}}") + "\\n"
    unpacked = ", ".join(f"v{index}" for index in range(len(fields)))
    lines = ["def line(t, u, values):", f"    {unpacked}, = values"]
    if has_utc and not is_csv:
        lines.append("    w = f'\"{u}\"' if u else 'null'")
    lines.append(f"    return f'''{text}'''")
    exec(compile("\n".join(lines), "<row of a table>", "exec"), names)  # noqa: S102  text made here, from checked fields
    return names["line"]  # type: ignore[return-value]


def _finite(value: float | None, nothing: str) -> float | str:
    return nothing if value is None or not math.isfinite(value) else value
