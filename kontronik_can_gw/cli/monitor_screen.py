"""The screen of ``monitor``: lines of words and bars that fit a terminal of any size, with or without colour, in UTF-8 or ASCII. Pure.

If the ESCs fit side by side each has a column with all details; otherwise they are a table with two lines or one line each.
"""

import textwrap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from kontronik_can_gw.cli.status import Line, Piece, compact, duration
from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.desk.monitor.model import (
    PERCENT,
    QUANTITIES,
    QUANTITY,
    SILENCE_NS,
    EscMonitor,
    Monitor,
    Quantity,
    Scale,
    Zone,
    words,
)
from kontronik_can_gw.esc.kontronik.states import Severity
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.printable import printable

GOOD, POOR, BAD, FAINT, TITLE, MARKED = (
    "green",
    "yellow",
    "bold red",
    "dim",
    "bold",
    "bold black on yellow",
)
_ZONES = {Zone.GOOD: GOOD, Zone.WARNING: POOR, Zone.ALARM: "red"}
_MARKS = {Zone.GOOD: "", Zone.WARNING: "!", Zone.ALARM: "!!"}
_SEVERITIES = {Severity.ERROR: BAD, Severity.WARNING: POOR, Severity.STATUS: ""}
_LINKS = {"ok": GOOD, "degraded": POOR}
_TROUBLES = {
    "neverseen": "no telemetry yet: is the ESC powered, its cable plugged in?",
    "searching": "bytes come but no telemetry: right port? Does the ESC send KONTRONIK telemetry?",
    "porterror": "the gateway cannot open the port: look at its log, or kontronik-can-gw status",
}
_FILLERS = {"from", "for", "target", "during", "operation"}
_LABEL = 23
"""Width of a value's name and unit."""
_MIN_GROUP = 27
_WIDEST_BAR = 36
_MIN_HEIGHT = 16
"""Minimum number of lines for details."""
MAX_ESCS = 8
"""On one page."""


@dataclass(frozen=True)
class Glyphs:
    """Characters available on the terminal."""

    full: str = "▇"
    empty: str = "▁"
    degree: str = "°C"
    cut: str = "…"
    rule: str = "╌"


UNICODE = Glyphs()
ASCII = Glyphs(full="#", empty=".", degree="degC", cut="~", rule="-")


@dataclass
class Choice:
    """The user's choice of what to show."""

    page: int = 0
    esc: int | None = None
    """Index of the only ESC to show; None: all."""


class Where(NamedTuple):
    """State of the source of frames. ``problem``: one line while it fails; ``progress``: of a file, as ``12:03, 40 %``."""

    name: str
    is_file: bool = False
    problem: str = ""
    progress: str = ""
    hints: tuple[str, ...] = ()
    """Possible causes where no frame comes."""
    ended: bool = False
    """True at the end of a file."""
    keys: bool = True
    """True where keys are read."""


def screen(
    monitor: Monitor, where: Where, size: tuple[int, int], choice: Choice, glyphs: Glyphs = UNICODE
) -> list[Line]:
    """The whole screen, within ``size`` (columns, lines)."""
    width, height = max(20, size[0]), max(4, size[1])
    head = [_title(monitor, where, width)]
    for text, style in notices(monitor, where):
        head += [
            [Piece(line, style)] for line in textwrap.wrap(text, width, break_on_hyphens=False)
        ]
    body_height = height - len(head) - 1
    shown, pages = _shown(monitor, choice, body_height)
    group = (width - _LABEL) // max(1, len(shown))
    if len(shown) == 1 or (group >= _MIN_GROUP and body_height >= _MIN_HEIGHT):
        body = _details(shown, (width, body_height), glyphs)
    else:
        body = _table(shown, (width, body_height), glyphs)
    body += [[] for _ in range(body_height - len(body))]
    lines = [*head, *body[: max(0, body_height)], _foot(monitor, where, choice, pages, width)]
    return [fit(line, width, glyphs) for line in lines[:height]]


