"""Makes printable lines of text for a terminal: words, numbers and tables. Pure."""

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
"""Styles of the states of a link, a CAN controller and a gateway. Other states are bad."""
_KINDS = {Severity.ERROR: ("ERROR", "bold red"), Severity.WARNING: ("WARNING", "yellow")}

Part = str | tuple[str, str] | Text
"""Text without a style, text with a style of rich, or a finished part of a line."""


def line(*parts: Part) -> Text:
    """Return a line that is cut, not wrapped, if it is too long."""
    made = Text(no_wrap=True, overflow="ellipsis", end="")
    for part in parts:
        if isinstance(part, Text):
            made.append_text(part)
        elif isinstance(part, str):
            made.append(printable(part), "")
        else:
            text, style = part
            made.append(printable(text), style)
    return made


def wrapped(text: str, style: str, width: int) -> list[Text]:
    """Return a text as lines of this width."""
    parts = textwrap.wrap(text, max(20, width), subsequent_indent="    ", break_on_hyphens=False)
    return [line((part, style)) for part in parts]


def table(
    rows: Sequence[Sequence[Part]], width: int, left: int, least: Sequence[int]
) -> list[Text]:
    """Return lines of aligned columns. Columns that do not fit are left out from the right.

    ``left``: number of left-aligned columns. ``least``: the minimum width of each column, so that
    the columns of a live table keep their positions.
    """
    cells = [[line(part) for part in row] for row in rows]
    widths = []
    for minimum, column in zip(least, zip(*cells, strict=True), strict=True):
        widths.append(max(minimum, *(cell.cell_len for cell in column)))
    while sum(widths) + len(widths) - 1 > width and len(widths) > 1:
        widths.pop()
    lines = []
    for row in cells:
        shown = row[: len(widths)]
        for index, cell in enumerate(shown):
            cell.align("left" if index < left else "right", widths[index])
        lines.append(line(Text(" ").join(shown)))
    return lines


def alarm_lines(alarms: Iterable[tuple[str, Alarm]], width: int, room: int = 999) -> list[Text]:
    """Return errors and warnings, each after a name. Remedies are added if there is room."""
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
    """Return the lines that fit into ``room``. The last line has the number of omitted lines."""
    if len(lines) <= room:
        return lines
    if room <= 0:
        return []
    more = line((f"... and {len(lines) - room + 1} more lines: enlarge the terminal", "dim"))
    return [*lines[: room - 1], more]


def words(text: str) -> str:
    """Return a name as separate words.

    ``SpoolUpFromStill`` becomes ``spool up from still``, ``RpmControl`` becomes ``RPM control``.
    """
    parts = []
    for part in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W_]", text):
        is_acronym = len(part) > 1 and part.isupper()
        parts.append(part if is_acronym else part.lower())
    return " ".join(parts).replace("rpm", "RPM")


def shorten(name: str, width: int) -> str:
    """Return a name of at most ``width`` characters.

    The middle of a longer name is left out, because names often differ at an end.
    """
    if len(name) <= width:
        return name
    tail = max(0, (width - 1) // 2)
    head = max(0, width - 1 - tail)
    return f"{name[:head]}…{name[len(name) - tail :]}"


def number(value: float | None, digits: int = 0) -> str:
    """Return a value in groups of three digits. A dash means not available."""
    if value is None:
        return "-"
    return f"{value:,.{digits}f}".replace(",", " ")
