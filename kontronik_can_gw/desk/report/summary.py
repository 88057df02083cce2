"""Renders the numbers of a flight as HTML.

Tiles show the most important numbers. Tables have a column for each ESC.
"""

from collections.abc import Mapping
from html import escape

from kontronik_can_gw.desk.quantities import COUNTERS, MAXIMA, MINIMA, TILES
from kontronik_can_gw.desk.report.esc import EscFlight, Extreme
from kontronik_can_gw.desk.report.flight import Flight
from kontronik_can_gw.desk.words import clock, duration, number
from kontronik_can_gw.esc.values import VALUES
from kontronik_can_gw.times import SECOND


def tiles(flight: Flight) -> str:
    """Return the most important numbers. Of several ESCs, the extreme and its ESC are shown."""
    escs = flight.escs
    of_all, longest_of_all = (", all ESCs", "the longest of all") if len(escs) > 1 else ("", "")
    html = _tile("Duration", duration(flight.end_ns - flight.start_ns))
    if any(esc.has_speed for esc in escs):
        longest_ns = max(esc.turning_ns for esc in escs)
        html += _tile("Motor turning", duration(longest_ns), longest_of_all)
    if flight.energy_wh is not None:
        charge = sum(esc.counted.get("consumed_charge") or 0 for esc in escs)
        aside = _plain(charge, 0, "mAh") if charge else ""
        html += _tile(f"Energy{of_all}", _plain(flight.energy_wh, 1, "Wh"), aside)
    for source, label in TILES.items():
        html += _extreme_tile(source, label, flight)
    if any(esc.has_errors for esc in escs):
        severities = [event.severity for event in flight.events if event.kind == "error"]
        errors = severities.count("error")
        warnings = severities.count("warning")
        aside = "1 warning" if warnings == 1 else f"{warnings} warnings"
        html += _tile("Errors", str(errors), aside, "bad" if errors else "good")
    return html


def _extreme_tile(source: str, label: str, flight: Flight) -> str:
    """Return the tile of the extreme of all ESCs. Empty if it is not known."""
    known = [esc for esc in flight.escs if source in esc.extremes]
    if not known:
        return ""
    best = min if source in MINIMA else max
    extreme, name = best((esc.extremes[source], escape(esc.name)) for esc in known)
    if len(flight.escs) == 1:
        name = ""
    _, digits = (MAXIMA | MINIMA)[source]
    value = _plain(extreme.value, digits, VALUES[source].unit)
    return _tile(label, value, f"{_at(extreme, flight)} {name}")


def _tile(label: str, value: str, aside: str = "", kind: str = "") -> str:
    text = f"<span>{label}</span><b>{value}</b><small>{aside or '&nbsp;'}</small>"
    return f'<div class="{kind}">{text}</div>'


def tables(flight: Flight) -> str:
    """Return a table for each group of numbers.

    It has a row for each number and a column for each ESC. Unknown numbers are left out.
    """
    head = ""
    if len(flight.escs) > 1:
        heads = "".join(f'<th scope="col">{escape(esc.name)}</th>' for esc in flight.escs)
        head = f"<thead><tr><td></td>{heads}</tr></thead>"
    of_escs = [_numbers(esc, flight) for esc in flight.escs]
    html = ""
    for title, labels in of_escs[0].items():
        rows = ""
        for label in labels:
            values = [groups[title][label] or "–" for groups in of_escs]
            if {*values} != {"–"}:
                cells = "</td><td>".join(values)
                rows += f'<tr><th scope="row">{label}</th><td>{cells}</td></tr>'
        if rows:
            caption = f"<caption>{title}</caption>"
            html += f'<table class="numbers">{caption}{head}<tbody>{rows}</tbody></table>'
    return html


def _numbers(esc: EscFlight, flight: Flight) -> dict[str, dict[str, str]]:
    """Return HTML of the numbers of an ESC by group and label. Unknown numbers are empty."""
    rest = esc.rest_voltage
    load = esc.load_voltage
    lowest = ""
    sag = None
    if load is not None:
        lowest = f"{_per_cell(load.value, esc)} {_at(load, flight)}"
        if rest is not None:
            sag = rest - load.value
    length_ns = max(1, flight.end_ns - flight.start_ns)
    share = 100 * esc.telemetry_ns / length_ns
    counts = {}
    for source, label in COUNTERS.items():
        count = esc.counted.get(source)
        counts[label] = _value(count, 0, VALUES[source].unit)
    turning = ""
    if esc.has_speed:
        turning = _bold(duration(esc.turning_ns))
    return {
        "Use": {
            "Motor turning": turning,
            "Energy used": _value(esc.energy_wh, 1, "Wh"),
            "Charge used": counts.pop("Charge used"),
        },
        "Maxima": _extremes(MAXIMA, esc, flight),
        "Voltages": {
            **_extremes(MINIMA, esc, flight),
            "At rest before the first load": _per_cell(rest, esc),
            "Lowest under load": lowest,
            "Sag": _per_cell(sag, esc),
        },
        "Quality of the data": {
            "With telemetry": f"{_value(share, 2, '%')} ({duration(esc.telemetry_ns)})",
            "Gaps": _bold(str(esc.gaps)),
            **counts,
        },
    }


def _extremes(
    quantities: Mapping[str, tuple[str, int]],
    esc: EscFlight,
    flight: Flight,
) -> dict[str, str]:
    found = {}
    for source, (label, digits) in quantities.items():
        extreme = esc.extremes.get(source)
        found[label] = ""
        if extreme is not None:
            value = _value(extreme.value, digits, VALUES[source].unit)
            found[label] = f"{value} {_at(extreme, flight)}"
    return found


def _at(extreme: Extreme, flight: Flight) -> str:
    """Return a button that moves the plots to the time of an extreme."""
    since = extreme.time_ns - flight.origin_ns
    at = f"{since / SECOND:.6f}"
    return f'<button type="button" class="at" data-at="{at}">{clock(since)}</button>'


def _bold(text: str) -> str:
    return f"<b>{text}</b>"


def _plain(value: float, digits: int, unit: str) -> str:
    return f"{number(value, digits)} {unit}".rstrip()


def _value(value: float | None, digits: int, unit: str) -> str:
    if value is None:
        return ""
    return f"{_bold(number(value, digits))} {unit}".rstrip()


def _per_cell(voltage: float | None, esc: EscFlight) -> str:
    if voltage is None or not esc.cells:
        return _value(voltage, 2, "V")
    cell = _value(voltage / esc.cells, 3, "V a cell")
    battery = _plain(voltage, 2, "V")
    return f"{cell} ({battery})"
