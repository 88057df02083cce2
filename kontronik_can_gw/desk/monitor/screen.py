"""Renders the screen of the monitor for a terminal of any size.

It is a table of all ESCs, or the page of one ESC with all its values. Pure.
"""

from collections.abc import Iterator, Sequence
from math import inf

from rich.text import Text

from kontronik_can_gw.desk.member import Alarm, alarms_of
from kontronik_can_gw.desk.monitor.lines import (
    STATES,
    Part,
    alarm_lines,
    cut,
    line,
    number,
    shorten,
    table,
    wrapped,
)
from kontronik_can_gw.desk.monitor.model import HISTORY_S, Esc, Monitor
from kontronik_can_gw.desk.monitor.notices import NoticeKind, link_of, notices, trouble_of
from kontronik_can_gw.desk.quantities import QUANTITIES, Quantity
from kontronik_can_gw.desk.sources import Source
from kontronik_can_gw.desk.words import words
from kontronik_can_gw.esc.decoder import Severity
from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.runtime.system.fault_log import duration
from kontronik_can_gw.times import MS

_NOTICE_STYLES = {
    NoticeKind.REPLAY: "bold black on yellow",
    NoticeKind.FAULT: "bold red",
    NoticeKind.HINT: "yellow",
    NoticeKind.WAITING: "dim",
}
_FRESH_LINKS = ("ok", "degraded")
"""States of a link with live data."""
_PAGE_WIDTHS = (16, 5, 8, 8, 8)
"""Minimum widths of a page's columns: name, unit, value, minimum, maximum."""
_HISTORY_WIDTHS = (16, 5, 8)
"""Minimum widths of the columns between name and history below the table of all ESCs."""
_HISTORIES = QUANTITIES[:4]
"""Quantities whose histories are shown below the table of all ESCs."""
_NAME_WIDTH = 7
_LINK_WIDTH = 9
_STATE_WIDTHS = (24, 19, 12, 10)
"""Widths of the column of states, which are cut to it. The largest one that fits is used."""
_VALUE_WIDTH = 5
"""Minimum widths of the columns of the table of all ESCs."""
_SHORTEST_STATE_WIDTH = 6
"""Width of the states if there is no room even with shortened names."""
_LAST_KEPT = next(i for i, each in enumerate(QUANTITIES) if each.source == "consumed_charge")
"""Names are cut before a column up to this quantity is left out."""
_ALARM_LINES = 6
"""Lines that a page reserves for errors and warnings."""
_FEW_ALARM_LINES = 2
"""Lines for errors and warnings below the table of all ESCs if room is short."""


_LEVELS = "▁▂▃▄▅▆▇█"
MARKS = {"": "bold", "!": "bold yellow", "!!": "bold red"}
"""Styles of marked values. The marks themselves are for displays without colour."""
_MAX_CHART_LINES = 8


def sparkline(esc: Esc, quantity: Quantity, width: int, height: int = 1) -> list[Text]:
    """Return a chart of the last ``width`` seconds of a value, with the newest at the right.

    It is scaled to the extremes of the value. It has ``height`` lines, the top one first.
    """
    track = esc.tracks[quantity.source]
    values = list(track.history)[-width:] if width else []
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
            part = (value - low) / span if 0 < span < inf else 0.0
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
    return [max(1, min(each + (index < more), _MAX_CHART_LINES)) for index in range(count)]


def chart_rows(cells: Sequence[Part], chart: Sequence[Text]) -> Iterator[list[Part]]:
    """Yield the rows of a table whose last column is a chart. The first row has the cells."""
    blank = [""] * len(cells)
    for index, part in enumerate(chart):
        first = blank if index else cells
        yield [*first, part]


def screen(
    monitor: Monitor,
    source: Source,
    size: tuple[int, int],
    page: int,
    keys: bool = True,
) -> list[Text]:
    """Return the whole screen within ``size`` (columns, lines).

    ``page`` is the number of an ESC, or 0 for all ESCs. ``keys`` is True if keys are read.
    """
    columns, rows = size
    width = max(20, columns)
    last = max(4, rows) - 1
    """Index of the last line."""
    lines = [_title(monitor, source)]
    for text, kind in notices(monitor, source):
        lines += wrapped(text, _NOTICE_STYLES[kind], width)
    escs = monitor.escs
    if page:
        escs = escs[page - 1 : page]
    room = last - len(lines) - 1  # an empty line is below the body
    if len(escs) == 1:
        lines += _page_body(escs[0], width, room)
    else:
        lines += _table_body(escs, width, room)
    lines.append(line())
    lines += alarms(escs, width, max(0, last - len(lines)))
    while len(lines) < last:
        lines.append(line())
    lines = lines[:last]
    lines.append(_foot(len(monitor.escs), source, keys))
    for each in lines:
        each.truncate(width, overflow="ellipsis")
    return lines


