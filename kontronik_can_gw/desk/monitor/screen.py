"""Renders the screen of the monitor for a terminal of any size.

It is a table of all ESCs, or the page of one ESC with all its values. Pure.
"""

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
"""Styles of marked values. The marks themselves are for displays without colour."""
_NO_TELEMETRY = "no telemetry{since}: is the ESC powered and its cable plugged in?"
_TROUBLES = {
    "searching": "bytes but no telemetry: is it the right port? Does the ESC send {protocol} telemetry?",
    "porterror": "the gateway cannot open the port: see its log, or kontronik-can-gw status",
}
_PAGE_WIDTHS = (16, 5, 8, 8, 8)
"""Minimum widths of a page's columns: name, unit, value, minimum, maximum."""
_HISTORY_WIDTHS = (16, 5, 8)
"""Minimum widths of the columns between name and history below the table of all ESCs."""
_HISTORIES = QUANTITIES[:4]
"""Quantities whose histories are shown below the table of all ESCs."""
_NAME_WIDTH = 7
_LINK_WIDTH = 9
_STATE_WIDTH = 12
_VALUE_WIDTH = 5
"""Minimum widths of the columns of the table of all ESCs. States are cut to their width."""
_SHORT_STATE_WIDTH = 10
"""Width of the states if names leave no room for the kept columns."""
_SHORTEST_STATE_WIDTH = 6
"""Width of the states if there is no room even with shortened names."""
_LAST_KEPT = next(i for i, each in enumerate(QUANTITIES) if each.source == "consumed_charge")
"""Names are cut before a column up to this quantity is left out."""
_ALARM_LINES = 6
"""Lines that a page reserves for errors and warnings."""
_FEW_ALARM_LINES = 2
"""Lines for errors and warnings below the table of all ESCs if room is short."""
_MAX_CHART_LINES = 8


def screen(
    monitor: Monitor, source: Source, size: tuple[int, int], page: int, keys: bool = True
) -> list[Text]:
    """Return the whole screen within ``size`` (columns, lines).

    ``page`` is the number of an ESC, or 0 for all ESCs. ``keys`` is True if keys are read.
    """
    width = max(20, size[0])
    height = max(4, size[1])
    lines = [_title(monitor, source)]
    for text, style in notices(monitor, source):
        lines += wrapped(text, style, width)
    room = height - len(lines) - 1
    escs = monitor.escs if page == 0 else monitor.escs[page - 1 : page]
    if len(escs) == 1:
        kept = len(alarms(escs, width, _ALARM_LINES))
        # the heights of the charts must not depend on the number of errors, which changes
        page_lines = _page(escs[0], width, room - 1 - _ALARM_LINES)
        body = page_lines[: max(2, room - 1 - kept)]
    else:
        kept = len(alarms(escs, width, _FEW_ALARM_LINES))
        body = cut(table_of(escs, width), max(2, room - 1 - kept))
        body += _histories(escs, width, room - 1 - _ALARM_LINES - len(body))
    lines += body
    lines.append(line())
    lines += alarms(escs, width, max(0, height - 1 - len(lines)))
    while len(lines) < height - 1:
        lines.append(line())
    lines = lines[: height - 1]
    lines.append(_foot(len(monitor.escs), source, keys))
    for each in lines:
        each.truncate(width, overflow="ellipsis")
    return lines


def notices(monitor: Monitor, source: Source) -> Iterator[tuple[str, str]]:
    """Yield notices about gateway and source with their styles."""
    frames = f"frames of {monitor.file} on {source.name}"
    if monitor.is_replay and not source.is_file:
        text = "REPLAY: the gateway plays a recording; these are not values of a live ESC."
        yield text, "bold black on yellow"
    if source.problem:
        yield source.problem, "bold red"
    elif source.ended and not monitor.view.frames:
        text = f"{source.name} contains no frame of {monitor.file}."
        yield f"{text} Give the DBC of its frames (-c, --dbc).", "bold red"
    elif monitor.silent_ns >= SILENCE_NS and not source.is_file:
        yield f"no {frames}", "bold red"
        for hint in source.hints:
            yield hint, "yellow"
    elif not monitor.view.frames and not source.is_file:
        yield f"waiting for {frames} ...", "dim"
    count = monitor.gateway.number("esc_count")
    known = len(monitor.escs)
    if count is not None and count > known:
        text = f"the gateway has {count:.0f} ESCs, but the DBC in use describes {known}. "
        yield text + "Give its configuration (-c) or DBC (--dbc).", "yellow"


def _title(monitor: Monitor, source: Source) -> Text:
    made = line((f" {source.name} ", "bold reverse"))
    if source.simulation:
        made.append(f"  {source.simulation}", "bold yellow")
    elif source.is_file:
        made.append(f"  {source.progress}", "dim")
    else:
        made.append(f"  {monitor.file}", "dim")
    state = monitor.gateway.text("gateway_state")
    if state is not None:
        name = words(state)
        made = line(made, "  gateway ", (name, STATES.get(name, "yellow")))
    can_state = monitor.gateway.text("can_state") or "unknown"
    if normalize(can_state) not in ("unknown", "erroractive"):
        made = line(made, (f"  CAN {words(can_state)}", "yellow"))
    return line(made, f"  {number(monitor.frame_rate)} frames/s")


