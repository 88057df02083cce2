"""The screen of the monitor: a table of all ESCs, or one ESC's page with everything, for a terminal of any size. Pure."""

from collections.abc import Iterator, Sequence
from math import inf

from rich.text import Text

from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.desk.member import Alarm, Flag, alarms_of
from kontronik_can_gw.desk.monitor.lines import (
    STATES,
    Part,
    alarm_lines,
    cut,
    line,
    number,
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
from kontronik_can_gw.esc.telemetry import MS
from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.runtime.fault_log import duration

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
_ALARM_LINES, _FEW_ALARM_LINES = 6, 2
"""Kept for errors and warnings on a page, and below the table, where room is short."""


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
        body = _page(escs[0], width)[: max(2, room - 1 - kept)]
    else:
        kept = len(alarms(escs, width, _FEW_ALARM_LINES))
        body = cut(table_of(escs, width), max(2, room - 1 - kept))
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


def _name_part(esc: Esc) -> Part:
    """The name, marked where there are errors or warnings."""
    severities = {flag.severity for flag in alarms_of(esc.active)}
    mark = "!!" if Severity.ERROR in severities else "!" * (Severity.WARNING in severities)
    return f"{esc.name} {mark}".rstrip(), _MARKS[mark]


def _value_part(esc: Esc, quantity: Quantity) -> Part:
    """The present value; beyond its limits it is marked."""
    value = esc.number(quantity.source)
    mark = "" if value is None else quantity.mark(value)
    return mark + number(value, quantity.digits), "dim" if value is None else _MARKS[mark]


def sparkline(esc: Esc, quantity: Quantity, width: int) -> Text:
    """The last ``width`` seconds of a value between its extremes, the newest at the right."""
    track = esc.tracks[quantity.source]
    values = list(track.history)[-width:] if width else []
    scale = [value for value in (*values, track.low, track.high) if value is not None]
    low, span = min(scale, default=0.0), max(scale, default=0.0) - min(scale, default=0.0)
    made = line()
    for value in values:
        if value is None:  # not available
            made.append(" ")
            continue
        step = round((value - low) / span * (len(_LEVELS) - 1)) if 0 < span < inf else 0
        made.append(_LEVELS[step], _MARKS.get(quantity.mark(value) or "-", "cyan"))
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


def _page(esc: Esc, width: int) -> list[Text]:
    """Everything of one ESC, the most important first."""
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
    for quantity in QUANTITIES:
        if esc.has(quantity.source):
            track = esc.tracks[quantity.source]
            extremes = (number(each, quantity.digits) for each in (track.low, track.high))
            names = (quantity.label, "dim"), (quantity.unit, "dim")
            history = sparkline(esc, quantity, seconds)
            rows.append([*names, _value_part(esc, quantity), *extremes, history])
    return [head, line((about, "dim")), *table(rows, width, 2, (*_PAGE_WIDTHS, seconds))]


def table_of(escs: Sequence[Esc], width: int) -> list[Text]:
    """The table of all ESCs: the values of the DBC, with one speed, in front."""
    found = [q for q in QUANTITIES if any(esc.has(q.source) for esc in escs)]
    speeds = [q for q in found if q.unit == "1/min"]
    shown = [*speeds[:1], *(q for q in found if q.head and q not in speeds)]
    heads = ("ESC", "link", "state", *(q.head or q.unit for q in shown))
    rows: list[list[Part]] = [[(head, "dim") for head in heads]]
    for esc in escs:
        values = [_value_part(esc, quantity) for quantity in shown]
        state = line(_state_part(esc))
        state.truncate(12, overflow="ellipsis")
        rows.append([_name_part(esc), _link_part(esc), state, *values])
    return table(rows, width, 3, (7, 9, 12, *[5] * len(shown)))
