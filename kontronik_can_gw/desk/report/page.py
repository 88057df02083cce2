"""Renders a flight as one HTML page that needs no network: template files, uPlot, and data in base64. The output is deterministic."""

import base64
import hashlib
import json
import re
import sys
from array import array
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path

from kontronik_can_gw.desk.report.analysis import state_name
from kontronik_can_gw.desk.report.decimate import Number
from kontronik_can_gw.desk.report.flight import Extreme, Facts, Flight, Summary
from kontronik_can_gw.desk.report.quantities import PLOTS, STATE_CLASSES, STYLES, class_of
from kontronik_can_gw.esc.telemetry import SECOND

HERE = Path(__file__).parent
MAX_DEVICES = 8
"""Limit for the devices of an ESC named in the head."""
Json = dict[str, "Json"] | list["Json"] | str | int | float | bool | None


def render(
    flight: Flight,
    *,
    title: str,
    source: str,
    provenance: Mapping[str, str] | None = None,
    wall_ns: int | None = None,
    damage: Sequence[str] = (),
) -> str:
    """Render the page. ``source``: the input's name; ``wall_ns``: Unix time of the recording's time 0, None where not known."""
    styles = _file("vendor/uPlot.min.css") + _file("page.css")
    library, script = _file("vendor/uPlot.iife.min.js"), _file("page.js")
    policy = (
        f"default-src 'none'; script-src {_hash(library)} {_hash(script)}; style-src {_hash(styles)}; "
        "base-uri 'none'; form-action 'none'"
    )
    data = json.dumps(
        _data(flight, wall_ns), ensure_ascii=True, separators=(",", ":"), allow_nan=False
    )
    parts = {
        "policy": escape(policy),
        "title": escape(title),
        "style": styles,
        "head": _head(flight, source, provenance or {}, wall_ns, damage),
        "tiles": _tiles(flight),
        "summary": _summary(flight),
        "several": "groups several" if len(flight.names) > 1 else "groups",
        "notes": _notes(flight),
        "data": data.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"),
        "library": library,
        "script": script,
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], _file("page.html"))


