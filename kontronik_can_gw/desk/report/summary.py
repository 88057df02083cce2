"""The numbers of a flight as HTML: tiles with the most important ones, and tables with a column for each ESC."""

from collections.abc import Mapping
from html import escape

from kontronik_can_gw.desk.report.flight import EscFlight, Extreme, Flight
from kontronik_can_gw.desk.report.quantities import MAXIMA, MINIMA
from kontronik_can_gw.desk.report.text import clock, duration, number
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.esc.values import VALUES

_EXTREMES = (
    ("Peak power", "battery_power", 0),
    ("Peak battery current", "battery_current", 1),
    ("Lowest battery voltage", "battery_voltage", 2),
    ("Hottest power stage", "power_stage_temperature", 0),
)


def tiles(flight: Flight) -> str:
    """The most important numbers; with several ESCs the extreme and the name of its ESC."""
    escs = flight.escs
    found = [_tile("Duration", duration(flight.end_ns - flight.start_ns))]
    turning = [esc.turning_ns for esc in escs if esc.turning_ns is not None]
    if turning:
        aside = "the longest of all" if len(escs) > 1 else ""
        found.append(_tile("Motor turning", duration(max(turning)), aside))
    energies = [energy for esc in escs if (energy := _energy_wh(esc)) is not None]
    if energies:
        charges = [c for esc in escs if (c := esc.counted.get("consumed_charge")) is not None]
        aside = f"{number(sum(charges), 0)} mAh" if charges else ""
        label = "Energy, all ESCs" if len(escs) > 1 else "Energy"
        found.append(_tile(label, f"{number(sum(energies), 1)} Wh", aside))
    for label, source, digits in _EXTREMES:
        of_escs = [
            (extreme, escape(esc.name) if len(escs) > 1 else "")
            for esc in escs
            if (extreme := (esc.maxima | esc.minima).get(source)) is not None
        ]
        if of_escs:
            extreme, name = (min if source in MINIMA else max)(of_escs)
            value = f"{number(extreme.value, digits)} {VALUES[source].unit}"
            found.append(_tile(label, value, f"{_at(extreme, flight)} {name}"))
    severities = [event.severity for event in flight.events if event.kind == "error"]
    errors, warnings = severities.count("error"), severities.count("warning")
    aside = f"{warnings} warning{'' if warnings == 1 else 's'}"
    found.append(_tile("Errors", str(errors), aside, "bad" if errors else "good"))
    return "".join(found)


def tables(flight: Flight) -> str:
    """A table for each group: a row for each number, a column for each ESC; unknown numbers are left out."""
    heads = "".join(f'<th scope="col">{escape(esc.name)}</th>' for esc in flight.escs)
    head = f"<thead><tr><td></td>{heads}</tr></thead>" if len(flight.escs) > 1 else ""
    of_escs = [_numbers(esc, flight) for esc in flight.escs]
    html = ""
    for title, labels in of_escs[0].items():
        rows = ""
        for label in labels:
            values = [groups[title][label] for groups in of_escs]
            cells = "".join(f"<td>{value or '–'}</td>" for value in values)
            rows += f'<tr><th scope="row">{label}</th>{cells}</tr>' if any(values) else ""
        if rows:
            caption = f"<caption>{title}</caption>"
            html += f'<table class="numbers">{caption}{head}<tbody>{rows}</tbody></table>'
    return html


def _numbers(esc: EscFlight, flight: Flight) -> dict[str, dict[str, str | None]]:
    """HTML of the numbers of an ESC by group and label; None where it is not known."""
    rest, load, counted = esc.rest_voltage, esc.load_voltage, esc.counted
    charge = _value(counted.get("consumed_charge"), 0, "mAh")
    if charge and esc.charge_resets:
        charge += f" (the counter began again: {esc.charge_resets})"
    energy = _value(_energy_wh(esc), 1, "Wh")
    if energy and esc.energy_drawn is not None:
        energy += f" (power integrated: {number(esc.energy_drawn, 2)} Wh)"
    share = 100 * esc.telemetry_ns / max(1, flight.end_ns - flight.start_ns)
    return {
        "Use": {
            "Motor turning": None if esc.turning_ns is None else _bold(duration(esc.turning_ns)),
            "Energy used": energy,
            "Energy returned by braking": _value(esc.energy_returned, 2, "Wh"),
            "Charge used": charge,
            "Mean power while turning": _value(esc.power_turning, 0, "W"),
        },
        "Maxima": _extremes(MAXIMA, esc.maxima, flight),
        "Voltages": {
            **_extremes(MINIMA, esc.minima, flight),
            "At rest before the first load": _per_cell(rest, esc),
            "Lowest under load": load and f"{_per_cell(load.value, esc)} {_at(load, flight)}",
            "Sag": None if rest is None or load is None else _per_cell(rest - load.value, esc),
        },
        "Quality of the data": {
            "With telemetry": f"{_value(share, 2, '%')} ({duration(esc.telemetry_ns)})",
            "Gaps": _bold(str(esc.gaps)),
            "Longest gap": duration(esc.longest_gap_ns) if esc.gaps else None,
            "Losses of the link": _value(counted.get("losses"), 0),
            "CRC errors": _value(counted.get("crc_errors"), 0),
            "Bytes dropped": _value(counted.get("dropped_bytes"), 0),
        },
    }


def _extremes(
    quantities: Mapping[str, tuple[str, int]], found: Mapping[str, Extreme], flight: Flight
) -> dict[str, str | None]:
    def shown(source: str, digits: int) -> str | None:
        extreme = found.get(source)
        unit = VALUES[source].unit
        return extreme and f"{_value(extreme.value, digits, unit)} {_at(extreme, flight)}"

    return {label: shown(source, digits) for source, (label, digits) in quantities.items()}


def _tile(label: str, value: str, aside: str = "", kind: str = "") -> str:
    text = f"<span>{label}</span><b>{value}</b><small>{aside or '&nbsp;'}</small>"
    return f'<div class="{kind}">{text}</div>'


def _at(extreme: Extreme, flight: Flight) -> str:
    """A button that moves the plots to the time of an extreme."""
    since = extreme.time_ns - flight.origin_ns
    at = f"{since / SECOND:.6f}"
    return f'<button type="button" class="at" data-at="{at}">{clock(since)}</button>'


def _bold(text: str) -> str:
    return f"<b>{text}</b>"


def _value(value: float | None, digits: int, unit: str = "") -> str | None:
    return None if value is None else f"{_bold(number(value, digits))} {unit}".rstrip()


def _energy_wh(esc: EscFlight) -> float | None:
    """By the gateway's counter; integrated where there is none."""
    return esc.counted.get("energy_used", esc.energy_drawn)


def _per_cell(voltage: float | None, esc: EscFlight) -> str | None:
    if voltage is None or not esc.cells:
        return _value(voltage, 2, "V")
    return f"{_value(voltage / esc.cells, 3, 'V a cell')} ({number(voltage, 2)} V)"
