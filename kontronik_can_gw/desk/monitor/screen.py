"""The screen of the monitor: a table of all ESCs, or one ESC's page with everything, for a terminal of any size. Pure."""

from collections.abc import Iterator, Sequence
from math import inf

from rich.text import Text

from kontronik_can_gw.desk.member import Alarm, Flag, alarms_of
from kontronik_can_gw.desk.monitor.lines import (
    STATES,
    Part,
    alarm_lines,
    cut,
    line,
    number,
    shorten,
    table,
    words,
    wrapped,
)
from kontronik_can_gw.desk.monitor.model import (
    HISTORY_S,
    QUANTITIES,
    SILENCE_NS,
    Esc,
    Monitor,
    Quantity,
)
from kontronik_can_gw.desk.sources import Source
from kontronik_can_gw.esc.decoder import Severity
from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.runtime.system.fault_log import duration
from kontronik_can_gw.times import MS

_LEVELS = "▁▂▃▄▅▆▇█"
_MARKS = {"": "bold", "!": "bold yellow", "!!": "bold red"}
"""Styles of what is marked; the marks are for displays without colour."""
_NO_TELEMETRY = "no telemetry{since}: is the ESC powered, its cable plugged in?"
_TROUBLES = {
    "searching": "bytes come but no telemetry: right port? Does the ESC send {protocol} telemetry?",
    "porterror": "the gateway cannot open the port: look at its log, or kontronik-can-gw status",
}
_PAGE_WIDTHS = (16, 5, 8, 8, 8)
"""Minimum widths of a page's columns: name, unit, value, minimum, maximum."""
_HISTORY_WIDTHS = (16, 5, 8)
"""Minimum widths of the columns between name and history below the table of all ESCs."""
_HISTORIES = QUANTITIES[:4]
"""Quantities whose histories are shown below the table of all ESCs."""
_NAME_WIDTH, _LINK_WIDTH, _STATE_WIDTH, _VALUE_WIDTH = 7, 9, 12, 5
"""Minimum widths of the columns of the table of all ESCs. States are cut to their width."""
_SHORT_STATE_WIDTHS = (10, 6)
"""Widths of the states if names leave no room for the kept columns; the second one if names are cut, too."""
_LAST_KEPT = next(i for i, each in enumerate(QUANTITIES) if each.source == "consumed_charge")
"""Names are cut before a column up to this quantity is left out."""
_ALARM_LINES, _FEW_ALARM_LINES = 6, 2
"""Kept for errors and warnings on a page, and below the table, where room is short."""
_MAX_CHART_LINES = 8


def screen(
    monitor: Monitor, source: Source, size: tuple[int, int], page: int, keys: bool = True
) -> list[Text]:
    """The whole screen, within ``size`` (columns, lines). ``page``: an ESC's number, 0 for all. ``keys``: they are read."""
    width, height = max(20, size[0]), max(4, size[1])
    lines = [_title(monitor, source)]
    for text, style in notices(monitor, source):
        lines += wrapped(text, style, width)
    room = height - len(lines) - 1
    escs = monitor.escs if page == 0 else monitor.escs[page - 1 : page]
    if len(escs) == 1:
        kept = len(alarms(escs, width, _ALARM_LINES))
        # errors come and go: the heights of the charts must not depend on them
        body = _page(escs[0], width, room - 1 - _ALARM_LINES)[: max(2, room - 1 - kept)]
    else:
        kept = len(alarms(escs, width, _FEW_ALARM_LINES))
        body = cut(table_of(escs, width), max(2, room - 1 - kept))
        body += _histories(escs, width, room - 1 - _ALARM_LINES - len(body))
    lines += [*body, line()]
    lines += alarms(escs, width, max(0, height - 1 - len(lines)))
    lines = [*lines, *[line()] * height][: height - 1]
    lines.append(_foot(len(monitor.escs), source, keys))
    for each in lines:
        each.truncate(width, overflow="ellipsis")
    return lines


