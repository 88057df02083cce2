"""Runs the core in C for years of virtual time, across every wrap of a time or a counter.

    python tests/proofs/years_run.py [--years N] [--processes N]

years.c generates the telemetry and checks the content of each CAN frame, and the time between two
frames of a message. First the core runs a minute before and after every wrap. Then it runs without
a jump for N years of virtual time (default: ten), at 100 frames of the ESC a second, in several
processes that begin at different times. The exit code is 1 after the first difference, or if the
resident memory grows.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from years import STEP_NS, WRAPS, YEAR_S, RunInC, Wrap, build, load_both

from kontronik_can_gw.times import SECOND

MINUTE_S = 60
MAX_GROWTH_KIB = 64
"""Limit of the resident memory after the first tenth of a run."""


def resident_kib() -> int:
    """Return the resident memory of this process."""
    text = Path("/proc/self/statm").read_text()
    return int(text.split()[1]) * os.sysconf("SC_PAGESIZE") // 1024


def start_of(share: int, shares: int, length_s: float) -> int:
    """Return the time at which a share of the run begins.

    The first one begins with the clock, the second one crosses 2^31 s in its middle, and others
    cross 2^53 ns, 2^54 ns and so on. So there must be two of them at least.
    """
    if share == 0:
        return SECOND
    middle = (1 << 31) * SECOND if share == 1 else 1 << 51 + share
    return max(SECOND, middle - int(length_s / 2 * SECOND))


def run_share(share: int, shares: int, years: float, path: Path) -> int:
    """Run a share of the years in this process, with a compiled core. Return the exit code."""
    steps = int(years * YEAR_S) * SECOND // STEP_NS // shares
    run = RunInC(load_both(path), start_of(share, shares, steps / 100))
    parts = 1000
    first_kib = 0
    most_kib = 0
    begin = time.monotonic()
    for part in range(parts):
        try:
            run.run(steps * (part + 1) // parts - steps * part // parts)
        except AssertionError as error:
            print(f"process {share + 1}: {error}", file=sys.stderr, flush=True)
            return 1
        resident = resident_kib()
        if part + 1 == parts // 10:
            first_kib = resident
        most_kib = max(most_kib, resident - first_kib if first_kib else 0)
        if (part + 1) % 10 == 0:
            done = years / shares * (part + 1) / parts
            left_s = (time.monotonic() - begin) * (parts - part - 1) / (part + 1)
            text = f"process {share + 1}: {done:.4f} years, {left_s:.0f} s left, {resident} KiB"
            print(text, file=sys.stderr, flush=True)
    numbers = run.oracle.numbers
    print(
        f"process {share + 1}: {numbers.steps} steps, {numbers.frames} CAN frames, "
        f"{numbers.losses} losses, time {start_of(share, shares, steps / 100) / SECOND:.0f} s to "
        f"{numbers.now / SECOND:.0f} s, memory +{most_kib} KiB after the first tenth",
        flush=True,
    )
    return int(most_kib > MAX_GROWTH_KIB)


def cross_in_c(library: Any, half_s: float) -> Iterator[Wrap]:
    """Run the core in C across each wrap. Raises AssertionError with the first difference."""
    for wrap in WRAPS:
        try:
            wrap.cross(RunInC(library, wrap.started_ns), half_s)
        except AssertionError as error:
            raise AssertionError(f"{wrap.name}: {error}") from None
        yield wrap


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--years", type=float, default=10, help="years of virtual time, 0.0001 on")
    parser.add_argument("--processes", type=int, default=min(max(2, os.cpu_count() or 2), 8))
    parser.add_argument("--share", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--core", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args(words)
    if not 0.0001 <= args.years <= 100 or not 2 <= args.processes <= 8:
        parser.error("--years is 0.0001 to 100, and --processes 2 to 8")
    if args.share is not None:
        return run_share(args.share, args.processes, args.years, args.core)
    with tempfile.TemporaryDirectory(prefix="kcg-years.") as folder:
        return run_all(build(Path(folder)), args.processes, args.years)


def run_all(path: Path, processes: int, years: float) -> int:
    """Cross each wrap, then run the years in several processes. Return the exit code."""
    try:
        for wrap in cross_in_c(load_both(path), MINUTE_S):
            print(f"crossed: {wrap.name}", flush=True)
    except AssertionError as error:
        print(error, file=sys.stderr)
        return 1
    begin = time.monotonic()
    options = (f"--core={path}", f"--years={years}", f"--processes={processes}")
    command = [sys.executable, __file__, *options]
    shares = [subprocess.Popen([*command, f"--share={share}"]) for share in range(processes)]
    codes = [share.wait() for share in shares]
    print(
        f"{years:g} years in {time.monotonic() - begin:.0f} s, 0 differences"
        if not any(codes)
        else "FAILED"
    )
    return int(any(codes))


if __name__ == "__main__":
    sys.exit(main())