def _file(name: str) -> str:
    return (HERE / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


# --- data for the script


def _data(flight: Flight, wall_ns: int | None) -> Json:
    def seconds(time_ns: int) -> float:
        return round((time_ns - flight.origin_ns) / SECOND, 6)

    states = sorted({segment.state for segments in flight.segments for segment in segments})
    return {
        "escs": list(flight.names),
        "from": seconds(flight.start_ns),
        "to": seconds(flight.end_ns),
        "wall": None if wall_ns is None else wall_ns // 1_000_000,
        "times": _blob(array("d", [seconds(time_ns) for time_ns in flight.times])),
        "styles": [{"light": s.light, "dark": s.dark, "dash": list(s.dash)} for s in STYLES],
        "classes": [{"label": c.label, "light": c.light, "dark": c.dark} for c in STATE_CLASSES],
        "states": {str(state): [state_name(state), class_of(state)] for state in states},
        "segments": [
            [[seconds(s.begin_ns), seconds(s.end_ns), s.state] for s in segments]
            for segments in flight.segments
        ],
        "plots": [
            {
                "key": PLOTS[plot.plot].key,
                "title": PLOTS[plot.plot].title,
                "unit": PLOTS[plot.plot].unit,
                "digits": PLOTS[plot.plot].digits,
                "lines": list(plot.labels),
                "series": [
                    {"esc": line.esc, "line": line.quantity, **encode(line.values)}
                    for line in plot.lines
                ],
            }
            for plot in flight.plots
        ],
        "events": [
            {
                "kind": event.kind,
                "esc": event.esc,
                "from": seconds(event.begin_ns),
                "to": None if event.end_ns is None else seconds(event.end_ns),
                "text": event.text,
                "severity": event.severity,
                "remedy": event.remedy,
                "note": event.note,
                "momentary": event.momentary,
            }
            for event in flight.events
        ],
    }


def encode(values: Sequence[Number]) -> dict[str, Json]:
    """Values as integer steps if they are decimals, else as doubles. None: the lowest number of the type, or NaN."""
    known = [value for value in values if value is not None]
    for scale in (1, 10, 100, 1000):
        steps = [round(value * scale) for value in known]
        if all(step / scale == value for step, value in zip(steps, known, strict=True)):
            break
    else:
        nan = float("nan")
        return {
            "type": "f64",
            "data": _blob(array("d", [nan if value is None else value for value in values])),
        }
    reach = max(map(abs, steps), default=0)
    if reach >= 1 << 31:
        nan = float("nan")
        return {
            "type": "f64",
            "data": _blob(array("d", [nan if value is None else value for value in values])),
        }
    code, none = ("h", -(1 << 15)) if reach < 1 << 15 else ("i", -(1 << 31))
    packed = array(code, [none if value is None else round(value * scale) for value in values])
    return {"type": "i16" if code == "h" else "i32", "scale": scale, "data": _blob(packed)}


def _blob(numbers: "array[int] | array[float]") -> str:
    """Little-endian, in base64."""
    if sys.byteorder == "big":
        numbers = numbers[:]
        numbers.byteswap()
    return base64.b64encode(numbers.tobytes()).decode("ascii")


# --- text


def clock(time_ns: int, digits: int = 1) -> str:
    """A time of the recording as 1:02.5 or 1:00:02.5."""
    steps = round(time_ns * 10**digits / SECOND)
    sign, steps = ("−" if steps < 0 else ""), abs(steps)
    whole, part = divmod(steps, 10**digits)
    minutes, seconds = divmod(whole, 60)
    hours, minutes = divmod(minutes, 60)
    text = f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"
    return sign + text + (f".{part:0{digits}}" if digits else "")


def duration(length_ns: int) -> str:
    """A length as 12.5 s, 4 min 05 s or 1 h 02 min 05 s."""
    if length_ns < 60 * SECOND:
        return f"{length_ns / SECOND:.1f} s"
    minutes, seconds = divmod(round(length_ns / SECOND), 60)
    hours, minutes = divmod(minutes, 60)
    return (
        f"{hours} h {minutes:02} min {seconds:02} s" if hours else f"{minutes} min {seconds:02} s"
    )


def number(value: float, digits: int) -> str:
    """Format with a thin space between thousands and a minus sign."""
    return f"{value:,.{digits}f}".replace(",", "\u202f").replace("-", "−")


def wall_clock(wall_ns: int) -> str:
    """Unix time as UTC."""
    from datetime import UTC, datetime

    try:
        return datetime.fromtimestamp(wall_ns // SECOND, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    except (OverflowError, OSError, ValueError):
        return f"{wall_ns // SECOND} s of Unix time"


def _head(
    flight: Flight,
    source: str,
    provenance: Mapping[str, str],
    wall_ns: int | None,
    damage: Sequence[str],
) -> str:
    length = flight.end_ns - flight.start_ns
    facts = [("File", source), ("Length", f"{duration(length)}, {number(flight.rows, 0)} rows")]
    if flight.start_ns != flight.origin_ns:
        begin, end = (clock(t - flight.origin_ns) for t in (flight.start_ns, flight.end_ns))
        facts.append(("Part", f"{begin} to {end} of the recording"))
    if wall_ns is not None:
        facts.append(("Begin", wall_clock(wall_ns + flight.start_ns - flight.origin_ns)))
    for name, fact in zip(flight.names, flight.facts, strict=True):
        words, noted = fact_words(fact, flight.origin_ns), provenance.get(name, "")
        if words or noted:
            facts.append(
                (
                    name,
                    ", at ".join(filter(None, (words, noted.rpartition(", at ")[2])))
                    if words
                    else noted,
                )
            )
    if flight.replayed:
        facts.append(("Replay", "These frames were replayed from a recording."))
    known = {label.lower() for label, _ in facts}
    facts += [(key, text) for key, text in provenance.items() if key.lower() not in known]
    html = "".join(
        f"<div><dt>{escape(key)}</dt><dd>{escape(text)}</dd></div>" for key, text in facts if text
    )
    html = f"<dl>{html}</dl>"
    if damage:
        lines = "".join(f"<li>{escape(line)}</li>" for line in damage)
        html += f'<div class="damage"><strong>The input is damaged; what is intact is shown.</strong><ul>{lines}</ul></div>'
    return html


def fact_words(facts: Facts, origin_ns: int) -> str:
    """The device in a few words; if it was replaced, every device with its time; empty where nothing is known."""
    words = []
    if len(facts.devices) > 1:
        shown = facts.devices[:MAX_DEVICES]
        first, *others = (text for _, text in shown)
        since = [clock(time_ns - origin_ns) for time_ns, _ in shown[1:]]
        words.append(
            "; ".join(
                [first, *(f"from {at}: {text}" for at, text in zip(since, others, strict=True))]
            )
        )
        if len(facts.devices) > len(shown):
            words[-1] += f"; and {len(facts.devices) - len(shown)} more changes"
        return words[-1]
    if facts.device:
        words.append(facts.device + (f" {facts.variant}" if facts.variant is not None else ""))
    if facts.firmware:
        words.append(f"firmware {facts.firmware}")
    if facts.layout:
        words.append(f"layout {facts.layout}")
    return ", ".join(words)


def _at(time_ns: int, flight: Flight) -> str:
    since = time_ns - flight.origin_ns
    return (
        f'<button type="button" class="at" data-at="{since / SECOND:.6f}">{clock(since)}</button>'
    )


def _tiles(flight: Flight) -> str:
    """The most important numbers; with several ESCs the extreme and the name of its ESC."""
    several = len(flight.names) > 1
    tiles: list[tuple[str, str, str]] = [
        ("Duration", duration(flight.end_ns - flight.start_ns), "")
    ]
    turning = [s.turning_ns for s in flight.summaries if s.turning_ns is not None]
    if turning:
        tiles.append(
            ("Motor turning", duration(max(turning)), "the longest of all" if several else "")
        )
    energies = [s.energy for s in flight.summaries if s.energy is not None]
    if energies:
        charge = [s.charge for s in flight.summaries if s.charge is not None]
        aside = f"{number(sum(charge), 0)} mAh" if charge else ""
        tiles.append(
            ("Energy" + (", all ESCs" if several else ""), f"{number(sum(energies), 1)} Wh", aside)
        )

    def outermost(label: str, key: str, unit: str, digits: int) -> None:
        found = [
            (s.extremes[key], name)
            for s, name in zip(flight.summaries, flight.names, strict=True)
            if key in s.extremes
        ]
        if not found:
            return
        pick = max if key.startswith("max") else min
        extreme, name = pick(found, key=lambda item: item[0].value)
        aside = _at(extreme.time_ns, flight) + (f" {escape(name)}" if several else "")
        tiles.append((label, f"{number(extreme.value, digits)} {unit}", aside))

    outermost("Peak power", "max battery_power", "W", 0)
    outermost("Peak battery current", "max battery_current", "A", 1)
    outermost("Lowest battery voltage", "min battery_voltage", "V", 2)
    outermost("Hottest power stage", "max power_stage_temperature", "°C", 0)
    errors = sum(event.kind == "error" and event.severity == "error" for event in flight.events)
    warnings = sum(event.kind == "error" and event.severity == "warning" for event in flight.events)
    more = "+" if flight.left_out.get("error") else ""
    tiles.append(("Errors", f"{errors}{more}", f"{warnings}{more} warnings"))
    html = []
    for label, value, aside in tiles:
        kind = ' class="bad"' if label == "Errors" and errors else ""
        html.append(
            f"<div{kind}><span>{escape(label)}</span><b>{escape(value)}</b><small>{aside or '&nbsp;'}</small></div>"
        )
    return "".join(html)


Cell = Callable[[Summary], str | None]


def _summary(flight: Flight) -> str:
    """A table: a row for each number, a column for each ESC; unknown numbers are left out."""

    def extreme(key: str, unit: str, digits: int) -> Cell:
        return lambda s: _extreme(s.extremes.get(key), unit, digits, flight)

    def value(get: Callable[[Summary], float | None], unit: str, digits: int) -> Cell:
        def cell(s: Summary) -> str | None:
            found = get(s)
            return None if found is None else f"<b>{number(found, digits)}</b> {unit}".rstrip()

        return cell

    whole = max(1, flight.end_ns - flight.start_ns)
    groups: list[tuple[str, list[tuple[str, Cell]]]] = [
        (
            "Use",
            [
                (
                    "Motor turning",
                    lambda s: None if s.turning_ns is None else f"<b>{duration(s.turning_ns)}</b>",
                ),
                ("Energy used", _energy),
                ("Energy returned by braking", value(lambda s: s.energy_returned, "Wh", 2)),
                ("Charge used", _charge),
                ("Peak power", extreme("max battery_power", "W", 0)),
                ("Mean power while turning", value(lambda s: s.power_turning, "W", 0)),
            ],
        ),
        (
            "Maxima",
            [
                ("Battery current", extreme("max battery_current", "A", 1)),
                ("Motor current", extreme("max motor_current", "A", 1)),
                ("Peak current (held by the ESC)", extreme("max peak_current", "A", 1)),
                ("Output speed", extreme("max output_speed", "1/min", 0)),
                ("Motor speed", extreme("max motor_speed", "1/min", 0)),
                ("Electrical speed", extreme("max electrical_speed", "1/min", 0)),
                ("Power stage temperature", extreme("max power_stage_temperature", "°C", 0)),
                ("BEC temperature", extreme("max bec_temperature", "°C", 0)),
                ("BEC current", extreme("max bec_current", "A", 3)),
                ("Output stage opening", extreme("max output_opening", "%", 0)),
            ],
        ),
        (
            "Voltages",
            [
                ("Lowest battery voltage", extreme("min battery_voltage", "V", 2)),
                ("Lowest mean cell voltage", extreme("min mean_cell_voltage", "V", 3)),
                ("Lowest BEC voltage", extreme("min bec_voltage", "V", 3)),
                ("At rest before the first load", lambda s: _per_cell(s.rest_voltage, s)),
                ("Lowest under load", lambda s: _under_load(s, flight)),
                ("Sag", _sag),
                ("Internal resistance (estimate)", _resistance),
            ],
        ),
        (
            "Quality of the data",
            [
                (
                    "With telemetry",
                    lambda s: (
                        f"<b>{number(100 * s.telemetry_ns / whole, 2)}</b> % ({duration(s.telemetry_ns)})"
                    ),
                ),
                (
                    "Gaps, the longest",
                    lambda s: (
                        f"<b>{s.gaps}</b>" + (f" ({duration(s.longest_gap_ns)})" if s.gaps else "")
                    ),
                ),
                ("Losses of the link", value(lambda s: s.losses, "", 0)),
                ("CRC errors", value(lambda s: s.crc_errors, "", 0)),
                ("Bytes dropped", value(lambda s: s.dropped_bytes, "", 0)),
            ],
        ),
    ]
    several = len(flight.names) > 1
    names = "".join(f'<th scope="col">{escape(name)}</th>' for name in flight.names)
    html = []
    for title, lines in groups:
        rows = []
        for label, cell in lines:
            cells = [cell(summary) for summary in flight.summaries]
            if any(text is not None for text in cells):
                tds = "".join(
                    f'<td data-esc="{escape(name)}"><span>{text or "–"}</span></td>'
                    if several
                    else f"<td>{text or '–'}</td>"
                    for name, text in zip(flight.names, cells, strict=True)
                )
                rows.append(f'<tr><th scope="row">{escape(label)}</th>{tds}</tr>')
        if rows:
            head = f"<thead><tr><td></td>{names}</tr></thead>" if several else ""
            caption = f"<caption>{escape(title)}</caption>"
            html.append(
                f'<table class="numbers">{caption}{head}<tbody>{"".join(rows)}</tbody></table>'
            )
    return "".join(html)


def _extreme(found: Extreme | None, unit: str, digits: int, flight: Flight) -> str | None:
    if found is None:
        return None
    return f"<b>{number(found.value, digits)}</b> {unit} {_at(found.time_ns, flight)}"


def _energy(summary: Summary) -> str | None:
    drawn = None if summary.energy_drawn is None else number(summary.energy_drawn, 2)
    if summary.energy_counter is None:
        return None if drawn is None else f"<b>{drawn}</b> Wh (power integrated)"
    beside = f"; power integrated: {drawn} Wh" if drawn is not None else ""
    return f"<b>{number(summary.energy_counter, 1)}</b> Wh (the gateway's counter{beside})"


def _charge(summary: Summary) -> str | None:
    if summary.charge is None:
        return None
    resets = summary.charge_resets
    again = f" (the counter began again {resets} time{'s' if resets > 1 else ''})" if resets else ""
    return f"<b>{number(summary.charge, 0)}</b> mAh{again}"


def _per_cell(voltage: float | None, summary: Summary) -> str | None:
    if voltage is None:
        return None
    if summary.cells:
        return f"<b>{number(voltage / summary.cells, 3)}</b> V a cell ({number(voltage, 2)} V)"
    return f"<b>{number(voltage, 2)}</b> V"


def _under_load(summary: Summary, flight: Flight) -> str | None:
    lowest = summary.load_voltage
    return (
        None
        if lowest is None
        else f"{_per_cell(lowest.value, summary)} {_at(lowest.time_ns, flight)}"
    )


def _sag(summary: Summary) -> str | None:
    if summary.rest_voltage is None or summary.load_voltage is None:
        return None
    return _per_cell(summary.rest_voltage - summary.load_voltage.value, summary)


def _resistance(summary: Summary) -> str | None:
    found = summary.resistance
    if found is None:
        return None
    text = f"<b>{number(found.value * 1000, 1)}</b> ± {number(found.spread * 1000, 1)} mΩ"
    if summary.cells:
        text += f" ({number(found.value * 1000 / summary.cells, 2)} mΩ a cell)"
    return f"{text}, {found.stretches} stretches"


_KINDS = {
    "error": "errors",
    "state": "changes of state",
    "link": "changes of the link",
    "device": "changes of device",
}


def _notes(flight: Flight) -> str:
    lines = []
    if flight.missing:
        lines.append(f"Not in the DBC, so not here: {', '.join(flight.missing)}.")
    if flight.rows_in_bucket > 1:
        lines.append(
            f"Lines are drawn from the minimum and the maximum of each {flight.rows_in_bucket} rows: no peak is lost, its time is "
            "exact to within them. All numbers in the summary are from every row."
        )
    for kind, count in flight.left_out.items():
        lines.append(f"{count} more {_KINDS[kind]} are not listed.")
    return "".join(f'<p class="note">{escape(line)}</p>' for line in lines)
