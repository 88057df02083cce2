"""Runs the faults that need no more than a kernel with vxcan, slcan and vcan, and writes what came of them.

    python tests/faults/programme.py --out FILE [--long] [--only TEXT]... [--times N] [--part 1|2] [--list]

Needs to be root in a virtual machine: it sets the clock, mounts and makes interfaces (tests/vm/run --backend uml). Exits with 1
if a fault was not healed in time, or a value on the bus was wrong, or one was lost that need not have been.
"""

import argparse
import contextlib
import os
import sys
import tempfile
import time
import traceback
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

import benches
import can_faults  # noqa: F401  registers its faults, as the others do
import disk_faults  # noqa: F401
import process_faults  # noqa: F401
import serial_faults  # noqa: F401
import time_faults  # noqa: F401
import traffic_faults  # noqa: F401
from fault_report import Fault, Report, in_order, line
from harness import Bench

QUICK_TIMES, LONG_TIMES = 2, 20


def run(faults: list[Fault], report: Report, times: int, out: Path) -> None:
    """All faults, those with the same bench on one bench; a bench that a fault has broken is made anew."""
    kinds = list(dict.fromkeys(fault.bench for fault in faults))
    for kind in kinds:
        waiting = [fault for fault in faults if fault.bench == kind]
        while waiting:
            with contextlib.ExitStack() as stack:
                try:
                    bench = stack.enter_context(benches.BENCHES[kind](report))
                except Exception as error:
                    traceback.print_exc()
                    row = report.row(waiting.pop(0))
                    row.injected += 1
                    row.notes.append(f"no bench: {error!r}")
                    print(line(row), flush=True)
                    continue
                while waiting and run_one(bench, waiting.pop(0), report, times):
                    report.write(out)
        report.write(out)


def run_one(bench: Bench, fault: Fault, report: Report, times: int) -> bool:
    """True if the bench is still good."""
    begin = time.monotonic()
    row = report.row(fault)
    try:
        fault.run(bench, fault, times)
        good = True
    except AssertionError as error:
        if not row.notes:
            row.notes.append(str(error))
        good = False
    except Exception as error:
        traceback.print_exc()
        row.notes.append(repr(error))
        good = False
    if not good and row.recovered >= row.injected:
        row.injected = row.recovered + 1
    print(f"{time.monotonic() - begin:6.1f} s  {line(row)}", flush=True)
    return good


def in_first_part(fault: Fault) -> bool:
    """The halves take about the same time."""
    return fault.bench in ("two", "cycles") and fault.area in ("Serial", "CAN", "Time")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()) / "faults.json")
    parser.add_argument("--long", action="store_true", help="each fault more often, and longer")
    parser.add_argument("--times", type=int)
    parser.add_argument("--only", action="append", help="faults whose area or name holds this text")
    parser.add_argument("--part", type=int, choices=(1, 2), help="one half of it, for two machines at once")
    parser.add_argument("--list", action="store_true", help="name the faults and end")
    args = parser.parse_args()
    mine = in_order("UML")
    if args.part:
        mine = [fault for fault in mine if in_first_part(fault) == (args.part == 1)]
    if args.only:
        mine = [fault for fault in mine if any(text in f"{fault.area}: {fault.name}" for text in args.only)]
    if args.list:
        for fault in mine:
            print(f"{fault.area}: {fault.name}")
        return 0
    if not os.environ.get("VM_BACKEND"):
        print(
            "not in a virtual machine: tests/vm/run --backend uml -- python tests/faults/programme.py", file=sys.stderr
        )
        return 2
    kernel = os.uname().release
    report = Report(kernel_uml=kernel, long=args.long)
    begin = time.monotonic()
    run(mine, report, args.times or (LONG_TIMES if args.long else QUICK_TIMES), args.out)
    report.write(args.out)
    good = sum(row.good for row in report.rows)
    print(f"{good} of {len(report.rows)} faults healed as they must, {time.monotonic() - begin:.0f} s", flush=True)
    return 0 if report.good else 1


if __name__ == "__main__":
    sys.exit(main())