def _page_body(esc: Esc, width: int, room: int) -> list[Text]:
    """Return the page of one ESC. The heights of its charts do not depend on its alarms."""
    alarm_count = len(alarms([esc], width, _ALARM_LINES))
    body = _page(esc, width, room - _ALARM_LINES)
    return body[: max(2, room - alarm_count)]


def _table_body(escs: Sequence[Esc], width: int, room: int) -> list[Text]:
    """Return the table of all ESCs, and charts if there is room."""
    alarm_count = len(alarms(escs, width, _FEW_ALARM_LINES))
    body = cut(table_of(escs, width), max(2, room - alarm_count))
    free = room - len(body)
    shown_alarms = len(alarms(escs, width, _ALARM_LINES))
    return body + _histories(escs, width, free - _ALARM_LINES, free - shown_alarms)


def _title(monitor: Monitor, source: Source) -> Text:
    parts: list[Part] = [(f" {source.name} ", "bold reverse")]
    if source.simulation:
        parts.append((f"  {source.simulation}", "bold yellow"))
    elif source.is_file:
        parts.append((f"  {source.progress}", "dim"))
    else:
        parts.append((f"  {monitor.file}", "dim"))
    state = monitor.gateway_state
    if state is not None:
        name = words(state)
        style = STATES.get(name, "yellow")
        parts.append("  gateway ")
        parts.append((name, style))
    can_state = monitor.gateway.text("can_state") or "unknown"
    if normalize(can_state) not in ("unknown", "erroractive"):
        parts.append((f"  CAN {words(can_state)}", "yellow"))
    parts.append(f"  {number(monitor.frame_rate)} frames/s")
    return line(*parts)


def _foot(count: int, source: Source, keys: bool) -> Text:
    if not keys:
        return line(("Ctrl-C ends", "dim"))
    text = "q quit"
    if count > 1:
        text += f"  1-{min(9, count)} n p one ESC  0 all"
    if source.is_file:
        text += "  space pause"
    text += "  r reset min/max"
    return line((text, "dim"))


def _link_part(esc: Esc) -> Part:
    link, text = link_of(esc)
    return text, STATES.get(link, "bold red")


def _state_part(esc: Esc) -> Part:
    if esc.state is None:
        return "-", "dim"
    return words(esc.state), "bold cyan"


def _name_part(esc: Esc, width: int | None = None) -> Part:
    """Return the name, with a mark if there are errors or warnings.

    The name is shortened to ``width``, if it is given.
    """
    severities = {flag.severity for flag in alarms_of(esc.active)}
    mark = ""
    if Severity.ERROR in severities:
        mark = "!!"
    elif Severity.WARNING in severities:
        mark = "!"
    suffix = ""
    if mark:
        suffix = f" {mark}"
    name = esc.name
    if width is not None:
        name = shorten(name, width - len(suffix))
    return name + suffix, MARKS[mark]


def _value_part(esc: Esc, quantity: Quantity) -> Part:
    """Return the present value, with a mark if it is beyond its limits."""
    value = esc.number(quantity.source)
    if normalize(esc.link or "ok") not in _FRESH_LINKS:
        value = None  # a total of the gateway, such as the energy
    text = number(value, quantity.digits)
    if value is None:
        return text, "dim"
    mark = quantity.mark(value)
    return mark + text, MARKS[mark]


def alarms(escs: Sequence[Esc], width: int, room: int = 999) -> list[Text]:
    """Return the errors and warnings of the ESCs."""
    found: list[tuple[str, Alarm]] = []
    for esc in escs:
        prefix = ""
        if len(escs) > 1:
            prefix = f"{esc.name} "
        flags = list(esc.active)
        trouble = trouble_of(esc)
        if trouble:
            flags.insert(0, trouble)
        for flag in alarms_of(flags):
            found.append((prefix, flag))
    if found:
        return alarm_lines(found, width, room)
    if room <= 0:
        return []
    if any(esc.state is not None for esc in escs):
        return [line(("no errors, no warnings", "green"))]
    return [line(("errors: -", "dim"))]


def _page(esc: Esc, width: int, height: int) -> list[Text]:
    """Return all data of one ESC, the most important first.

    The charts use ``height`` lines if that is enough.
    """
    room = width - sum(_PAGE_WIDTHS) - len(_PAGE_WIDTHS)
    seconds = max(0, min(HISTORY_S, room))
    head = _page_head(esc)
    heads = ("", "", "now", "min", "max", f"last {seconds} s")
    rows: list[list[Part]] = [[(text, "dim") for text in heads]]
    shown = [quantity for quantity in QUANTITIES if esc.has(quantity.source)]
    heights = chart_heights(len(shown), height - len(head) - 1)
    for quantity, lines in zip(shown, heights, strict=True):
        track = esc.tracks[quantity.source]
        cells: list[Part] = [
            (quantity.label, "dim"),
            (quantity.unit, "dim"),
            _value_part(esc, quantity),
            number(track.low, quantity.digits),
            number(track.high, quantity.digits),
        ]
        chart = sparkline(esc, quantity, seconds, lines)
        rows += chart_rows(cells, chart)
    least = (*_PAGE_WIDTHS, seconds)
    return head + table(rows, width, 2, least)


