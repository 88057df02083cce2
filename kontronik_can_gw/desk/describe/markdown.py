"""Renders a document as Markdown (CommonMark with GitHub's tables). All texts are escaped."""

import re
from collections.abc import Iterator

from kontronik_can_gw.desk.describe.document import Code, Document, Section, Table


def markdown(document: Document) -> str:
    """The Markdown text, ending with a line end."""
    return "\n\n".join(_blocks(document)) + "\n"


def _blocks(document: Document) -> Iterator[str]:
    yield f"# {text(document.title)}"
    yield from map(text, document.lead)
    yield "\n".join(f"* [{text(s.title)}](#{s.anchor})" for s in document.sections if s.level == 2)
    for section in document.sections:
        yield from _section(section)


def _section(section: Section) -> Iterator[str]:
    yield f"{'#' * section.level} {text(section.title)}"
    for block in section.blocks:
        yield _table(block) if isinstance(block, Table) else text(block)


def _table(table: Table) -> str:
    rows = (table.head, ("---",) * len(table.head))
    lines = [*(f"| {' | '.join(row)} |" for row in rows)]
    lines += [f"| {' | '.join(map(cell, row))} |" for row in table.rows]
    return "\n".join(lines)


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
