"""The fault programme: injects faults into a running gateway in a virtual machine.

    python tests/faults/programme.py [uml|qemu|soak|hours] [--only TEXT]... [--minutes N]
                                     [--hours N] [--seed N] [--junit FILE] [--page]

uml     faults that need only a kernel with vxcan, slcan and vcan, in User Mode Linux
qemu    faults of real drivers, on emulated hardware (tests/vm/setup.sh qemu)
soak    random faults of uml for minutes or hours, in the same order for the same seed
hours   no faults: one ESC for hours of virtual time (--hours), see long_run.py

Faults set the clock, mount file systems and create interfaces, but never on the machine itself. The
exit code is 1 if the gateway did not recover in time, a value on the bus was wrong or lost without
need, or a byte was sent to an ESC. No fault is repeated after a failure. User Mode Linux has a
separate time (tests/vm/uml_time.c), and QEMU counts instructions. So the result does not depend on
the speed or load of the machine.
"""

import argparse
import random
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from pathlib import Path

import beds
import can_faults  # noqa: F401  registers its faults, as the others do
import long_run
import outage_faults
import process_faults  # noqa: F401
import qemu_faults  # noqa: F401
import serial_faults  # noqa: F401
from fault_report import FAILED, PAGE, Fault, Report, in_order, put
from harness import Bench
from memory_slope import Sample, faults_in, slope_kib_per_hour

PROJECT = Path(__file__).resolve().parents[2]
REPORT = "report.json"
TIMEOUT_S = {"uml": 2300, "qemu": 600}
MIN_HOURS = 0.1
MAX_HOURS = 1000.0
REAL_S_PER_HOUR = 3600
"""Longest real time of an hour of virtual time."""
NEW_PROCESS = ("missing at start", "kill -9", "SIGTERM", "frozen")
"""Faults that end the gateway, so that its memory could not be followed."""
MAX_GROWTH_KIB = 2048
SOAK = Fault("Process", "memory, descriptors and threads after it all", None, print, beds.two)
HOURS = Fault("Process", "hours without a fault, past the year 2038", None, print, beds.two)


# --- outside of the virtual machine