def plain_lines(monitor: Monitor) -> Iterator[str]:
    """A line for each ESC, for output that is no terminal."""
    mark = "REPLAY  " if monitor.is_replay else ""
    for esc in monitor.escs:
        parts = [
            f"{mark}{monitor.watched_s:6.1f} s  {esc.name}  link {_link(esc)}  state {_state(esc)}"
        ]
        for source in (
            *_speeds(esc)[:1],
            "battery_voltage",
            "battery_current",
            "power_stage_temperature",
        ):
            quantity = QUANTITY[source]
            parts.append(f"{source} {number(esc.number(source), quantity.digits)} {quantity.unit}")
        parts += [f"{active.severity.value.upper()} {active.meaning}" for active in esc.alarms]
        yield printable("  ".join(parts))


def notices(monitor: Monitor, where: Where) -> Iterator[tuple[str, str]]:
    """Notices about gateway and source, with their style."""
    if monitor.is_replay and not where.is_file:
        yield "REPLAY: the gateway plays a recording; these are not values of a live ESC.", MARKED
    if where.problem:
        yield where.problem, BAD
    elif monitor.silent_ns >= SILENCE_NS and not where.is_file:
        since = duration(monitor.silent_ns / SECOND)
        file = monitor.bus.layout.file.rpartition("/")[2]
        yield f"no frames of {file} on {where.name} for {since}", BAD
        yield from ((hint, POOR) for hint in where.hints)
    elif where.ended and not monitor.frames:
        file = monitor.bus.layout.file.rpartition("/")[2]
        yield f"{where.name} holds no frame of {file}. Give the DBC of its frames (-c, --dbc).", BAD
    elif not monitor.frames and not where.is_file:
        yield f"waiting for frames on {where.name} ...", FAINT
    count = monitor.gateway_number("esc_count")
    if count is not None and count > len(monitor.escs):
        yield (
            f"the gateway has {count:.0f} ESCs, the DBC in use describes {len(monitor.escs)}: give its configuration (-c) or DBC (--dbc).",
            POOR,
        )


def fit(line: Line, width: int, glyphs: Glyphs) -> Line:
    """The line, cut to the width."""
    room = width
    if sum(len(piece.text) for piece in line) <= room:
        return line
    cut: Line = []
    room -= len(glyphs.cut)
    for piece in line:
        cut.append(Piece(piece.text[:room], piece.style))
        room -= len(piece.text)
        if room <= 0:
            break
    return [*cut, Piece(glyphs.cut, FAINT)]


def number(value: float | None, digits: int, width: int = 99) -> str:
    """A formatted value, in groups of three digits where they fit; a dash where it is not available."""
    if value is None:
        return "-"
    text = f"{value:,.{digits}f}".replace(",", " ")
    return text if len(text) <= width else text.replace(" ", "")


def bar(value: float | None, scale: Scale, width: int, glyphs: Glyphs) -> Line:
    """A bar; the colours of its empty part show the limits."""
    text = glyphs.full * (0 if value is None else round(scale.share(value) * width))
    style = _ZONES[Zone.GOOD if value is None else scale.zone(value)]
    line = [Piece(text, style)] if text else []
    for cell in range(len(text), width):
        zone = scale.zone(scale.low + (cell + 0.5) / width * (scale.high - scale.low))
        cell_style = FAINT if zone is Zone.GOOD or value is None else f"dim {_ZONES[zone]}"
        if line and line[-1].style == cell_style:
            line[-1] = Piece(line[-1].text + glyphs.empty, cell_style)
        else:
            line.append(Piece(glyphs.empty, cell_style))
    return line


# --- head and foot


