"""Charts of the last seconds of a value, made of block characters. Pure."""

from collections.abc import Iterator, Sequence
from math import inf

from rich.text import Text

from kontronik_can_gw.desk.monitor.lines import Part, line
from kontronik_can_gw.desk.monitor.model import Esc
from kontronik_can_gw.desk.quantities import Quantity

_LEVELS = "▁▂▃▄▅▆▇█"
MARKS = {"": "bold", "!": "bold yellow", "!!": "bold red"}
"""Styles of marked values. The marks themselves are for displays without colour."""
_MAX_CHART_LINES = 8


def sparkline(esc: Esc, quantity: Quantity, width: int, height: int = 1) -> list[Text]:
    """Return a chart of the last ``width`` seconds of a value, with the newest at the right.

    It is scaled to the extremes of the value. It has ``height`` lines, the top one first.
    """
    track = esc.tracks[quantity.source]
    values: list[float | None] = []
    if width:
        values = list(track.history)[-width:]
    scale = [value for value in (*values, track.low, track.high) if value is not None]
    low = min(scale, default=0.0)
    high = max(scale, default=0.0)
    span = high - low
    steps = len(_LEVELS) * height
    made = [line() for _ in range(height)]
    for value in values:
        filled = 0
        style = ""
        if value is not None:
            part = 0.0
            if 0 < span < inf:
                part = (value - low) / span
            filled = 1 + round(part * (steps - 1))
            mark = quantity.mark(value)
            style = MARKS[mark] if mark else "cyan"
        for above, each in enumerate(reversed(made)):
            level = filled - above * len(_LEVELS)
            character = " "
            if level > 0:
                character = _LEVELS[min(level, len(_LEVELS)) - 1]
            each.append(character, style)
    return made


def chart_heights(count: int, height: int) -> list[int]:
    """Distribute ``height`` lines among ``count`` charts, at least one line for each.

    The first charts get one line more if lines are left.
    """
    each, more = divmod(height, max(1, count))
    heights = []
    for index in range(count):
        lines = each
        if index < more:
            lines += 1
        lines = min(lines, _MAX_CHART_LINES)
        heights.append(max(1, lines))
    return heights


def chart_rows(cells: Sequence[Part], chart: Sequence[Text]) -> Iterator[list[Part]]:
    """Yield the rows of a table whose last column is a chart. The first row has the cells."""
    blank = [""] * len(cells)
    for index, part in enumerate(chart):
        first = blank if index else cells
        yield [*first, part]
