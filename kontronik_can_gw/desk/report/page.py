"""Renders a flight as one HTML page that needs no network.

The page consists of template files, the common look, and the data as packed JSON. The output is
deterministic.
"""

import base64
import gzip
import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import cache
from html import escape
from pathlib import Path
from typing import Any

from kontronik_can_gw.desk import look
from kontronik_can_gw.desk.quantities import PHASES, PLOTS, Plot
from kontronik_can_gw.desk.report.esc import Number
from kontronik_can_gw.desk.report.flight import Flight
from kontronik_can_gw.desk.report.summary import tables, tiles
from kontronik_can_gw.desk.words import clock, duration, number, wall_clock
from kontronik_can_gw.esc.values import VALUES
from kontronik_can_gw.times import MS, SECOND

HERE = Path(__file__).parent
_MAX_CUTS = 20
"""Number of cuts that are listed."""
APART = 4
"""Lines have different plots if the ratio of their greatest values exceeds this factor."""


def render(
    flight: Flight,
    *,
    source: str,
    provenance: Mapping[str, str] | None = None,
    wall_ns: int | None = None,
    damage: Sequence[str] = (),
) -> str:
    """Render the page.

    ``source`` is the input's name. ``wall_ns`` is the Unix time of the recording's time 0, or None
    if it is unknown.
    """
    style, library, script = _assets()
    content = _data(flight, wall_ns)
    data = json.dumps(content, separators=(",", ":"), allow_nan=False)
    packed = gzip.compress(data.encode(), mtime=0)
    parts = {
        "policy": escape(policy()),
        "title": escape(source),
        "style": style,
        "head": _head(flight, source, provenance or {}, wall_ns),
        "problems": _damage(damage) + _cuts(flight),
        "tiles": tiles(flight),
        "tables": tables(flight),
        "several": "groups several" if len(flight.escs) > 1 else "groups",
        "notes": _notes(flight),
        "data": base64.b64encode(packed).decode(),
        "library": library,
        "script": script,
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], _file("page.html"))


@cache
def policy() -> str:
    """Return the Content-Security-Policy of the page, which is the same for every flight."""
    style, library, script = _assets()
    return (
        f"default-src 'none'; script-src {_hash(library)} {_hash(script)}; "
        f"style-src {_hash(style)}; base-uri 'none'; form-action 'none'"
    )


def _assets() -> tuple[str, str, str]:
    """Return the page's style, uPlot, and the page's own script."""
    style = "".join(look.text(name) for name in look.STYLES) + _file("page.css")
    script = look.text("plots.js") + _file("page.js")
    return style, look.text("vendor/uPlot.iife.min.js"), script


