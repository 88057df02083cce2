"""Renders a flight as one HTML page that needs no network: template files, uPlot, and data as packed JSON. The output is deterministic."""

import base64
import gzip
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from kontronik_can_gw.desk.report.flight import EscFlight, Flight, Number
from kontronik_can_gw.desk.report.quantities import PLOTS, STATE_CLASSES, class_of
from kontronik_can_gw.desk.report.summary import tables, tiles
from kontronik_can_gw.desk.report.text import clock, duration, number, wall_clock
from kontronik_can_gw.desk.report.trackers import state_name
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.esc.values import VALUES

HERE = Path(__file__).parent
APART = 4
"""Lines whose greatest values are further apart than this factor have a plot each."""


def render(
    flight: Flight,
    *,
    source: str,
    provenance: Mapping[str, str] | None = None,
    wall_ns: int | None = None,
    damage: Sequence[str] = (),
) -> str:
    """Render the page. ``source``: the input's name; ``wall_ns``: Unix time of the recording's time 0, None where not known."""
    style = _file("vendor/uPlot.min.css") + _file("page.css")
    library, script = _file("vendor/uPlot.iife.min.js"), _file("page.js")
    policy = f"default-src 'none'; script-src {_hash(library)} {_hash(script)}; "
    policy += f"style-src {_hash(style)}; base-uri 'none'; form-action 'none'"
    data = json.dumps(_data(flight, wall_ns), separators=(",", ":"), allow_nan=False)
    parts = {
        "policy": escape(policy),
        "title": escape(source),
        "style": style,
        "head": _head(flight, source, provenance or {}, wall_ns) + _damage(damage),
        "tiles": tiles(flight),
        "tables": tables(flight),
        "several": "groups several" if len(flight.escs) > 1 else "groups",
        "notes": _notes(flight),
        "data": base64.b64encode(gzip.compress(data.encode(), mtime=0)).decode(),
        "library": library,
        "script": script,
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], _file("page.html"))


def _file(name: str) -> str:
    return (HERE / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


# --- data for the script


def _data(flight: Flight, wall_ns: int | None) -> dict[str, Any]:
    """All that page.js draws; times in seconds of the recording."""

    def seconds(time_ns: int) -> float:
        return round((time_ns - flight.origin_ns) / SECOND, 6)

    states = {
        (esc.protocol.name, segment.state): esc.protocol.states
        for esc in flight.escs
        for segment in esc.segments
    }
    keys = {known: number for number, known in enumerate(sorted(states))}
    return {
        "escs": [esc.name for esc in flight.escs],
        "from": seconds(flight.start_ns),
        "to": seconds(flight.end_ns),
        "wall": None if wall_ns is None else wall_ns // 1_000_000,
        "times": [seconds(time_ns) for time_ns in flight.times],
        "classes": list(STATE_CLASSES),
        "states": [
            [state_name(number, states[of, number]), class_of(number, states[of, number])]
            for of, number in keys
        ],
        "segments": [
            [
                [seconds(s.begin_ns), seconds(s.end_ns), keys[esc.protocol.name, s.state]]
                for s in esc.segments
            ]
            for esc in flight.escs
        ],
        "plots": _plots(flight),
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
            }
            for event in flight.events
        ],
    }


def _plots(flight: Flight) -> list[dict[str, Any]]:
    """The plots that have data. Lines of one plot whose sizes differ come in plots of their own, each with its axis."""
    found = []
    for plot in PLOTS:
        tops = {
            source: max(
                abs(value) for line in lines.values() for value in line if value is not None
            )
            for source in plot.lines
            if (lines := _lines_of(flight, source))
        }
        groups = of_like_size(tops)
        for index, sources in enumerate(groups):
            labels = [plot.lines[source] for source in sources]
            named = f"{', '.join(labels)} {plot.title[0].lower()}{plot.title[1:]}"
            found.append(
                {
                    "key": f"{plot.key}-{index}" if index else plot.key,
                    "title": named if len(groups) > 1 else plot.title,
                    "unit": VALUES[sources[0]].unit,
                    "digits": plot.digits,
                    "lines": labels,
                    "series": [
                        {"esc": esc, "line": index, "values": values}
                        for index, source in enumerate(sources)
                        for esc, values in _lines_of(flight, source).items()
                    ],
                }
            )
    return found


def _lines_of(flight: Flight, source: str) -> dict[int, list[Number]]:
    """The values of a source by ESC."""
    return {esc: values for (esc, name), values in flight.lines.items() if name == source}


def of_like_size(tops: Mapping[str, float]) -> list[list[str]]:
    """Groups of lines whose greatest values are not APART."""
    groups: list[list[str]] = []
    for source, top in tops.items():
        for group in groups:
            other = tops[group[0]]
            if not top or max(top, other) <= APART * min(top, other):
                group.append(source)
                break
        else:
            groups.append([source])
    return groups


# --- head and notes


def _head(flight: Flight, source: str, provenance: Mapping[str, str], wall_ns: int | None) -> str:
    length = duration(flight.end_ns - flight.start_ns)
    facts = {"File": source, "Length": f"{length}, {number(flight.rows, 0)} rows"}
    if flight.start_ns != flight.origin_ns:
        begin, end = (clock(t - flight.origin_ns) for t in (flight.start_ns, flight.end_ns))
        facts["Part"] = f"{begin} to {end} of the recording"
    if wall_ns is not None:
        facts["Begin"] = wall_clock(wall_ns + flight.start_ns - flight.origin_ns)
    for esc in flight.escs:
        words, noted = _device(esc), provenance.get(esc.name, "")
        port = noted.rpartition(", at ")[2]
        facts[esc.name] = ", at ".join(filter(None, (words, port))) if words else noted
    if flight.replayed:
        facts["Replay"] = "These frames were replayed from a recording."
    known = {label.lower() for label in facts}
    facts |= {key: text for key, text in provenance.items() if key.lower() not in known}
    items = (
        f"<div><dt>{escape(key)}</dt><dd>{escape(text)}</dd></div>"
        for key, text in facts.items()
        if text
    )
    return f"<dl>{''.join(items)}</dl>"


def _device(esc: EscFlight) -> str:
    """The device in a few words; if it was replaced, the first devices; empty where nothing is known."""
    words = esc.devices[:8]
    if len(words) == 1 and esc.layout:
        words = [f"{words[0]}, layout {esc.layout}"]
    return ", then ".join(words)


def _damage(damage: Sequence[str]) -> str:
    if not damage:
        return ""
    lines = "".join(f"<li>{escape(line)}</li>" for line in damage)
    title = "<strong>The input is damaged; what is intact is shown.</strong>"
    return f'<div class="damage">{title}<ul>{lines}</ul></div>'


def _notes(flight: Flight) -> str:
    lines = []
    if flight.missing:
        lines.append(f"Not in the DBC, so not here: {', '.join(flight.missing)}.")
    if flight.rows_in_bucket > 1:
        lines.append(
            f"Lines are drawn from the minimum and the maximum of each {flight.rows_in_bucket} rows: no peak is lost, its time is "
            "exact to within them. All numbers in the tables are from every row."
        )
    if flight.left_out:
        lines.append(f"{flight.left_out} more events are not listed.")
    return "".join(f'<p class="note">{escape(line)}</p>' for line in lines)
