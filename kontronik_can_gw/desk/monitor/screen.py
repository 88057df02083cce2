"""The screen of the monitor: a table of all ESCs, or one ESC's page with everything, for a terminal of any size. Pure."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import inf

from rich.text import Text

from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.desk.monitor.esc_monitor import EscMonitor, words
from kontronik_can_gw.desk.monitor.lines import (
    BAD,
    FAINT,
    GOOD,
    LINKS,
    POOR,
    TITLE,
    UNICODE,
    Alarm,
    Glyphs,
    Part,
    age_text,
    alarm_lines,
    compact,
    cut,
    duration,
    ends,
    line,
    number,
    table,
    wrapped,
)
from kontronik_can_gw.desk.monitor.model import SILENCE_NS, Monitor
from kontronik_can_gw.desk.monitor.quantities import HISTORY_S, QUANTITIES, Quantity
from kontronik_can_gw.desk.sources import Source
from kontronik_can_gw.esc.decoder import Severity
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.printable import printable

_MARKED = "bold black on yellow"
_MARKS = {"": TITLE, "!": "bold yellow", "!!": BAD}
"""Styles of what is marked; the marks are for displays without colour."""
_TROUBLES = {
    "neverseen": "no telemetry yet: is the ESC powered, its cable plugged in?",
    "searching": "bytes come but no telemetry: right port? Does the ESC send {protocol} telemetry?",
    "porterror": "the gateway cannot open the port: look at its log, or kontronik-can-gw status",
}
_FILLERS = {"from", "for", "target", "during", "operation"}
_STATE_WIDTH = 16
_CURRENT = next(q for q in QUANTITIES if q.source == "battery_current")
_PAGE_WIDTHS = (16, 5, 8, 8, 8)
"""Minimum widths of a page's columns: name, unit, value, minimum, maximum."""
_MAX_ALARM_LINES = 6
"""Lines of a page kept for errors and warnings where room is short."""


@dataclass
class Choice:
    """The ESC that the user chose to see; None: all."""

    esc: int | None = None


def screen(
    monitor: Monitor,
    source: Source,
    size: tuple[int, int],
    choice: Choice,
    glyphs: Glyphs = UNICODE,
    keys: bool = True,
) -> list[Text]:
    """The whole screen, within ``size`` (columns, lines). ``keys``: they are read."""
    width, height = max(20, size[0]), max(4, size[1])
    lines = [_title(monitor, source, width)]
    for text, style in notices(monitor, source):
        lines += wrapped(text, style, width)
    room = max(0, height - len(lines) - 1)
    if choice.esc is not None or len(monitor.escs) == 1:
        body = _page(monitor.escs[choice.esc or 0], (width, room), glyphs)
    else:
        body = _all_escs(monitor.escs, (width, room), glyphs)
    body = [*body, *[line()] * room][:room]
    lines = [*lines[: height - 1], *body, _foot(monitor, source, choice, keys, width)]
    for each in lines:
        each.truncate(width, overflow="ellipsis")
    return lines


def plain_lines(monitor: Monitor) -> Iterator[str]:
    """A line for each ESC, for output that is no terminal."""
    mark = "REPLAY  " if monitor.is_replay else ""
    for esc in monitor.escs:
        parts = [
            f"{mark}{monitor.watched_s:6.1f} s  {esc.name}  link {_link(esc)}  state {_state(esc)}"
        ]
        for quantity in _columns([esc])[:4]:
            value = number(esc.number(quantity.source), quantity.digits)
            parts.append(f"{quantity.source} {value} {quantity.unit}")
        parts += [f"{active.severity.value.upper()} {active.meaning}" for active in esc.alarms]
        yield printable("  ".join(parts))


def notices(monitor: Monitor, source: Source) -> Iterator[tuple[str, str]]:
    """Notices about gateway and source, with their style."""
    file = file_of(monitor)
    if monitor.is_replay and not source.is_file:
        yield "REPLAY: the gateway plays a recording; these are not values of a live ESC.", _MARKED
    if source.problem:
        yield source.problem, BAD
    elif source.ended and not monitor.frames:
        yield (
            f"{source.name} holds no frame of {file}. Give the DBC of its frames (-c, --dbc).",
            BAD,
        )
    elif monitor.silent_ns >= SILENCE_NS and not source.is_file:
        yield (
            f"no frames of {file} on {source.name} for {duration(monitor.silent_ns / SECOND)}",
            BAD,
        )
        yield from ((hint, POOR) for hint in source.hints)
    elif not monitor.frames and not source.is_file:
        yield f"waiting for frames on {source.name} ...", FAINT
    count = monitor.gateway.number("esc_count")
    if count is not None and count > len(monitor.escs):
        yield (
            f"the gateway has {count:.0f} ESCs, the DBC in use describes {len(monitor.escs)}: give its configuration (-c) or DBC (--dbc).",
            POOR,
        )
    if source.note:
        yield source.note, "cyan"


