"""Renders tables as Markdown: CommonMark with GitHub's tables. All texts are escaped."""

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from operator import itemgetter
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


class MarkdownTable(NamedTuple):
    """A table of plain data."""

    title: str
    text: Sequence[str] = ()
    """Paragraphs before the table."""
    rows: Sequence[Row] = ()
    """All rows have the same keys, which are the columns."""
    by: str = ""
    """A column whose values become headings, each with a table of its rows. Empty: one table."""


def markdown(title: str, lead: Iterable[str], tables: Iterable[MarkdownTable]) -> str:
    """Return the Markdown text, with a line end at its end.

    Columns that are empty in all rows of a table are left out.
    """
    blocks = [f"# {text(title)}"]
    blocks += map(_wrapped, lead)
    for table in tables:
        blocks.append(f"## {text(table.title)}")
        for paragraph in table.text:
            if isinstance(paragraph, Code):
                blocks.append(indent(paragraph, "    "))
            else:
                blocks.append(_wrapped(paragraph))
        if table.by:
            for head, rows in groupby(table.rows, key=itemgetter(table.by)):
                blocks.append(f"### {text(str(head))}")
                blocks.append(_render_rows(list(rows), table.by))
        elif table.rows:
            blocks.append(_render_rows(table.rows))
    return "\n\n".join(filter(None, blocks)) + "\n"


def _render_rows(rows: Sequence[Row], without: str = "") -> str:
    """Return the lines of a table: head, separator and rows.

    The column ``without`` and empty columns are left out.
    """
    columns: dict[str, list[str]] = {}
    for key in rows[0]:
        cells = [_cell(key, row[key]) for row in rows]
        if key != without and any(cells):
            title = text(key.replace("_", " "))
            columns[key] = [title, "---", *cells]
    lines = zip(*columns.values(), strict=True)
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
        digits = _HEX.get(key)
        if digits is None and abs(value) > 0xFFFFFF and key not in ("min", "max"):
            digits = 1
        if digits is not None:
            return f"{value:0{digits}X}h"
    if isinstance(value, float):
        return f"{value:.10g}"
    content = str(value)
    if isinstance(value, Mapping):
        pairs = [f"{name} {word}" for name, word in value.items()]
        content = ", ".join(pairs)
    elif isinstance(value, list):
        content = ", ".join(map(str, value))
    return text(content)


def _wrapped(paragraph: str) -> str:
    """Return running text in lines, with every character of Markdown syntax escaped."""
    plain = " ".join(paragraph.split())
    lines = wrap(
        plain,
        _WIDTH,
        break_long_words=False,
        break_on_hyphens=False,
    )
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