def _title(monitor: Monitor, where: Where, width: int) -> Line:
    name = where.name
    name = name if len(name) <= width // 2 - 2 else f"...{name[5 - width // 2 :]}"
    left: Line = [Piece(f" {name} ", "bold reverse"), Piece(" ")]
    if where.progress:
        left.append(Piece(f"{where.progress}  ", "bold cyan"))
    file = monitor.bus.layout.file.rpartition("/")[2]
    if not where.is_file:
        left.append(Piece(f"{file}  ", FAINT))
    state = monitor.gateway_state
    right: Line = []
    if state is not None:
        style = {"running": GOOD, "replay": MARKED}.get(normalize(state), POOR)
        right += [Piece("gateway "), Piece(words(state), style), Piece("  ")]
    if monitor.can_state is not None and normalize(monitor.can_state) not in (
        "unknown",
        "erroractive",
    ):
        right += [Piece(f"CAN {words(monitor.can_state)}", POOR), Piece("  ")]
    rate = monitor.frame_rate
    right.append(Piece(f"{'-' if rate is None else f'{rate:.0f}'} frames/s"))
    used = sum(len(piece.text) for piece in (*left, *right))
    if used > width and not where.is_file:
        used -= len(left.pop().text)
    while used > width and len(right) > 1:
        used -= len(right.pop(0).text)
    return [*left, Piece(" " * max(1, width - used)), *right]


def _foot(monitor: Monitor, where: Where, choice: Choice, pages: int, width: int) -> Line:
    count = len(monitor.escs)
    since = f"min/max of {duration(monitor.watched_s)}"
    keys = ["q quit", "r reset min/max"] if where.keys else ["Ctrl-C ends"]
    if where.is_file and where.keys:
        keys.append("space pause")
    if count > 1 and where.keys:
        keys.append("a all" if choice.esc is not None else f"1-{min(9, count)} one ESC")
    if pages > 1 and choice.esc is None:
        more = f"page {choice.page + 1} of {pages}, {count} ESCs"
        keys.insert(1, f"n p {more}" if where.keys else f"{more}; -c or --dbc")
    while len("  ".join([*keys, since])) > width and len(keys) > 1:
        keys.pop()
    text = "  ".join(keys)
    if len(text) + len(since) + 2 > width:
        return [Piece(text, FAINT)]
    return [Piece(text, FAINT), Piece(" " * (width - len(text) - len(since))), Piece(since, FAINT)]