def file_of(monitor: Monitor) -> str:
    """Name of the DBC in use."""
    return monitor.bus.layout.file.rpartition("/")[2]


def _title(monitor: Monitor, source: Source, width: int) -> Text:
    left = line((f" {source.name} ", "bold reverse"))
    if not source.is_file:
        left = line(left, "  ", (file_of(monitor), FAINT))
    right = line(" ", (f"{source.progress}  " if source.progress else "", "bold cyan"))
    if (state := monitor.gateway_state) is not None:
        style = {"running": GOOD, "replay": _MARKED}.get(normalize(state), POOR)
        right = line(right, "gateway ", (words(state), style), "  ")
    if normalize(monitor.can_state or "unknown") not in ("unknown", "erroractive"):
        right = line(right, (f"CAN {words(monitor.can_state or '')}", POOR), "  ")
    return ends(left, line(right, f"{number(monitor.frame_rate)} frames/s"), width)


def _foot(monitor: Monitor, source: Source, choice: Choice, works: bool, width: int) -> Text:
    count = len(monitor.escs)
    keys = ["q quit"] if works else ["Ctrl-C ends"]
    if works and count > 1:
        keys.append(f"1-{min(9, count)} one ESC" if choice.esc is None else "n p next ESC  a all")
    if works and source.is_file:
        keys.append("space pause")
    if works:
        keys.append("r reset min/max")
    since = f" min/max of {duration(monitor.watched_s)}"
    return ends(line(("  ".join(keys), FAINT)), line((since, FAINT)), width)


# --- words of an ESC


def _state(esc: EscMonitor) -> str:
    return "-" if esc.state is None else words(esc.state)


def _state_part(esc: EscMonitor, width: int = 99) -> Part:
    """The operating state, shortened where it does not fit."""
    state = _state(esc)
    if len(state) > width:
        state = " ".join(word for word in state.split() if word not in _FILLERS)
    if _trouble(esc):
        return "no telemetry", BAD
    return state[:width], FAINT if state == "-" else "bold cyan"


def _link(esc: EscMonitor) -> str:
    if esc.link is None:
        return "-" if esc.has("link_state") or not esc.is_fresh else "ok"
    return words(esc.link)


def _link_part(esc: EscMonitor) -> Part:
    link, rate = _link(esc), esc.number("frame_rate")
    text = link if rate is None or link != "ok" else f"ok {rate:.0f} Hz"
    return text, LINKS.get(link, BAD)


def _name_part(esc: EscMonitor) -> Part:
    """The name, marked where there are errors or warnings."""
    severities = {active.severity for active in esc.alarms}
    mark = "!!" if Severity.ERROR in severities else "!" * (Severity.WARNING in severities)
    return f"{esc.name} {mark}".rstrip(), _MARKS[mark]


def _value_part(esc: EscMonitor, quantity: Quantity) -> Part:
    """The present value; beyond its limits it is marked."""
    value = esc.number(quantity.source)
    if value is None:
        return "-", FAINT
    mark = quantity.mark(value)
    return mark + number(value, quantity.digits), _MARKS[mark]


def _end_part(value: float | None, quantity: Quantity) -> Part:
    return number(value, quantity.digits), FAINT if value is None else ""


def _trouble(esc: EscMonitor) -> str:
    """Why an ESC has no values although the gateway sends, with the remedy; empty where it has."""
    link = normalize(esc.link or "")
    if esc.is_fresh or link in ("", "ok"):
        return ""
    age = esc.number("data_age")
    since = f" for {duration(age / 1000)}" if age is not None else ""
    trouble = _TROUBLES.get(link, f"no telemetry{since}: is the ESC powered, its cable plugged in?")
    return trouble.format(protocol=esc.protocol.name.upper())


def sparkline(esc: EscMonitor, quantity: Quantity, width: int, glyphs: Glyphs) -> Text:
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
        step = round((value - low) / span * (len(glyphs.levels) - 1)) if 0 < span < inf else 0
        mark = quantity.mark(value)
        made.append(glyphs.levels[step], _MARKS[mark] if mark else "cyan")
    return made