def notices(monitor: Monitor, source: Source) -> Iterator[tuple[str, str]]:
    """Notices about gateway and source, with their style."""
    frames = f"frames of {monitor.file} on {source.name}"
    if monitor.is_replay and not source.is_file:
        text = "REPLAY: the gateway plays a recording; these are not values of a live ESC."
        yield text, "bold black on yellow"
    if source.problem:
        yield source.problem, "bold red"
    elif source.ended and not monitor.view.frames:
        text = f"{source.name} holds no frame of {monitor.file}. Give the DBC of its frames (-c, --dbc)."
        yield text, "bold red"
    elif monitor.silent_ns >= SILENCE_NS and not source.is_file:
        yield f"no {frames}", "bold red"
        yield from ((hint, "yellow") for hint in source.hints)
    elif not monitor.view.frames and not source.is_file:
        yield f"waiting for {frames} ...", "dim"
    count, known = monitor.gateway.number("esc_count"), len(monitor.escs)
    if count is not None and count > known:
        text = f"the gateway has {count:.0f} ESCs, the DBC in use describes {known}: give its configuration (-c) or DBC (--dbc)."
        yield text, "yellow"


def _title(monitor: Monitor, source: Source) -> Text:
    made = line((f" {source.name} ", "bold reverse"))
    if source.simulation:
        made.append(f"  {source.simulation}", "bold yellow")
    else:
        made.append(f"  {source.progress}" if source.is_file else f"  {monitor.file}", "dim")
    if (state := monitor.gateway.text("gateway_state")) is not None:
        made = line(made, "  gateway ", (words(state), STATES.get(words(state), "yellow")))
    can_state = monitor.gateway.text("can_state") or "unknown"
    if normalize(can_state) not in ("unknown", "erroractive"):
        made = line(made, (f"  CAN {words(can_state)}", "yellow"))
    return line(made, f"  {number(monitor.frame_rate)} frames/s")


def _foot(count: int, source: Source, works: bool) -> Text:
    if not works:
        return line(("Ctrl-C ends", "dim"))
    one = f"  1-{min(9, count)} n p one ESC  0 all" if count > 1 else ""
    pause = "  space pause" if source.is_file else ""
    return line((f"q quit{one}{pause}  r reset min/max", "dim"))


def _link_part(esc: Esc) -> Part:
    if esc.link is None:
        link = "-" if esc.has("link_state") or not esc.is_known(Group.LIVE) else "ok"
    else:
        link = words(esc.link)
    rate = esc.number("frame_rate")
    text = link if rate is None or link != "ok" else f"ok {rate:.0f} Hz"
    return text, STATES.get(link, "bold red")


def _state_part(esc: Esc) -> Part:
    return ("-", "dim") if esc.state is None else (words(esc.state), "bold cyan")


def _name_part(esc: Esc, width: int | None = None) -> Part:
    """The name, with a mark if there are errors or warnings. ``width``: the name is shortened to fit."""
    severities = {flag.severity for flag in alarms_of(esc.active)}
    mark = "!!" if Severity.ERROR in severities else "!" * (Severity.WARNING in severities)
    suffix = f" {mark}" if mark else ""
    name = esc.name if width is None else shorten(esc.name, width - len(suffix))
    return name + suffix, _MARKS[mark]


def _value_part(esc: Esc, quantity: Quantity) -> Part:
    """The present value; beyond its limits it is marked."""
    value = esc.number(quantity.source)
    mark = "" if value is None else quantity.mark(value)
    return mark + number(value, quantity.digits), "dim" if value is None else _MARKS[mark]