def _file(name: str) -> str:
    return (HERE / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


# --- data for the script


def _data(flight: Flight, wall_ns: int | None) -> dict[str, Any]:
    """Return all data that page.js draws. Times are in seconds of the recording."""

    def seconds(time_ns: int | None) -> float | None:
        if time_ns is None:
            return None
        return round((time_ns - flight.origin_ns) / SECOND, 6)

    return {
        "escs": [esc.name for esc in flight.escs],
        "from": seconds(flight.start_ns),
        "to": seconds(flight.end_ns),
        "wall": None if wall_ns is None else wall_ns // MS,
        "cuts": [[seconds(cut.begin_ns), cut.length_ns / SECOND] for cut in flight.cuts],
        "times": [seconds(time_ns) for time_ns in flight.points.times],
        "phases": PHASES,
        "plots": list(_plots(flight)),
        "events": [
            asdict(event) | {"from": seconds(event.begin_ns), "to": seconds(event.end_ns)}
            for event in flight.events
        ],
    }


Lines = dict[str, dict[int, list[Number]]]
"""The points of each line, by source and ESC."""


def _plots(flight: Flight) -> Iterator[dict[str, Any]]:
    """Yield the plots that have data.

    If the sizes of a plot's lines differ, they are drawn in separate plots, unless they have the
    same shape. Noisy lines of several ESCs are drawn in a plot for each ESC.
    """
    for plot in PLOTS:
        lines: Lines = {}
        for (esc, source), values in flight.lines.items():
            if source in plot.lines:
                lines.setdefault(source, {})[esc] = values
        tops = {source: _top(lines[source]) for source in plot.lines if source in lines}
        groups = of_like_size(tops)
        if plot.has_one_shape and tops:
            groups = [[*tops]]
        number = 0
        for sources in groups:
            labels = [plot.lines[source] for source in sources]
            title = plot.title
            if len(groups) > 1:
                title = f"{', '.join(labels)} {plot.title[0].lower()}{plot.title[1:]}"
            note = ""
            if plot.has_one_shape and len(labels) > 1:
                others = "the others differ only by pole pairs and gear"
                note = f"{labels[0].lower()} drawn, {others}"
            series = [*_series(plot, lines, sources)]
            for drawn in _apart(series) if plot.is_noisy else [series]:
                yield {
                    "key": f"{plot.key}-{number}" if number else plot.key,
                    "title": title,
                    "note": note,
                    "unit": VALUES[sources[0]].unit,
                    "digits": plot.digits,
                    "lines": labels,
                    "series": drawn,
                }
                number += 1


def _apart(series: Sequence[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    """Return the series of each ESC."""
    escs = dict.fromkeys(each["esc"] for each in series)
    return [[each for each in series if each["esc"] == esc] for esc in escs]


def _top(line: Mapping[int, Sequence[Number]]) -> float:
    """Return the greatest magnitude in the lines of all ESCs."""
    return max(abs(value) for values in line.values() for value in values if value is not None)


def _series(plot: Plot, lines: Lines, sources: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield the series of a plot. If all have one shape, only the first of each ESC is drawn."""
    escs_drawn = set()
    for line, source in enumerate(sources):
        for esc, values in lines[source].items():
            is_drawn = not plot.has_one_shape or esc not in escs_drawn
            escs_drawn.add(esc)
            yield {"esc": esc, "line": line, "values": values, "drawn": is_drawn}


def of_like_size(tops: Mapping[str, float]) -> list[list[str]]:
    """Return groups of lines whose greatest values differ by a factor of at most APART."""
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
        begin = clock(flight.start_ns - flight.origin_ns)
        end = clock(flight.end_ns - flight.origin_ns)
        facts["Part"] = f"{begin} to {end} of the recording"
    if wall_ns is not None:
        cut_ns = sum(cut.length_ns for cut in flight.cuts if cut.begin_ns < flight.start_ns)
        facts["Begin"] = wall_clock(wall_ns + flight.start_ns - flight.origin_ns + cut_ns)
    for esc in flight.escs:
        noted = provenance.get(esc.name, "")
        facts[esc.name] = noted
        if esc.devices:
            devices = ", then ".join(esc.devices[:8])
            port = noted.rpartition(", at ")[2]
            facts[esc.name] = ", at ".join(filter(None, (devices, port)))
    if flight.is_replayed:
        facts["Replay"] = "These frames were replayed from a recording."
    known = {label.lower() for label in facts}
    facts |= {key: text for key, text in provenance.items() if key.lower() not in known}
    items = (
        f"<div><dt>{escape(key)}</dt><dd>{escape(text)}</dd></div>"
        for key, text in facts.items()
        if text
    )
    return f"<dl>{''.join(items)}</dl>"


def _damage(damage: Sequence[str]) -> str:
    if not damage:
        return ""
    lines = "".join(f"<li>{escape(line)}</li>" for line in damage)
    title = "<strong>The input is damaged. The intact parts are shown.</strong>"
    return f'<div class="damage">{title}<ul>{lines}</ul></div>'


def _cuts(flight: Flight) -> str:
    if not flight.cuts:
        return ""
    lines = "".join(
        f"<li>after {clock(cut.begin_ns - flight.origin_ns)}: {duration(cut.length_ns)}</li>"
        for cut in flight.cuts[:_MAX_CUTS]
    )
    if len(flight.cuts) > _MAX_CUTS:
        lines += f"<li>and {len(flight.cuts) - _MAX_CUTS} more</li>"
    title = (
        "<strong>Gaps of more than a day are cut out, and all times count without them.</strong>"
    )
    return f'<div class="damage">{title} Was the clock set?<ul>{lines}</ul></div>'


def _notes(flight: Flight) -> str:
    lines = []
    if flight.points.rows_in_bucket > 1:
        lines.append(
            "Lines are drawn from the minimum and the maximum of each "
            f"{flight.points.rows_in_bucket} rows. No peak is lost, and its time is exact to "
            "within these rows. All numbers in the tables are computed from every row."
        )
    if any("battery_power" in esc.computed for esc in flight.escs):
        lines.append(
            "Battery power is computed from voltage and current, "
            "because this CAN log has them more often than the power."
        )
    if flight.seen.left_out:
        lines.append(f"{flight.seen.left_out} more events are not listed.")
    return "".join(f'<p class="note">{line}</p>' for line in lines)