def _foot(count: int, source: Source, keys: bool) -> Text:
    if not keys:
        return line(("Ctrl-C ends", "dim"))
    one = f"  1-{min(9, count)} n p one ESC  0 all" if count > 1 else ""
    pause = "  space pause" if source.is_file else ""
    return line((f"q quit{one}{pause}  r reset min/max", "dim"))


def _link_part(esc: Esc) -> Part:
    link = "-"
    if esc.link is not None:
        link = words(esc.link)
    elif esc.is_known(Group.LIVE) and not esc.has("link_state"):
        link = "ok"
    text = link
    rate = esc.number("frame_rate")
    if rate is not None and link == "ok":
        text = f"ok {rate:.0f} Hz"
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
    suffix = f" {mark}" if mark else ""
    name = esc.name
    if width is not None:
        name = shorten(name, width - len(suffix))
    return name + suffix, _MARKS[mark]


def _value_part(esc: Esc, quantity: Quantity) -> Part:
    """Return the present value, with a mark if it is beyond its limits."""
    value = esc.number(quantity.source)
    if value is None:
        return number(value, quantity.digits), "dim"
    mark = quantity.mark(value)
    return mark + number(value, quantity.digits), _MARKS[mark]


def sparkline(esc: Esc, quantity: Quantity, width: int, height: int = 1) -> list[Text]:
    """Return a chart of the last ``width`` seconds of a value, with the newest at the right.

    It is scaled to the extremes of the value. It has ``height`` lines, the top one first.
    """
    track = esc.tracks[quantity.source]
    values = list(track.history)[-width:] if width else []
    scale = [value for value in (*values, track.low, track.high) if value is not None]
    low = min(scale, default=0.0)
    span = max(scale, default=0.0) - low
    steps = len(_LEVELS) * height
    made = [line() for _ in range(height)]
    for value in values:
        filled = 0
        style = ""
        if value is not None:
            part = (value - low) / span if 0 < span < inf else 0
            filled = 1 + round(part * (steps - 1))
            style = _MARKS.get(quantity.mark(value) or "-", "cyan")
        for index, each in enumerate(made):
            level = filled - len(_LEVELS) * (height - 1 - index)
            level = min(level, len(_LEVELS))
            each.append(_LEVELS[level - 1] if level > 0 else " ", style)
    return made


def _trouble(esc: Esc) -> Flag | None:
    """Return the fault of an ESC's link with its remedy. None if there is no fault."""
    link = normalize(esc.link or "")
    if esc.is_known(Group.LIVE) or link in ("", "ok"):
        if link != "degraded":
            return None
        remedy = "Check cable and ground."
        return Flag("link", Severity.WARNING, "frames are damaged", remedy)
    age = esc.number("data_age")
    since = ""
    if age is not None and link != "neverseen":
        since = f" for {duration(round(age * MS))}"
    text = _TROUBLES.get(link, _NO_TELEMETRY)
    text = text.format(protocol=esc.protocol.name.upper(), since=since)
    return Flag("link", Severity.ERROR, text)


def alarms(escs: Sequence[Esc], width: int, room: int = 999) -> list[Text]:
    """Return the errors and warnings of the ESCs."""
    found: list[tuple[str, Alarm]] = []
    for esc in escs:
        prefix = f"{esc.name} " if len(escs) > 1 else ""
        flags = list(esc.active)
        trouble = _trouble(esc)
        if trouble:
            flags.insert(0, trouble)
        found += [(prefix, flag) for flag in alarms_of(flags)]
    if found:
        return alarm_lines(found, width, room)
    summary = ("errors: -", "dim")
    if any(esc.state is not None for esc in escs):
        summary = ("no errors, no warnings", "green")
    return [line(summary)][:room]


def _page(esc: Esc, width: int, height: int) -> list[Text]:
    """Return all data of one ESC, the most important first.

    The charts use ``height`` lines if that is enough.
    """
    seconds = max(0, min(HISTORY_S, width - sum(_PAGE_WIDTHS) - len(_PAGE_WIDTHS)))
    heads = ("", "", "now", "min", "max", f"last {seconds} s")
    rows: list[list[Part]] = [[(text, "dim") for text in heads]]
    shown = [quantity for quantity in QUANTITIES if esc.has(quantity.source)]
    heights = _chart_heights(len(shown), height - len(rows) - 2)
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
        rows += _chart_rows(cells, chart)
    least = (*_PAGE_WIDTHS, seconds)
    return [*_page_head(esc), *table(rows, width, 2, least)]