def _page_head(esc: Esc) -> list[Text]:
    """Return two lines with state, link, device and counters of an ESC."""
    head = line(
        _name_part(esc),
        "  ",
        _state_part(esc),
        "  link ",
        _link_part(esc),
    )
    age_ms = esc.number("data_age")
    if age_ms is not None:
        text = f"{age_ms:.0f} ms"
        if age_ms >= 1000:
            text = duration(round(age_ms * MS))
        head.append(f", age {text}")
    about = esc.device_text or "-"
    cells = esc.number("cell_count")
    if cells:
        about += f", {cells:.0f} cells"
    if esc.has("crc_errors", "dropped_bytes"):
        crc_errors = esc.number("crc_errors")
        dropped_bytes = esc.number("dropped_bytes")
        about += f"  CRC errors {number(crc_errors)}"
        about += f", dropped bytes {number(dropped_bytes)}"
    return [head, line((about, "dim"))]


def _histories(escs: Sequence[Esc], width: int, height: int, largest: int) -> list[Text]:
    """Return an empty line and charts of the most important quantities of all ESCs.

    They use ``height`` lines, so that their heights do not depend on alarms. If charts of one line
    each do not fit, they use up to ``largest``. Empty without values and if they do not fit.
    """
    known = [
        each
        for each in _HISTORIES
        if any(set(esc.tracks[each.source].history) - {None} for esc in escs)
    ]
    chart_lines = height - 2  # without the empty line and the head
    if chart_lines < len(known) * len(escs):
        chart_lines = largest - 2
    count = max(0, chart_lines) // max(1, len(escs))
    charts = [(each, esc) for each in known[:count] for esc in escs if esc.has(each.source)]
    names = max(len(esc.name) for esc in escs)
    widths = (names, *_HISTORY_WIDTHS)
    seconds = min(HISTORY_S, width - sum(widths) - len(widths))
    if not charts or seconds <= 0:
        return []
    lines = min(chart_heights(len(charts), chart_lines))
    heads = ("ESC", "", "", "now", f"last {seconds} s")
    rows: list[list[Part]] = [[(text, "dim") for text in heads]]
    for quantity, esc in charts:
        cells: list[Part] = [
            esc.name,
            (quantity.label, "dim"),
            (quantity.unit, "dim"),
            _value_part(esc, quantity),
        ]
        chart = sparkline(esc, quantity, seconds, lines)
        rows += chart_rows(cells, chart)
    least = (*widths, seconds)
    return [line(), *table(rows, width, 3, least)]


def table_of(escs: Sequence[Esc], width: int) -> list[Text]:
    """Return the table of all ESCs: the values in the DBC, with one speed before the others."""
    supplied = [
        quantity for quantity in QUANTITIES if any(esc.has(quantity.source) for esc in escs)
    ]
    speeds = [quantity for quantity in supplied if quantity.unit == "1/min"]
    shown = speeds[:1] + [each for each in supplied if each.head and each not in speeds]
    links = [_link_part(esc) for esc in escs]
    room = width - _widest(links, _LINK_WIDTH) - 2
    columns: list[list[Part]] = []
    for quantity in shown:
        head: Part = (quantity.head or quantity.unit, "dim")
        column = [head, *(_value_part(esc, quantity) for esc in escs)]
        columns.append(column)
        if quantity in speeds or QUANTITIES.index(quantity) <= _LAST_KEPT:
            room -= _widest(column, _VALUE_WIDTH) + 1
    name_width, state_width = _name_and_state_widths(escs, room)
    names: list[Part] = [("ESC", "dim")]
    names += [_name_part(esc, name_width) for esc in escs]
    states = [line(("state", "dim")), *(line(_state_part(esc)) for esc in escs)]
    for state in states:
        state.truncate(state_width, overflow="ellipsis")
    rows = list(zip(names, [("link", "dim"), *links], states, *columns, strict=True))
    least = [_NAME_WIDTH, _LINK_WIDTH, state_width]
    least += [_VALUE_WIDTH] * len(shown)
    return table(rows, width, 3, least)


def _name_and_state_widths(escs: Sequence[Esc], room: int) -> tuple[int, int]:
    """Return the widths of the columns of names and states that fit into ``room``.

    If there is not enough room, the smallest widths are returned.
    """
    names = _widest([_name_part(esc) for esc in escs], _NAME_WIDTH)
    for state in _STATE_WIDTHS:
        if names + state <= room:
            return names, state
    if room >= _NAME_WIDTH + state:
        return room - state, state
    state = min(state, room - _NAME_WIDTH)
    return _NAME_WIDTH, max(_SHORTEST_STATE_WIDTH, state)


def _widest(parts: Sequence[Part], least: int) -> int:
    """Return the width of a column with these cells."""
    return max(least, *(line(part).cell_len for part in parts))
