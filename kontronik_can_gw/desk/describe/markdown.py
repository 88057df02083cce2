"""Renders sections as Markdown (CommonMark with GitHub's tables). All texts are escaped."""

import re
from collections.abc import Sequence
from typing import NamedTuple


class Code(str):
    """A text that is a name in a program or a file."""

    __slots__ = ()


class Table(NamedTuple):
    """Cells are plain text or Code; every row is as long as ``head``."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]


class Section(NamedTuple):
    """``level`` 2 or 3. Empty blocks are left out."""

    title: str
    level: int
    blocks: Sequence[str | Table]


def markdown(title: str, lead: Sequence[str], sections: Sequence[Section]) -> str:
    """The Markdown text, ending with a line end. ``lead``: lines before the table of contents."""
    blocks = [f"# {text(title)}", *map(text, lead), _contents(sections)]
    for section in sections:
        blocks.append(f"{'#' * section.level} {text(section.title)}")
        blocks += [
            _table(block) if isinstance(block, Table) else text(block)
            for block in section.blocks
            if block
        ]
    return "\n\n".join(blocks) + "\n"


def _contents(sections: Sequence[Section]) -> str:
    titles = [section.title for section in sections if section.level == 2]
    return "\n".join(f"* [{text(title)}](#{_anchor(title)})" for title in titles)


def _anchor(title: str) -> str:
    """The anchor that GitHub makes from a heading."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def _table(table: Table) -> str:
    rows = [table.head, ["---"] * len(table.head), *(map(cell, row) for row in table.rows)]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def cell(content: str) -> str:
    """A cell of a table: one line, with bars escaped."""
    if not isinstance(content, Code):
        return text(content)
    plain = " ".join(content.split())
    if not plain:
        return ""
    ticks = "`" * (max(map(len, re.findall("`+", plain)), default=0) + 1)
    pad = " " if plain.startswith("`") or plain.endswith("`") else ""
    return f"{ticks}{pad}{plain}{pad}{ticks}".replace("|", "\\|")


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