def _shown(monitor: Monitor, choice: Choice, height: int) -> tuple[Sequence[EscMonitor], int]:
    """The ESCs of the chosen page, and the number of pages; an invalid choice is corrected."""
    escs = monitor.escs
    if choice.esc is not None:
        choice.esc = choice.esc if choice.esc < len(escs) else None
    if choice.esc is not None:
        return escs[choice.esc : choice.esc + 1], 1
    share = max(1, min(MAX_ESCS, height - 2))
    pages = max(1, -(-len(escs) // share))
    choice.page %= pages
    return escs[choice.page * share : (choice.page + 1) * share], pages


# --- words of an ESC


def _state(esc: EscMonitor) -> str:
    state = esc.state
    return "-" if state is None else words(state)


def _short_state(esc: EscMonitor, width: int) -> str:
    """The state, shortened where it does not fit."""
    state = _state(esc)
    return (
        state
        if len(state) <= width
        else " ".join(word for word in state.split() if word not in _FILLERS)
    )


def _link(esc: EscMonitor) -> str:
    link = esc.link
    if link is None:
        return "-" if esc.has("link_state") or not esc.is_fresh else "ok"
    return words(link)


def _link_style(esc: EscMonitor) -> str:
    return _LINKS.get(normalize(_link(esc)), BAD) if _link(esc) != "-" else FAINT


def _speeds(esc: EscMonitor) -> list[str]:
    """The speeds in the DBC, the most informative one first."""
    return [
        name for name in ("motor_speed", "electrical_speed", "output_speed") if esc.has(name)
    ] or ["motor_speed"]


def _name_style(esc: EscMonitor) -> str:
    severities = {active.severity for active in esc.alarms}
    if Severity.ERROR in severities:
        return BAD
    return "bold yellow" if Severity.WARNING in severities else TITLE


def _mark(esc: EscMonitor) -> str:
    """A mark after the name, for displays without colour."""
    return {BAD: " !!", "bold yellow": " !"}.get(_name_style(esc), "")


def _trouble(esc: EscMonitor) -> str:
    """Why an ESC has no values although the gateway sends, with the remedy; empty where it has."""
    link = normalize(esc.link or "")
    if esc.is_fresh or link in ("", "ok"):
        return ""
    age = esc.number("data_age")
    since = f" for {duration(age / 1000)}" if age is not None else ""
    return _TROUBLES.get(link, f"no telemetry{since}: is the ESC powered, its cable plugged in?")


def _alarm_lines(escs: Sequence[EscMonitor], size: tuple[int, int], named: bool) -> list[Line]:
    """Errors and warnings of the ESCs, errors first; compact where room is short; the rest is only counted."""
    width, room = size
    alarms: list[tuple[Severity, str, str]] = []
    for esc in escs:
        name = f"{esc.name} " if named else ""
        if trouble := _trouble(esc):
            alarms.append((Severity.ERROR, f"{name}LINK: ", trouble))
        elif normalize(esc.link or "") == "degraded":
            alarms.append(
                (
                    Severity.WARNING,
                    f"{name}LINK: ",
                    "degraded, frames are damaged: look at cable and ground",
                )
            )
        for active in esc.alarms:
            kind = {Severity.STATUS: "note"}.get(active.severity, active.severity.value.upper())
            alarms.append((active.severity, f"{name}{kind}: ", active.meaning))
    alarms.sort(key=lambda each: list(Severity).index(each[0]))
    lines = _wrapped(alarms, width)
    if len(lines) > room:
        joined: dict[tuple[Severity, str], list[str]] = {}
        for severity, head, meaning in alarms:
            joined.setdefault((severity, head), []).append(meaning)
        lines = _wrapped(
            [(severity, head, "; ".join(texts)) for (severity, head), texts in joined.items()],
            width,
        )
    if len(lines) > room > 0:
        rest = len(lines) - room + 1
        lines = [
            *lines[: room - 1],
            [Piece(f"... and {rest} lines more of errors and warnings", BAD)],
        ]
    return lines[: max(0, room)]


def _wrapped(alarms: Sequence[tuple[Severity, str, str]], width: int) -> list[Line]:
    return [
        [Piece(part, _SEVERITIES[severity])]
        for severity, head, text in alarms
        for part in textwrap.wrap(head + text, width, subsequent_indent="  ")
    ]


def _measure(esc: EscMonitor, quantity: Quantity, width: int) -> tuple[str, str]:
    """A value and its style; beyond its limits it is marked, for displays without colour."""
    value = esc.number(quantity.source)
    text = number(value, quantity.digits, width)
    if value is None:
        return text, FAINT
    zone = Zone.GOOD if quantity.scale is None else quantity.scale.zone(value)
    style = TITLE if zone is Zone.GOOD else f"bold {_ZONES[zone]}"
    return _MARKS[zone] + text, style


# --- details


class _Row(NamedTuple):
    """A line of the details: name, unit, cell for an ESC, rank for leaving it out (greatest first)."""

    label: str
    unit: str
    cell: Callable[[EscMonitor, int], Line]
    rank: int


def _details(escs: Sequence[EscMonitor], size: tuple[int, int], glyphs: Glyphs) -> list[Line]:
    width, height = size
    group = (width - _LABEL) // max(1, len(escs))
    rows = _rows(escs, glyphs)
    alarms = _alarm_lines(escs, (width, 99), len(escs) > 1)
    kept = max(1, min(4, len(alarms)))
    while len(rows) > max(1, height - kept - 1):  # one line separates values and alarms
        rows.remove(max(rows, key=lambda row: row.rank))
    lines: list[Line] = []
    for row in rows:
        unit = glyphs.degree if row.unit == "degC" else row.unit
        line: Line = [Piece(row.label.ljust(_LABEL - 6), FAINT), Piece(unit.ljust(6), FAINT)]
        for esc in escs:
            line += _padded(fit(row.cell(esc, group - 1), group - 1, glyphs), group)
        lines.append(line)
    lines.append([Piece(glyphs.rule * width, FAINT)])
    room = height - len(lines)
    if alarms:
        return [*lines, *_alarm_lines(escs, (width, room), len(escs) > 1)]
    known = any(esc.state is not None for esc in escs)
    return [*lines, [Piece("no errors, no warnings", GOOD) if known else Piece("errors: -", FAINT)]]


def _rows(escs: Sequence[EscMonitor], glyphs: Glyphs) -> list[_Row]:
    def has(*names: str) -> bool:
        return any(esc.has(name) for esc in escs for name in names)

    def title(esc: EscMonitor, width: int) -> Line:
        state = _short_state(esc, width - len(esc.name) - 5)
        style = FAINT if state == "-" else "bold cyan"
        if _trouble(esc):
            state, style = "no telemetry", BAD
        return [
            Piece(f"{esc.name}{_mark(esc)}  ", _name_style(esc)),
            Piece(state, style),
        ]

    def device(esc: EscMonitor, width: int) -> Line:
        cells = esc.number("cell_count")
        what = esc.device or "-"
        text = what + (f", {cells:.0f} cells" if cells else "")
        return [Piece(text if len(text) <= width else text.replace("firmware ", ""), FAINT)]

    def heads(_esc: EscMonitor, width: int) -> Line:
        now, bars, ends = _widths(width)
        extremes = f" {'min':>{ends}} {'max':>{ends}}" if ends else ""
        return [Piece(f"{'now':>{now}}{extremes} {' ' * bars}", FAINT)]

    def charge(esc: EscMonitor, _width: int) -> Line:
        parts = [(esc.number("consumed_charge"), 0, "mAh"), (esc.number("energy_used"), 1, "Wh")]
        return [
            Piece(
                "  ".join(f"{number(value, digits)} {unit}" for value, digits, unit in parts), TITLE
            )
        ]

    def link(esc: EscMonitor, _width: int) -> Line:
        rate, age = esc.number("frame_rate"), esc.number("data_age")
        line = [Piece(_link(esc), _link_style(esc))]
        if rate is not None:
            line.append(Piece(f", {rate:.0f} Hz"))
        return [*line, Piece(f", age {age_text(age)}")] if age is not None else line

    def line_errors(esc: EscMonitor, width: int) -> Line:
        crc, dropped = compact(esc.number("crc_errors")), compact(esc.number("dropped_bytes"))
        text = f"CRC errors {crc}, dropped bytes {dropped}"
        return [Piece(text if len(text) <= width else f"CRC {crc}, dropped {dropped} B")]

    rows = [_Row("", "", title, -2)]
    if has("device", "device_raw"):
        rows.append(_Row("", "", device, 9))
    rows.append(_Row("", "", heads, -1))
    for quantity in QUANTITIES:
        if has(quantity.source) or any(esc.number(quantity.source) is not None for esc in escs):
            rows.append(
                _Row(quantity.label, quantity.unit, _cell_of(quantity, glyphs), quantity.rank)
            )
    if has("consumed_charge", "energy_used"):
        rows.append(_Row("charge, energy", "", charge, 2))
    rows.append(_Row("link", "", link, 1))
    if has("crc_errors", "dropped_bytes"):
        rows.append(_Row("on the line", "", line_errors, 3))
    return rows


def _cell_of(quantity: Quantity, glyphs: Glyphs) -> Callable[[EscMonitor, int], Line]:
    """The cell of a measured value: present value, bar, minimum, maximum."""

    def cell(esc: EscMonitor, width: int) -> Line:
        now, bars, ends = _widths(width)
        gap = 1 + (width >= 40)
        text, style = _measure(esc, quantity, now)
        line = [Piece(text.rjust(now), style)]
        spread = esc.spreads[quantity.source]
        for end in (spread.low, spread.high) if ends else ():
            line.append(
                Piece(
                    f" {number(end, quantity.digits, ends):>{ends}}",
                    "" if end is not None else FAINT,
                )
            )
        value = esc.number(quantity.source)
        if quantity.scale is None or bars < 4:
            return line
        if quantity.scale is PERCENT and value is not None and value < 0:
            return [*line, Piece(" brake"[: bars + 1], "cyan")]
        return [*line, Piece("  "[:gap]), *bar(value, quantity.scale, bars, glyphs)]

    return cell


def _widths(width: int) -> tuple[int, int, int]:
    """Widths of a value, its bar, and each of its extremes; 0 where it does not fit."""
    now, ends = (9, 8) if width >= 40 else (7, 6)
    if now + 2 * ends + 2 > width:
        return now, max(0, width - now - 1), 0
    return now, max(0, min(_WIDEST_BAR, width - now - 2 * ends - 3 - (width >= 40))), ends


def _padded(line: Line, width: int) -> Line:
    used = sum(len(piece.text) for piece in line)
    return [*line, Piece(" " * (width - used))] if used < width else line


def age_text(milliseconds: float) -> str:
    """The age of data, in words."""
    return f"{milliseconds:.0f} ms" if milliseconds < 10_000 else duration(milliseconds / 1000)


# --- the table of many ESCs


class _Column(NamedTuple):
    """A column of the table: two heads, width, cells of both lines, rank for leaving it out (greatest first)."""

    heads: tuple[str, str]
    width: int
    first: Callable[[EscMonitor], Line]
    second: Callable[[EscMonitor], Line]
    rank: int
    left: bool = False
    grows: bool = False
    """True where it takes the remaining width."""


def _table(escs: Sequence[EscMonitor], size: tuple[int, int], glyphs: Glyphs) -> list[Line]:
    width, height = size
    columns = _columns(escs, glyphs)
    while sum(column.width + 1 for column in columns) - 1 > width and len(columns) > 1:
        columns.remove(max(columns, key=lambda column: column.rank))
    spare = width + 1 - sum(column.width + 1 for column in columns)
    columns = [
        column._replace(width=column.width + min(spare, 8)) if column.grows else column
        for column in columns
    ]
    alarms = _alarm_lines(escs, (width, 99), True)
    foot = 2 if alarms else 1
    two = 2 + 2 * len(escs) + foot <= height
    spare = height - 2 - 2 * len(escs) - foot - 1
    lines: list[Line] = [
        _table_line([[Piece(c.heads[0], FAINT)] for c in columns], columns, glyphs)
    ]
    if two:
        lines.append(_table_line([[Piece(c.heads[1], FAINT)] for c in columns], columns, glyphs))
    for esc in escs:
        if two and spare >= len(escs):
            lines.append([Piece(glyphs.rule * width, FAINT)])
        lines.append(_table_line([column.first(esc) for column in columns], columns, glyphs))
        if two:
            lines.append(_table_line([column.second(esc) for column in columns], columns, glyphs))
    room = height - len(lines)
    if room > max(1, len(alarms)):
        lines.append([Piece(glyphs.rule * width, FAINT)])
        room -= 1
    if alarms:
        return [*lines, *_alarm_lines(escs, (width, room), True)]
    known = any(esc.state is not None for esc in escs)
    return [*lines, [Piece("no errors, no warnings", GOOD) if known else Piece("errors: -", FAINT)]]


def _table_line(cells: Sequence[Line], columns: Sequence[_Column], glyphs: Glyphs) -> Line:
    line: Line = []
    for cell, column in zip(cells, columns, strict=True):
        fitting = fit(cell, column.width, glyphs)
        space = Piece(" " * (column.width - sum(len(piece.text) for piece in fitting)))
        line += [*fitting, space, Piece(" ")] if column.left else [space, *fitting, Piece(" ")]
    return line[:-1]


def _columns(escs: Sequence[EscMonitor], glyphs: Glyphs) -> list[_Column]:
    def name(esc: EscMonitor) -> Line:
        return [Piece(esc.name + _mark(esc), _name_style(esc))]

    def link(esc: EscMonitor) -> Line:
        rate = esc.number("frame_rate")
        text = _link(esc)
        return [
            Piece(
                text if rate is None or text != "ok" else f"{text} {rate:.0f} Hz", _link_style(esc)
            )
        ]

    def state(esc: EscMonitor) -> Line:
        if _trouble(esc):
            return [Piece("no telemetry", BAD)]
        text = _short_state(esc, 16)
        return [Piece(text, FAINT if text == "-" else "cyan")]

    def throttle(esc: EscMonitor) -> Line:
        value = esc.number("throttle")
        if value is not None and value < 0:
            return [Piece(f"brake {-value:.0f} %".rjust(16), "cyan")]
        percent = number(value, 0)
        return [
            *bar(value, PERCENT, 10, glyphs),
            Piece(f"{percent} %".rjust(6), "" if value is not None else FAINT),
        ]

    def measured(source: str, head: str, width: int, rank: int, lowest: bool = False) -> _Column:
        quantity = QUANTITY[source]

        def now(esc: EscMonitor) -> Line:
            return [Piece(*_measure(esc, quantity, width))]

        def end(esc: EscMonitor) -> Line:
            spread = esc.spreads[source]
            value = spread.low if lowest else spread.high
            return [Piece(number(value, quantity.digits, width), FAINT if value is None else "")]

        return _Column((head, "min" if lowest else "max"), width, now, end, rank)

    def count(source: str, digits: int) -> Callable[[EscMonitor], Line]:
        def cell(esc: EscMonitor) -> Line:
            value = esc.number(source)
            return [Piece(number(value, digits, 6), FAINT if value is None else "")]

        return cell

    speeds = {
        "motor_speed": "motor/min",
        "electrical_speed": "elec./min",
        "output_speed": "outp./min",
    }
    first_speed = _speeds(escs[0])[0] if escs else "motor_speed"
    longest = max((len(esc.name) for esc in escs), default=0)
    columns = [
        _Column(("ESC", "link"), min(14, max(10, longest + 3)), name, link, -2, True),
        _Column(("state", "throttle"), 16, state, throttle, -1, True, True),
        measured(first_speed, speeds[first_speed], 9, 0),
        measured("battery_voltage", "V", 6, 0, True),
        measured("mean_cell_voltage", "V cell", 6, 4, True),
        measured("battery_current", "A", 6, 1),
        measured("motor_current", "A mot", 6, 7),
        measured("peak_current", "A peak", 6, 8),
        measured("battery_power", "W", 6, 3),
        measured("power_stage_temperature", glyphs.degree, 5, 0),
        measured("bec_temperature", "BEC " + glyphs.degree[-2:], 6, 6),
        measured("output_opening", "open %", 6, 9),
        _Column(("mAh", "Wh"), 6, count("consumed_charge", 0), count("energy_used", 1), 2),
        _Column(("age ms", "CRC"), 6, count("data_age", 0), count("crc_errors", 0), 5),
    ]
    wanted = {
        "V cell": "mean_cell_voltage", "A mot": "motor_current", "A peak": "peak_current", "W": "battery_power",
        "open %": "output_opening", "BEC " + glyphs.degree[-2:]: "bec_temperature", "mAh": "consumed_charge", "age ms": "data_age",
    }  # fmt: skip
    return [
        column
        for column in columns
        if (source := wanted.get(column.heads[0])) is None
        or any(
            esc.has(source) or (source in esc.spreads and esc.number(source) is not None)
            for esc in escs
        )
    ]