def sparkline(esc: Esc, quantity: Quantity, width: int, height: int = 1) -> list[Text]:
    """The last ``width`` seconds of a value between its extremes, the newest at the right.

    Returns ``height`` lines, the top one first.
    """
    track = esc.tracks[quantity.source]
    values = list(track.history)[-width:] if width else []
    scale = [value for value in (*values, track.low, track.high) if value is not None]
    low, span = min(scale, default=0.0), max(scale, default=0.0) - min(scale, default=0.0)
    steps = len(_LEVELS) * height
    made = [line() for _ in range(height)]
    for value in values:
        if value is None:  # not available
            filled, style = 0, ""
        else:
            part = (value - low) / span if 0 < span < inf else 0
            filled = 1 + round(part * (steps - 1))
            style = _MARKS.get(quantity.mark(value) or "-", "cyan")
        for index, each in enumerate(made):
            level = filled - len(_LEVELS) * (height - 1 - index)
            each.append(_LEVELS[min(level, len(_LEVELS)) - 1] if level > 0 else " ", style)
    return made


def _trouble(esc: Esc) -> Flag | None:
    """What is wrong with the link of an ESC, with the remedy."""
    link, age = normalize(esc.link or ""), esc.number("data_age")
    if esc.is_known(Group.LIVE) or link in ("", "ok"):
        remedy = "Look at cable and ground."
        damaged = Flag("link", Severity.WARNING, "frames are damaged", remedy)
        return damaged if link == "degraded" else None
    since = "" if age is None or link == "neverseen" else f" for {duration(round(age * MS))}"
    text = _TROUBLES.get(link, _NO_TELEMETRY)
    text = text.format(protocol=esc.protocol.name.upper(), since=since)
    return Flag("link", Severity.ERROR, text)


def alarms(escs: Sequence[Esc], width: int, room: int = 999) -> list[Text]:
    """Errors and warnings of the ESCs."""
    found: list[tuple[str, Alarm]] = []
    for esc in escs:
        trouble = _trouble(esc)
        flags = alarms_of([*([trouble] if trouble else []), *esc.active])
        found += [(f"{esc.name} " if len(escs) > 1 else "", flag) for flag in flags]
    if found:
        return alarm_lines(found, width, room)
    known = any(esc.state is not None for esc in escs)
    return [line(("no errors, no warnings", "green") if known else ("errors: -", "dim"))][:room]


def _page(esc: Esc, width: int, height: int) -> list[Text]:
    """Everything of one ESC, the most important first. The charts use ``height`` lines if that is enough."""
    age, cells = esc.number("data_age"), esc.number("cell_count")
    head = line(_name_part(esc), "  ", _state_part(esc), "  link ", _link_part(esc))
    if age is not None:
        head.append(f", age {age:.0f} ms" if age < 1000 else f", age {duration(round(age * MS))}")
    about = (esc.device_text or "-") + (f", {cells:.0f} cells" if cells else "")
    if esc.has("crc_errors", "dropped_bytes"):
        about += f"  CRC errors {number(esc.number('crc_errors'))}"
        about += f", dropped bytes {number(esc.number('dropped_bytes'))}"
    seconds = max(0, min(HISTORY_S, width - sum(_PAGE_WIDTHS) - len(_PAGE_WIDTHS)))
    heads = ("", "", "now", "min", "max", f"last {seconds} s")
    rows: list[list[Part]] = [[(text, "dim") for text in heads]]
    shown = [quantity for quantity in QUANTITIES if esc.has(quantity.source)]
    heights = _chart_heights(len(shown), height - len(rows) - 2)
    for quantity, lines in zip(shown, heights, strict=True):
        track = esc.tracks[quantity.source]
        extremes = (number(each, quantity.digits) for each in (track.low, track.high))
        names = (quantity.label, "dim"), (quantity.unit, "dim")
        chart = sparkline(esc, quantity, seconds, lines)
        rows += _chart_rows((*names, _value_part(esc, quantity), *extremes), chart)
    return [head, line((about, "dim")), *table(rows, width, 2, (*_PAGE_WIDTHS, seconds))]


