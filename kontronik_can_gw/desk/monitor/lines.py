"""Lines of text for a terminal, made printable: words, numbers, tables. Pure."""

import re
import textwrap
from collections.abc import Iterable, Sequence

from rich.text import Text

from kontronik_can_gw.desk.member import Alarm
from kontronik_can_gw.esc.decoder import Severity
from kontronik_can_gw.printable import printable

STATES = {
    **dict.fromkeys(("ok", "error-active", "running"), "green"),
    **dict.fromkeys(("degraded", "error-warning", "error-passive"), "yellow"),
    "unknown": "",
    "-": "dim",
}
"""Styles of states of a link, a CAN controller and a gateway; any other is bad."""
_KINDS = {Severity.ERROR: ("ERROR", "bold red"), Severity.WARNING: ("WARNING", "yellow")}

Part = str | tuple[str, str] | Text
"""Text without a style, text with a style of rich, or a finished part of a line."""


def line(*parts: Part) -> Text:
    """A line that is cut, not wrapped, where it is too long."""
    made = Text(no_wrap=True, overflow="ellipsis", end="")
    for part in parts:
        if isinstance(part, Text):
            made.append_text(part)
        else:
            text, style = (part, "") if isinstance(part, str) else part
            made.append(printable(text), style)
    return made


def wrapped(text: str, style: str, width: int) -> list[Text]:
    """The text as lines of this width."""
    parts = textwrap.wrap(text, max(20, width), subsequent_indent="    ", break_on_hyphens=False)
    return [line((part, style)) for part in parts]


def table(
    rows: Sequence[Sequence[Part]], width: int, left: int, least: Sequence[int]
) -> list[Text]:
    """Lines of aligned columns; those that do not fit are left out from the right.

    ``left``: number of left-aligned columns. ``least``: their minimum widths, so that a live table does not jump.
    """
    cells = [[line(part) for part in row] for row in rows]
    widths = [
        max(wide, *(cell.cell_len for cell in column))
        for wide, column in zip(least, zip(*cells, strict=True), strict=True)
    ]
    while sum(widths) + len(widths) - 1 > width and len(widths) > 1:
        widths.pop()
    for row in cells:
        for number, (cell, wide) in enumerate(zip(row, widths, strict=False)):
            cell.align("left" if number < left else "right", wide)
    return [line(Text(" ").join(row[: len(widths)])) for row in cells]


def alarm_lines(alarms: Iterable[tuple[str, Alarm]], width: int, room: int = 999) -> list[Text]:
    """Errors and warnings, each after a name, with remedies where there is room."""
    lines: list[Text] = []
    for with_remedy in (True, False):
        lines = []
        for name, flag in alarms:
            kind, style = _KINDS.get(flag.severity, ("note", ""))
            lines += wrapped(f"{name}{kind}: {flag.meaning}", style, width)
            if flag.remedy and with_remedy:
                lines += wrapped(f"  -> {flag.remedy}", "", width)
        if len(lines) <= room:
            return lines
    return cut(lines, room)


def cut(lines: list[Text], room: int) -> list[Text]:
    """The lines that fit; the last one counts those left out."""
    if len(lines) <= room:
        return lines
    more = line((f"... and {len(lines) - room + 1} lines more: enlarge the terminal", "dim"))
    return [*lines[: max(0, room - 1)], more][: max(0, room)]


def words(text: str) -> str:
    """A name as people write it: ``SpoolUpFromStill`` -> ``spool up from still``, ``RpmControl`` -> ``RPM control``."""
    parts = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W_]", text)
    return " ".join(
        part if len(part) > 1 and part.isupper() else part.lower() for part in parts
    ).replace("rpm", "RPM")


def shorten(name: str, width: int) -> str:
    """A name of at most ``width`` characters: without its middle, because names often differ at an end."""
    if len(name) <= width:
        return name
    tail = max(0, (width - 1) // 2)
    head = max(0, width - 1 - tail)
    return f"{name[:head]}…{name[len(name) - tail :]}"


def number(value: float | None, digits: int = 0) -> str:
    """A formatted value in groups of three digits; a dash where it is not available."""
    return "-" if value is None else f"{value:,.{digits}f}".replace(",", " ")
