"""Writes the numbers of one flight, for the list of flights.

python -m kontronik_can_gw.desk.live.summary CAPTURE OUTPUT
"""

import json
import sys
from pathlib import Path
from typing import Any

from kontronik_can_gw.desk.recordings.inputs import Input, open_input
from kontronik_can_gw.desk.report.flight import Flight, flight_of
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.printable import printable
from kontronik_can_gw.times import MS, SECOND

_CLOCK_IS_SET_NS = 1_577_836_800 * SECOND
"""2020-01-01. An earlier date comes from a clock that was not set."""


def summary_of(capture: Path) -> dict[str, Any]:
    """Return the numbers of a flight. Raises UserError if the capture has no values."""
    with open_input(capture) as recording:
        flight = flight_of(recording)
        if not flight.rows:
            raise RunError(*recording.damage, f"{capture.name}: has no values")
        energy_wh = flight.energy_wh
        severities = [event.severity for event in flight.events]
        return {
            "start": _start_ms(recording, flight.origin_ns),
            "duration": round((flight.end_ns - flight.start_ns) / SECOND, 1),
            "current": max(_extremes(flight, "battery_current"), default=None),
            "voltage": min(_extremes(flight, "battery_voltage"), default=None),
            "energy": None if energy_wh is None else round(energy_wh, 2),
            "errors": severities.count("error"),
            "warnings": severities.count("warning"),
            "damage": len(recording.damage),
        }


def _start_ms(recording: Input, origin_ns: int) -> int | None:
    """Return the Unix time of the begin. None if the clock was not set."""
    wall_ns = recording.wall_ns(origin_ns)
    if wall_ns is None or wall_ns < _CLOCK_IS_SET_NS or recording.trust.at(origin_ns) is False:
        return None
    return wall_ns // MS


def _extremes(flight: Flight, source: str) -> list[float]:
    return [esc.extremes[source].value for esc in flight.escs if source in esc.extremes]


def main(capture: str, output: str) -> int:
    try:
        summary = summary_of(Path(capture))
    except UserError as error:
        print(printable(error.problems[-1]), file=sys.stderr)
        return error.exit_code
    part = Path(f"{output}.part")
    part.write_text(json.dumps(summary), encoding="utf-8")
    part.replace(output)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