def _alarm_lines(escs: Sequence[EscMonitor], size: tuple[int, int], named: bool) -> list[Text]:
    """Errors and warnings of the ESCs."""
    width, room = size
    found: list[Alarm] = []
    for esc in escs:
        name = f"{esc.name} " if named else ""
        if trouble := _trouble(esc):
            found.append(Alarm(Severity.ERROR, f"{name}LINK: {trouble}"))
        elif normalize(esc.link or "") == "degraded":
            text = f"{name}LINK: degraded, frames are damaged"
            found.append(Alarm(Severity.WARNING, text, "Look at cable and ground."))
        for active in esc.alarms:
            kind = {Severity.STATUS: "note"}.get(active.severity, active.severity.value.upper())
            text = f"{name}{kind}: {active.meaning}"
            found.append(Alarm(active.severity, text, active.remedy))
    if found:
        return alarm_lines(found, width, room)
    known = any(esc.state is not None for esc in escs)
    return [line(("no errors, no warnings", GOOD) if known else ("errors: -", FAINT))][:room]


# --- one ESC, all ESCs


def _page(esc: EscMonitor, size: tuple[int, int], glyphs: Glyphs) -> list[Text]:
    """Everything of one ESC. Where room is short the last values are left out."""
    width, height = size
    age, cells = esc.number("data_age"), esc.number("cell_count")
    head = line(_name_part(esc), "  ", _state_part(esc), "  link ", _link_part(esc))
    if age is not None:
        head.append(f", age {age_text(age)}")
    device = line((esc.device_text or "-", FAINT), (f", {cells:.0f} cells" if cells else "", FAINT))
    if esc.has("crc_errors", "dropped_bytes"):
        crc, dropped = compact(esc.number("crc_errors")), compact(esc.number("dropped_bytes"))
        text = f"  CRC errors {crc}, dropped bytes {dropped}"
        fits = device.cell_len + len(text) <= width
        device.append(text if fits else f"  CRC {crc}, dropped {dropped} B", FAINT)
    seconds = max(0, min(HISTORY_S, width - sum(_PAGE_WIDTHS) - len(_PAGE_WIDTHS)))
    rows: list[list[Part]] = [
        [(text, FAINT) for text in ("", "", "now", "min", "max", f"last {seconds} s")]
    ]
    for quantity in QUANTITIES:
        if not esc.has(quantity.source) and esc.number(quantity.source) is None:
            continue
        track = esc.tracks[quantity.source]
        unit = glyphs.degree if quantity.unit == "degC" else quantity.unit
        rows.append(
            [
                (quantity.label, FAINT),
                (unit, FAINT),
                _value_part(esc, quantity),
                _end_part(track.low, quantity),
                _end_part(track.high, quantity),
                sparkline(esc, quantity, seconds, glyphs),
            ]
        )
    lines = [head, device, *table(rows, width, 2, (*_PAGE_WIDTHS, seconds))]
    wanted = min(_MAX_ALARM_LINES, len(_alarm_lines([esc], (width, 99), False)))
    lines = [*lines[: max(2, height - wanted - 1)], line((glyphs.rule * width, FAINT))]
    return lines + _alarm_lines([esc], (width, height - len(lines)), False)


def _columns(escs: Sequence[EscMonitor]) -> list[Quantity]:
    """The values in the table: those of the DBC, with one speed, in front."""
    found = [q for q in QUANTITIES if q.head and any(esc.has(q.source) for esc in escs)]
    speeds = [q for q in found if q.unit == "1/min"]
    return [*speeds[:1], *[q for q in found if q not in speeds]]


def _all_escs(escs: Sequence[EscMonitor], size: tuple[int, int], glyphs: Glyphs) -> list[Text]:
    """The table of all ESCs: values, and below them extremes where there is room."""
    width, height = size
    shown = _columns(escs)
    is_tall = 2 * len(escs) + 4 <= height
    heads = [q.head.replace("degC", glyphs.degree) for q in shown]
    rows: list[list[Part]] = [[(head, FAINT) for head in ("ESC", "state", *heads)]]
    if is_tall:
        extremes = ["min" if q.falls else "max" for q in shown]
        rows.append([(head, FAINT) for head in ("link", f"A, last {_STATE_WIDTH} s", *extremes)])
    for esc in escs:
        values = [_value_part(esc, quantity) for quantity in shown]
        rows.append([_name_part(esc), _state_part(esc, _STATE_WIDTH), *values])
        if is_tall:
            tracks = [esc.tracks[q.source] for q in shown]
            extreme = [
                _end_part(track.low if q.falls else track.high, q)
                for q, track in zip(shown, tracks, strict=True)
            ]
            history = sparkline(esc, _CURRENT, _STATE_WIDTH, glyphs)
            rows.append([_link_part(esc), history, *extreme])
    lines = table(rows, width, 2, (9, _STATE_WIDTH, 7, *[5] * len(shown)))
    lines = cut(lines, max(2, height - 2), "lines more: enlarge the terminal, or n")
    lines.append(line((glyphs.rule * width, FAINT)))
    return lines + _alarm_lines(escs, (width, height - len(lines)), True)
