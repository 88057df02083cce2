"""Renders tables as Markdown (CommonMark with GitHub's tables). All texts are escaped."""

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from textwrap import indent
from typing import Any, NamedTuple

Row = dict[str, Any]
_HEX = {"id": 3, "cob_id": 3, "code": 4}
"""Columns of numbers that people write in hexadecimal, with digits."""


class Code(str):
    """Lines to type, which are shown as they are."""

    __slots__ = ()


class Table(NamedTuple):
    """Rows of plain data, all with the same keys: the columns. ``by``: a column with headings of their own for each of its values."""

    title: str
    text: Sequence[str] = ()
    rows: Sequence[Row] = ()
    by: str = ""


def markdown(title: str, lead: Iterable[str], tables: Iterable[Table]) -> str:
    """The Markdown text, ending with a line end. Columns that are empty in all rows of a table are left out."""
    blocks = [f"# {text(title)}", *map(text, lead)]
    for table in tables:
        blocks.append(f"## {text(table.title)}")
        blocks += [indent(t, "    ") if isinstance(t, Code) else text(t) for t in table.text]
        if table.by:
            for head, rows in groupby(table.rows, key=lambda row: row[table.by]):
                blocks += [f"### {text(str(head))}", _rows(list(rows), table.by)]
        elif table.rows:
            blocks.append(_rows(table.rows))
    return "\n\n".join(filter(None, blocks)) + "\n"


def _rows(rows: Sequence[Row], without: str = "") -> str:
    cells = [{key: _cell(key, value) for key, value in row.items()} for row in rows]
    keys = [key for key in rows[0] if key != without and any(row[key] for row in cells)]
    lines = [[text(key.replace("_", " ")) for key in keys], ["---"] * len(keys)]
    lines += [[row[key] for key in keys] for row in cells]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(key: str, value: object) -> str:
    """A cell: None and False are empty, True is yes, a value table is ``0 Off, 1 On``."""
    if value is None or isinstance(value, bool):
        return "yes" if value else ""
    if isinstance(value, int) and (
        key in _HEX or (abs(value) > 0xFFFFFF and key not in ("min", "max"))
    ):
        return f"{value:0{_HEX.get(key, 1)}X}h"
    if isinstance(value, float):
        return f"{value:.10g}"
    if isinstance(value, Mapping):
        return text(", ".join(f"{name} {word}" for name, word in value.items()))
    return text(", ".join(map(str, value)) if isinstance(value, list) else str(value))


def text(content: str) -> str:
    """Running text in one line, with every character of Markdown syntax escaped."""
    plain = " ".join(content.split())
    masked = re.sub(r"([\\`*\[\]<>|~&$])", r"\\\1", plain)
    masked = re.sub(r"(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])", r"\\_", masked)
    # no accidental links
    masked = re.sub(r"(https?|ftp)(://)|(www)(\.)", r"\1\3<!-- -->\2\4", masked)
    # no headings or lists, no closing of a heading
    masked = re.sub(r"^([#+=-])|(?<= )(#+)$", r"\\\1\2", masked)
    return re.sub(r"^(\d+)([.)])(?= |$)", r"\1\\\2", masked)
