"""Renders tables as Markdown: CommonMark with GitHub's tables. All texts are escaped."""

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from textwrap import indent, wrap
from typing import Any, NamedTuple

Row = dict[str, Any]
_HEX = {"id": 3, "cob_id": 3, "code": 4}
"""Columns with hexadecimal numbers, and their number of digits."""
_WIDTH = 96
"""Length of a paragraph's lines before escaping, which makes them slightly longer."""


class Code(str):
    """Lines to type. They are shown unchanged, as a block of code."""

    __slots__ = ()


class Table(NamedTuple):
    """A table of plain data."""

    title: str
    text: Sequence[str] = ()
    """Paragraphs before the table."""
    rows: Sequence[Row] = ()
    """All rows have the same keys, which are the columns."""
    by: str = ""
    """A column whose values become headings, each with a table of its rows. Empty: one table."""


def markdown(title: str, lead: Iterable[str], tables: Iterable[Table]) -> str:
    """Return the Markdown text, with a line end at its end.

    Columns that are empty in all rows of a table are left out.
    """
    blocks = [f"# {text(title)}", *map(_wrapped, lead)]
    for table in tables:
        blocks.append(f"## {text(table.title)}")
        for paragraph in table.text:
            is_code = isinstance(paragraph, Code)
            blocks.append(indent(paragraph, "    ") if is_code else _wrapped(paragraph))
        if table.by:
            for head, rows in groupby(table.rows, key=lambda row: row[table.by]):
                blocks += [f"### {text(str(head))}", _render_rows(list(rows), table.by)]
        elif table.rows:
            blocks.append(_render_rows(table.rows))
    return "\n\n".join(filter(None, blocks)) + "\n"


def _render_rows(rows: Sequence[Row], without: str = "") -> str:
    cells = [{key: _cell(key, value) for key, value in row.items()} for row in rows]
    keys = [key for key in rows[0] if key != without and any(row[key] for row in cells)]
    lines = [[text(key.replace("_", " ")) for key in keys], ["---"] * len(keys)]
    lines += [[row[key] for key in keys] for row in cells]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(key: str, value: object) -> str:
    """Return the text of a cell.

    None and False are empty, True is "yes", a value table is "0 Off, 1 On".
    """
    if value is None or value is False:
        return ""
    if value is True:
        return "yes"
    if isinstance(value, int):
        is_large = abs(value) > 0xFFFFFF and key not in ("min", "max")
        if is_large or key in _HEX:
            return f"{value:0{_HEX.get(key, 1)}X}h"
    if isinstance(value, float):
        return f"{value:.10g}"
    if isinstance(value, Mapping):
        return text(", ".join(f"{name} {word}" for name, word in value.items()))
    if isinstance(value, list):
        return text(", ".join(map(str, value)))
    return text(str(value))


def _wrapped(paragraph: str) -> str:
    """Return running text in lines, with every character of Markdown syntax escaped."""
    plain = " ".join(paragraph.split())
    lines = wrap(plain, _WIDTH, break_long_words=False, break_on_hyphens=False)
    return "\n".join(map(text, lines))


def text(content: str) -> str:
    """Return running text in one line, with every character of Markdown syntax escaped."""
    plain = " ".join(content.split())
    masked = re.sub(r"([\\`*\[\]<>|~&$])", r"\\\1", plain)
    masked = re.sub(r"(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])", r"\\_", masked)
    # Addresses must not become links.
    masked = re.sub(r"(https?|ftp)(://)|(www)(\.)", r"\1\3<!-- -->\2\4", masked)
    # The text must not begin a heading, a list or the line below a table's head, or end a heading.
    masked = re.sub(r"^([#+=:-])|(?<= )(#+)$", r"\\\1\2", masked)
    return re.sub(r"^(\d+)([.)])(?= |$)", r"\1\\\2", masked)