def _chart_heights(count: int, height: int) -> list[int]:
    """Lines of each of ``count`` charts in ``height`` lines, at least one; the first ones get the rest."""
    each, more = divmod(height, max(1, count))
    lines = [each + (index < more) for index in range(count)]
    return [max(1, min(_MAX_CHART_LINES, number)) for number in lines]


def _chart_rows(cells: Sequence[Part], chart: Sequence[Text]) -> Iterator[list[Part]]:
    """Rows of a table whose last column is a chart; the other cells are in the first row."""
    blank = [""] * len(cells)
    for index, part in enumerate(chart):
        yield [*(blank if index else cells), part]


def _histories(escs: Sequence[Esc], width: int, height: int) -> list[Text]:
    """Charts of the most important quantities of all ESCs after an empty line; [] if they do not fit."""
    known = [each for each in _HISTORIES if any(esc.has(each.source) for esc in escs)]
    shown = known[: max(0, height - 2) // max(1, len(escs))]
    charts = [(each, esc) for each in shown for esc in escs if esc.has(each.source)]
    names = max(len(esc.name) for esc in escs)
    seconds = min(HISTORY_S, width - names - 1 - sum(_HISTORY_WIDTHS) - len(_HISTORY_WIDTHS))
    if not charts or seconds <= 0:
        return []
    lines = min(_chart_heights(len(charts), height - 2))
    heads = ("ESC", "", "", "now", f"last {seconds} s")
    rows: list[list[Part]] = [[(text, "dim") for text in heads]]
    for quantity, esc in charts:
        about = esc.name, (quantity.label, "dim"), (quantity.unit, "dim")
        chart = sparkline(esc, quantity, seconds, lines)
        rows += _chart_rows((*about, _value_part(esc, quantity)), chart)
    return [line(), *table(rows, width, 3, (names, *_HISTORY_WIDTHS, seconds))]


def table_of(escs: Sequence[Esc], width: int) -> list[Text]:
    """The table of all ESCs: the values of the DBC, with one speed, in front."""
    found = [q for q in QUANTITIES if any(esc.has(q.source) for esc in escs)]
    speeds = [q for q in found if q.unit == "1/min"]
    shown = [*speeds[:1], *(q for q in found if q.head and q not in speeds)]
    kept = sum(q in speeds or QUANTITIES.index(q) <= _LAST_KEPT for q in shown)
    values: list[list[Part]] = [[(q.head or q.unit, "dim") for q in shown]]
    values += [[_value_part(esc, q) for q in shown] for esc in escs]
    links = [_link_part(esc) for esc in escs]
    room = width - _widest(links, _LINK_WIDTH) - 2
    for column in range(kept):
        room -= _widest([row[column] for row in values], _VALUE_WIDTH) + 1
    name_width, state_width = _name_and_state_widths(escs, room)
    rows: list[list[Part]] = [[("ESC", "dim"), ("link", "dim"), ("state", "dim"), *values[0]]]
    for esc, link, cells in zip(escs, links, values[1:], strict=True):
        state = line(_state_part(esc))
        state.truncate(state_width, overflow="ellipsis")
        rows.append([_name_part(esc, name_width), link, state, *cells])
    least = (_NAME_WIDTH, _LINK_WIDTH, state_width, *[_VALUE_WIDTH] * len(shown))
    return table(rows, width, 3, least)


def _name_and_state_widths(escs: Sequence[Esc], room: int) -> tuple[int, int]:
    """Widths of the columns of names and states that fit into ``room``, or the smallest ones."""
    names = _widest([_name_part(esc) for esc in escs], _NAME_WIDTH)
    short, shortest = _SHORT_STATE_WIDTHS
    for state in (_STATE_WIDTH, short):
        if names + state <= room:
            return names, state
    if _NAME_WIDTH + short <= room:
        return room - short, short
    return _NAME_WIDTH, max(shortest, min(short, room - _NAME_WIDTH))


def _widest(parts: Sequence[Part], least: int) -> int:
    """Width of a column with these cells."""
    return max(least, *(line(part).cell_len for part in parts))