def _page_head(esc: Esc) -> list[Text]:
    """Return two lines with state, link, device and counters of an ESC."""
    head = line(_name_part(esc), "  ", _state_part(esc), "  link ", _link_part(esc))
    age = esc.number("data_age")
    if age is not None:
        text = f"{age:.0f} ms" if age < 1000 else duration(round(age * MS))
        head.append(f", age {text}")
    about = esc.device_text or "-"
    cells = esc.number("cell_count")
    if cells:
        about += f", {cells:.0f} cells"
    if esc.has("crc_errors", "dropped_bytes"):
        about += f"  CRC errors {number(esc.number('crc_errors'))}"
        about += f", dropped bytes {number(esc.number('dropped_bytes'))}"
    return [head, line((about, "dim"))]


def _chart_heights(count: int, height: int) -> list[int]:
    """Distribute ``height`` lines among ``count`` charts, at least one line for each.

    The first charts get one line more if lines are left.
    """
    each, more = divmod(height, max(1, count))
    heights = []
    for index in range(count):
        lines = each + 1 if index < more else each
        heights.append(max(1, min(_MAX_CHART_LINES, lines)))
    return heights


def _chart_rows(cells: Sequence[Part], chart: Sequence[Text]) -> Iterator[list[Part]]:
    """Yield the rows of a table whose last column is a chart. The first row has the cells."""
    blank = [""] * len(cells)
    for index, part in enumerate(chart):
        first = blank if index else cells
        yield [*first, part]


def _histories(escs: Sequence[Esc], width: int, height: int) -> list[Text]:
    """Return an empty line and charts of the most important quantities of all ESCs.

    Empty if they do not fit.
    """
    known = [each for each in _HISTORIES if _is_supplied(each, escs)]
    shown = known[: max(0, height - 2) // max(1, len(escs))]
    charts: list[tuple[Quantity, Esc]] = []
    for quantity in shown:
        charts += [(quantity, esc) for esc in escs if esc.has(quantity.source)]
    names = max(len(esc.name) for esc in escs)
    seconds = min(HISTORY_S, width - names - 1 - sum(_HISTORY_WIDTHS) - len(_HISTORY_WIDTHS))
    if not charts or seconds <= 0:
        return []
    lines = min(_chart_heights(len(charts), height - 2))
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
        rows += _chart_rows(cells, chart)
    least = (names, *_HISTORY_WIDTHS, seconds)
    return [line(), *table(rows, width, 3, least)]


def _is_supplied(quantity: Quantity, escs: Sequence[Esc]) -> bool:
    return any(esc.has(quantity.source) for esc in escs)


def table_of(escs: Sequence[Esc], width: int) -> list[Text]:
    """Return the table of all ESCs: the values in the DBC, with one speed before the others."""
    supplied = [quantity for quantity in QUANTITIES if _is_supplied(quantity, escs)]
    speeds = [quantity for quantity in supplied if quantity.unit == "1/min"]
    shown = speeds[:1]
    shown += [quantity for quantity in supplied if quantity.head and quantity not in speeds]
    kept = 0
    for quantity in shown:
        if quantity in speeds or QUANTITIES.index(quantity) <= _LAST_KEPT:
            kept += 1
    values: list[list[Part]] = [[(each.head or each.unit, "dim") for each in shown]]
    for esc in escs:
        values.append([_value_part(esc, quantity) for quantity in shown])
    links = [_link_part(esc) for esc in escs]
    room = width - _widest(links, _LINK_WIDTH) - 2
    for column in range(kept):
        room -= _widest([row[column] for row in values], _VALUE_WIDTH) + 1
    name_width, state_width = _name_and_state_widths(escs, room)
    head: list[Part] = [("ESC", "dim"), ("link", "dim"), ("state", "dim")]
    rows = [head + values[0]]
    for esc, link, cells in zip(escs, links, values[1:], strict=True):
        state = line(_state_part(esc))
        state.truncate(state_width, overflow="ellipsis")
        rows.append([_name_part(esc, name_width), link, state, *cells])
    least = (_NAME_WIDTH, _LINK_WIDTH, state_width, *[_VALUE_WIDTH] * len(shown))
    return table(rows, width, 3, least)


def _name_and_state_widths(escs: Sequence[Esc], room: int) -> tuple[int, int]:
    """Return the widths of the columns of names and states that fit into ``room``.

    If there is not enough room, the smallest widths are returned.
    """
    names = _widest([_name_part(esc) for esc in escs], _NAME_WIDTH)
    for state in (_STATE_WIDTH, _SHORT_STATE_WIDTH):
        if names + state <= room:
            return names, state
    if room >= _NAME_WIDTH + _SHORT_STATE_WIDTH:
        return room - _SHORT_STATE_WIDTH, _SHORT_STATE_WIDTH
    state = min(_SHORT_STATE_WIDTH, room - _NAME_WIDTH)
    return _NAME_WIDTH, max(_SHORTEST_STATE_WIDTH, state)


def _widest(parts: Sequence[Part], least: int) -> int:
    """Return the width of a column with these cells."""
    return max(least, *(line(part).cell_len for part in parts))