def run_inside(args: argparse.Namespace) -> Report:
    """Run this script in a virtual machine. Return its rows."""
    with tempfile.TemporaryDirectory(prefix="kcg-faults.") as folder:
        timeout_s = TIMEOUT_S.get(args.part, 180 * args.minutes + 300)
        timeout_s *= max(1, args.outages // 4)
        if args.part == "hours":
            timeout_s = REAL_S_PER_HOUR * args.hours + 300
        words = [
            sys.executable,
            PROJECT / "tests/vm/vm_run.py",
            f"--timeout={timeout_s:g}",
            f"--backend={'qemu' if args.part == 'qemu' else 'uml'}",
            f"--rw={folder}",
            "--",
            sys.executable,
            "-B",
            __file__,
            args.part,
            f"--inside={folder}",
            f"--seed={args.seed}",
            f"--minutes={args.minutes:g}",
            f"--hours={args.hours:g}",
            f"--outages={args.outages}",
            f"--hangs={args.hangs}",
            *(f"--only={text}" for text in args.only),
        ]
        subprocess.run(list(map(str, words)), stdin=subprocess.DEVNULL, check=False)
        report = Report()
        file = Path(folder, REPORT)
        if file.exists():
            report.read(file)
    return report


def conclude(report: Report) -> int:
    """Print the failed faults and the counts. Return the exit code."""
    failed = [row.text for row in report.values() if row.state == FAILED]
    counts = f"{len(report)} faults: {len(failed)} failed, {len(report) - len(failed)} good"
    print(*failed, counts, sep="\n", flush=True)
    return int(bool(failed) or not report)


# --- inside


def run(faults: Sequence[Fault], report: Report, folder: Path) -> None:
    """Run all faults. Faults with the same bed share a bench, which is replaced if it breaks."""
    for bed in dict.fromkeys(fault.bed for fault in faults):
        waiting = [fault for fault in faults if fault.bed is bed]
        while waiting:
            try:
                with bed(folder) as bench:
                    good = True
                    while waiting and good:
                        fault = waiting.pop(0)
                        good = run_one(bench, fault, fault.rounds, report)
                        report.write(folder / REPORT)
            except Exception:
                # The next fault counts as not reached.
                traceback.print_exc()
                del waiting[:1]


def run_one(
    bench: Bench,
    fault: Fault,
    rounds: Sequence[object],
    report: Report,
) -> bool:
    """Run the rounds of a fault. Return True if the bench is still usable."""
    begin = time.monotonic()
    row = report.of(fault)
    good = all(bench.inject(fault, row, each) for each in rounds)
    print(f"{time.monotonic() - begin:6.1f} s  {row.text}", flush=True)
    return good


def soak(
    bench: Bench,
    report: Report,
    generator: random.Random,
    end: float,
) -> None:
    """Inject faults that do not end the process until ``end``. Then check the process.

    Descriptors and threads must not grow. The memory is judged by its growth and, after an hour or
    more, by its slope.
    """
    faults = []
    for fault in in_order():
        ends_process = any(text in fault.name for text in NEW_PROCESS)
        if fault.bed is beds.two and not ends_process:
            faults.append(fault)
    row = report.of(SOAK)
    bench.said_instead = "happens often"  # a flapping port does not cause a line each time
    before = bench.gateway.figures()
    samples: list[Sample] = []
    while time.monotonic() < end:
        fault = generator.choice(faults)
        time.sleep(generator.uniform(0.5, 3))
        if row.injected == 5:
            before = bench.gateway.figures()
        row.injected += 1
        run_one(bench, fault, [generator.choice(fault.rounds)], report)
        samples.append(Sample(time.monotonic(), bench.gateway.figures()["rss"]))
    row.notes += faults_in(samples)
    print(f"memory: {slope_kib_per_hour(samples):.0f} KiB an hour, {len(samples)} samples")
    row.notes += bench.gateway.growth(before, MAX_GROWTH_KIB)
    row.recovered = 0 if row.notes else row.injected
    print(row.text, bench.gateway.figures())


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("part", nargs="?", choices=("uml", "qemu", "soak", "hours"), default="uml")
    parser.add_argument("--junit", type=Path, help="write what came of it as a JUnit report")
    parser.add_argument("--page", action="store_true", help="write it to docs/fault-programme.md")
    parser.add_argument("--only", action="append", default=[], help="faults with this text")
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--hours", type=float, default=30, help="virtual time of hours")
    parser.add_argument("--outages", type=int, default=2, help="number of lengths of outages")
    parser.add_argument("--hangs", type=int, default=4, help="number of hanging adapters")
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(1 << 32))
    parser.add_argument("--inside", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if not MIN_HOURS <= args.hours <= MAX_HOURS:
        parser.error(f"--hours is {MIN_HOURS:g} to {MAX_HOURS:g}")
    outage_faults.choose(args.outages, args.hangs)
    if args.part in ("soak", "hours"):
        faults = [SOAK if args.part == "soak" else HOURS]
    else:
        faults = [fault for fault in in_order() if fault.machine.lower() == args.part]
        if args.only:
            faults = [each for each in faults if any(text in str(each) for text in args.only)]
    if args.inside is None:
        report = run_inside(args)
        for fault in faults:
            report.of(fault)  # a fault that was not reached has failed
        if args.junit:
            report.write_junit(args.junit)
        if args.page:
            PAGE.write_text(put(PAGE.read_text(), report))
        return conclude(report)
    report = Report()
    if args.part == "soak":
        print(f"seed {args.seed}", flush=True)
        with beds.everything(args.inside) as bench:
            soak(bench, report, random.Random(args.seed), time.monotonic() + 60 * args.minutes)
        report.write(args.inside / REPORT)
    elif args.part == "hours":
        long_run.set_wall_clock(args.hours)
        with beds.everything(args.inside, beds.IDENTITIES[:1]) as bench:
            long_run.live(bench, HOURS, report, args.hours, MAX_GROWTH_KIB)
        report.write(args.inside / REPORT)
    else:
        run(faults, report, args.inside)
    return 0


if __name__ == "__main__":
    sys.exit(main())
