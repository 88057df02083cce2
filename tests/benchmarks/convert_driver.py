"""One conversion in a process of its own: prints its CPU and wall time, its peak memory and what was said of it, as JSON.

    python convert_driver.py FORM IN OUT [--dbc FILE] [--live]

``--live``: of a table only the sixteen values of a live frame.

The libraries are loaded before the clock starts.
"""

import argparse
import json
import re
import time
from pathlib import Path

from kontronik_can_gw.desk.recordings.convert import (
    TABLES,
    Conversion,
    LogConversion,
    Output,
    TableConversion,
)
from kontronik_can_gw.desk.recordings.inputs import DumpInput
from kontronik_can_gw.desk.recordings.layouts import layout_of_dbc
from kontronik_can_gw.desk.recordings.tables.rows import Choice
from kontronik_can_gw.esc.kontronik.fields import LiveData


def peak_mb() -> float:
    """The most memory that this process had, in MB (0 where the system does not tell)."""
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return int(found[1]) / 1024 if found else 0.0


def main() -> None:
    """Convert as asked."""
    parser = argparse.ArgumentParser()
    parser.add_argument("form")
    parser.add_argument("source", type=Path)
    parser.add_argument("target", type=Path)
    parser.add_argument("--dbc", type=Path)
    parser.add_argument("--live", action="store_true")
    args = parser.parse_args()
    if args.form == "parquet":
        import pyarrow.parquet  # type: ignore[import-untyped]

        pyarrow.array([0])  # imports pandas where it is installed
    layout = None if args.dbc is None else layout_of_dbc(args.dbc)
    with DumpInput(args.source, layout) as recording:
        conversion: Conversion = LogConversion(args.form)
        if args.form in TABLES:
            names = LiveData._fields if args.live else ()
            conversion = TableConversion(args.form, Choice.of(recording.fields, names))
        cpu, wall = time.process_time(), time.perf_counter()
        with Output(args.target, args.form) as out:
            told = conversion(recording, out, lambda position: None)
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    print(json.dumps({"cpu_s": cpu, "wall_s": wall, "peak_mb": peak_mb(), "told": told}))


if __name__ == "__main__":
    main()
