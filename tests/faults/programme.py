"""The faults that need no more than a kernel with vxcan, slcan and vcan, in User Mode Linux.

    python tests/faults/programme.py [--out FILE] [--long] [--only TEXT]... [--list]

They set the clock, mount and make interfaces: never on the machine itself. Exits with 1 if one was not healed in time, or a value on
the bus was wrong, or one was lost that need not have been, or a byte was sent to an ESC.
"""

import contextlib
import os
import sys
import time
import traceback
from collections.abc import Mapping
from pathlib import Path

import benches
import can_faults  # noqa: F401  registers its faults, as the others do
import disk_faults  # noqa: F401
import outside
import process_faults  # noqa: F401
import serial_faults  # noqa: F401
import time_faults  # noqa: F401
import traffic_faults  # noqa: F401
from fault_report import Fault, Report, in_order, line
from harness import Bench

QUICK_TIMES, LONG_TIMES = 2, 20
TIMEOUT_S = {False: 1500, True: 4 * 3600}


def run(
    faults: list[Fault],
    report: Report,
    times: int,
    out: Path,
    made: Mapping[str, benches.MakesBench] = benches.BENCHES,
) -> None:
    """All faults, those with the same bench on one bench; a bench that a fault has broken is made anew."""
    for kind in dict.fromkeys(fault.bench for fault in faults):
        waiting = [fault for fault in faults if fault.bench == kind]
        while waiting:
            with contextlib.ExitStack() as stack:
                try:
                    bench = stack.enter_context(made[kind](report))
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
    print(outside.BEGIN, fault, flush=True)
    good = False
    try:
        fault.run(bench, fault, times)
        good = True
    except AssertionError as error:
        if not row.notes:
            row.notes.append(str(error))
    except Exception as error:
        traceback.print_exc()
        row.notes.append(repr(error))
    if not good and row.recovered >= row.injected:
        row.injected = row.recovered + 1
    print(outside.END, fault, flush=True)
    print(f"{time.monotonic() - begin:6.1f} s  {line(row)}", flush=True)
    return good


def main() -> int:
    parser = outside.parser(__doc__)
    parser.add_argument("--list", action="store_true", help="name the faults and end")
    args = parser.parse_args()
    mine = outside.chosen(in_order("UML"), args.only)
    if args.list:
        print(*mine, sep="\n")
        return 0
    if args.inside is None:
        return outside.main(args, "programme.py", mine, timeout_s=TIMEOUT_S[args.long])
    report = Report(kernel_uml=os.uname().release, long=args.long)
    run(mine, report, LONG_TIMES if args.long else QUICK_TIMES, args.inside / "report.json")
    return 0


if __name__ == "__main__":
    sys.exit(main())
