"""Lines of text for a terminal, made printable: words, numbers, tables, sparklines. Pure."""

import textwrap
from collections.abc import Sequence
from typing import NamedTuple

from rich.text import Text

from kontronik_can_gw.esc.decoder import Severity
from kontronik_can_gw.printable import printable

GOOD, POOR, BAD, FAINT, TITLE = "green", "yellow", "bold red", "dim", "bold"

LINKS = {"ok": GOOD, "degraded": POOR, "-": FAINT}
"""Styles of link states; any other is bad."""
_SEVERITIES = {Severity.ERROR: BAD, Severity.WARNING: POOR, Severity.STATUS: ""}

Part = str | tuple[str, str] | Text
"""Text without a style, text with a style of rich, or a finished part of a line."""


class Glyphs(NamedTuple):
    """Characters available on the terminal. ``levels``: of a sparkline, lowest first."""

    levels: str = "▁▂▃▄▅▆▇█"
    degree: str = "°C"
    rule: str = "╌"


UNICODE = Glyphs()
ASCII = Glyphs("_.,-~=*#", "degC", "-")


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


def wrapped(text: str, style: str, width: int | None) -> list[Text]:
    """The text as lines of this width; None: one line."""
    if width is None:
        return [line((text, style))]
    parts = textwrap.wrap(text, max(20, width), subsequent_indent="    ", break_on_hyphens=False)
    return [line((part, style)) for part in parts]


def ends(left: Text, right: Text, width: int) -> Text:
    """A line with text at both ends; the left one is cut where they do not fit."""
    left.truncate(max(0, width - right.cell_len), overflow="ellipsis", pad=True)
    return line(left, right)


def table(
    rows: Sequence[Sequence[Part]], width: int | None, left: int = 1, least: Sequence[int] = ()
) -> list[Text]:
    """Lines of aligned columns; those that do not fit are left out from the right.

    ``left``: number of left-aligned columns. ``least``: their minimum widths, so that a live table does not jump.
    """
    cells = [[line(part) for part in row] for row in rows]
    widths = [max(cell.cell_len for cell in column) for column in zip(*cells, strict=True)]
    widths = [max(pair) for pair in zip(widths, [*least, *[0] * len(widths)], strict=False)]
    while width is not None and sum(widths) + len(widths) - 1 > width and len(widths) > 1:
        widths.pop()
    lines = []
    for row in cells:
        made = line()
        for number, wide in enumerate(widths):
            row[number].align("left" if number < left else "right", wide)
            made.append_text(row[number]).append(" " if number < len(widths) - 1 else "")
        lines.append(made)
    return lines


def cut(lines: list[Text], height: int | None, rest: str) -> list[Text]:
    """The lines that fit; the last one counts those left out, followed by the text ``rest``."""
    if height is None or len(lines) <= height:
        return lines
    more = f"... and {len(lines) - height + 1} {rest}"
    return [*lines[: max(0, height - 1)], line((more, FAINT))][: max(0, height)]


class Alarm(NamedTuple):
    """Something wrong, in words, and what to do."""

    severity: Severity
    text: str
    remedy: str = ""


def alarm_lines(alarms: Sequence[Alarm], width: int | None, room: int | None) -> list[Text]:
    """Errors before warnings, with remedies where there is room."""
    found = sorted(alarms, key=lambda alarm: list(_SEVERITIES).index(alarm.severity))
    lines: list[Text] = []
    for with_remedy in (True, False):
        lines = []
        for severity, text, remedy in found:
            lines += wrapped(text, _SEVERITIES[severity], width)
            if remedy and with_remedy:
                lines += wrapped(f"  -> {remedy}", "", width)
        if room is None or len(lines) <= room:
            break
    return cut(lines, room, "lines more of errors and warnings")


def number(value: float | None, digits: int = 0) -> str:
    """A formatted value in groups of three digits; a dash where it is not available."""
    return "-" if value is None else f"{value:,.{digits}f}".replace(",", " ")


def duration(seconds: float) -> str:
    """A time span in words."""
    whole = max(0, int(seconds))
    if whole < 100:
        return f"{whole} s"
    if whole < 6000:
        return f"{whole // 60} min"
    if whole < 48 * 3600:
        return f"{whole // 3600} h {whole // 60 % 60} min"
    return f"{whole // 86_400} days {whole // 3600 % 24} h"


def age_text(milliseconds: float | None) -> str:
    """The age of data."""
    if milliseconds is None:
        return "-"
    return f"{milliseconds:.0f} ms" if milliseconds < 10_000 else duration(milliseconds / 1000)


def compact(count: float | None) -> str:
    """A count in four or five characters."""
    if count is None:
        return "-"
    for limit, divisor, unit in ((100_000, 1, ""), (10**8, 1000, "k"), (10**11, 10**6, "M")):
        if count < limit:
            return f"{int(count) // divisor}{unit}"
    return f"{int(count) // 10**9}G"
