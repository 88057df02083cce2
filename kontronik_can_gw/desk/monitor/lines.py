"""Makes printable lines of text for a terminal: words, numbers and tables. Pure."""

import textwrap
from collections.abc import Iterable, Sequence

from rich.align import AlignMethod
from rich.text import Text

from kontronik_can_gw.desk.member import Alarm
from kontronik_can_gw.esc.decoder import Severity
from kontronik_can_gw.printable import printable

STATES = {
    "ok": "green",
    "error-active": "green",
    "running": "green",
    "degraded": "yellow",
    "error-warning": "yellow",
    "error-passive": "yellow",
    "unknown": "",
    "-": "dim",
}
"""Styles of the states of a link, a CAN controller and a gateway. Other states are bad."""
NO_BREAK = "\N{NO-BREAK SPACE}"
_KINDS = {
    Severity.ERROR: ("ERROR", "bold red"),
    Severity.WARNING: ("WARNING", "yellow"),
}
"""Head and style of an alarm. Other alarms are notes."""
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
    """Return a text as lines of this width. NO_BREAK is shown as a space."""
    parts = textwrap.wrap(
        text,
        max(20, width),
        subsequent_indent="    ",
        break_on_hyphens=False,
    )
    return [line((part.replace(NO_BREAK, " "), style)) for part in parts]


def table(
    rows: Sequence[Sequence[Part]],
    width: int,
    left: int,
    least: Sequence[int],
) -> list[Text]:
    """Return lines of aligned columns. Columns that do not fit are left out from the right.

    ``left``: number of left-aligned columns. ``least``: the minimum width of each column, so that
    the columns of a live table keep their positions.
    """
    cells = [[line(part) for part in row] for row in rows]
    columns = zip(*cells, strict=True)
    widths = []
    for minimum, column in zip(least, columns, strict=True):
        widest = max(cell.cell_len for cell in column)
        widths.append(max(minimum, widest))
    while len(widths) > 1:
        spaces = len(widths) - 1
        if sum(widths) + spaces <= width:
            break
        widths.pop()
    lines = []
    for row in cells:
        shown = row[: len(widths)]
        for index, cell in enumerate(shown):
            side: AlignMethod = "left" if index < left else "right"
            cell.align(side, widths[index])
        lines.append(line(Text(" ").join(shown)))
    return lines


def alarm_lines(alarms: Iterable[tuple[str, Alarm]], width: int, room: int = 999) -> list[Text]:
    """Return errors and warnings, each after a name. Remedies are added while there is room."""
    found: list[tuple[list[Text], list[Text]]] = []
    for name, flag in alarms:
        kind, style = _KINDS.get(flag.severity, ("note", ""))
        remedy: list[Text] = []
        if flag.remedy:
            remedy = wrapped(f"  -> {flag.remedy}", "", width)
        found.append((wrapped(f"{name}{kind}: {flag.meaning}", style, width), remedy))
    left = room - sum(len(said) for said, _ in found)
    lines: list[Text] = []
    for said, remedy in found:
        lines += said
        if len(remedy) <= left:
            lines += remedy
            left -= len(remedy)
    return cut(lines, room)


def cut(lines: list[Text], room: int) -> list[Text]:
    """Return the lines that fit into ``room``. The last line has the number of omitted lines."""
    if len(lines) <= room:
        return lines
    if room <= 0:
        return []
    kept = lines[: room - 1]
    omitted = len(lines) - len(kept)
    kept.append(line((f"... and {omitted} more lines: enlarge the terminal", "dim")))
    return kept


def shorten(name: str, width: int) -> str:
    """Return a name of at most ``width`` characters.

    The middle of a longer name is left out, because names often differ at an end.
    """
    if len(name) <= width:
        return name
    kept = max(0, width - 1)
    tail = kept // 2
    begin = name[: kept - tail]
    end = name[len(name) - tail :]
    return f"{begin}…{end}"


def number(value: float | None, digits: int = 0) -> str:
    """Return a value in groups of three digits. A dash means not available."""
    if value is None:
        return "-"
    return f"{value:,.{digits}f}".replace(",", " ")
