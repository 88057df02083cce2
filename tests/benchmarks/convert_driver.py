"""One conversion in a process of its own: prints its CPU and wall time, its peak memory and what was said of it, as JSON.

    python convert_driver.py FORM IN OUT [--dbc FILE] [--live]

``--live``: of a table only the sixteen values of a live frame.

The libraries are loaded before the clock starts.
"""

import argparse
import json
import re
import time
from functools import partial
from pathlib import Path

from kontronik_can_gw.desk.recordings.convert import TABLES, Output, to_log, to_table
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
        convert = partial(to_log, form=args.form)
        if args.form in TABLES:
            names = LiveData._fields if args.live else ()
            convert = partial(to_table, form=args.form, choice=Choice.of(recording.fields, names))
        cpu, wall = time.process_time(), time.perf_counter()
        with Output(args.target, args.form) as out:
            told = convert(recording, out, lambda position: None)
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    print(json.dumps({"cpu_s": cpu, "wall_s": wall, "peak_mb": peak_mb(), "told": told}))


if __name__ == "__main__":
    main()
