"""Compares the gateway with a small C program and with a simple Python program.

    .venv/bin/python tests/benchmarks/bench.py [--only NAME ...] [--list] [--seconds N] [--quick]

Prints a table of figures with their targets on standard output, and the progress on standard error.
The exit code is 1 if a benchmark fails. A missed target is not an error.
"""

import argparse
import fnmatch
import sys
import traceback
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import busy  # noqa: E402
import live  # noqa: E402
import offline  # noqa: E402
import page  # noqa: E402
from programs import Context, Figure, LeftOut  # noqa: E402

BENCHMARKS = {
    "cpu": live.cpu,
    "cpu-canopen": live.canopen,
    "many": live.many,
    "delay": live.delay,
    "delay-full": live.delay_full,
    "delay-busy": busy.delay_busy,
    "delay-busy-workers": busy.delay_busy_workers,
    "offline-capture": offline.captures,
    "offline-log": offline.can_logs,
    "offline-bytes": offline.plain_bytes,
    "quiet": live.quiet,
    "start": live.start,
    "memory": live.memory,
    "web": page.web,
}
FOLDER = ROOT / "build" / "bench"
"""Folder of compiled programs and of temporary files. It is kept for the next run."""


def seconds(text: str) -> float:
    number = float(text)
    if not 0.1 <= number <= 3600:
        raise argparse.ArgumentTypeError(f"{text} is not within 0.1 to 3600")
    return number


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="bench", description=__doc__.splitlines()[0])
    option = parser.add_argument
    option("--only", nargs="+", default=["*"], metavar="NAME", help="these alone; as 'cpu*' too")
    option("--list", action="store_true", help="list the benchmarks and end")
    option("--seconds", type=seconds, metavar="N", help="of one measurement (5, delay-busy* 600)")
    option("--quick", action="store_true", help="as short as it can be: tries the benchmarks")
    args = parser.parse_args(arguments)
    if args.list:
        for name, function in BENCHMARKS.items():
            print(f"{name:15} {(function.__doc__ or '').splitlines()[0]}")
        return 0
    for one in args.only:
        if not fnmatch.filter(BENCHMARKS, one):
            print(f"bench: there is no benchmark {one}. See --list.", file=sys.stderr)
            return 2
    FOLDER.mkdir(parents=True, exist_ok=True)
    if args.quick:
        short = min(args.seconds or 0.5, 0.5)
        context = Context(FOLDER, seconds=short, long_seconds=short, rounds=1, quick=True)
    elif args.seconds:
        context = Context(FOLDER, seconds=args.seconds, long_seconds=args.seconds)
    else:
        context = Context(FOLDER)
    results: dict[str, list[Figure] | str] = {}
    for name, function in BENCHMARKS.items():
        if any(fnmatch.fnmatch(name, one) for one in args.only):
            print(name, file=sys.stderr, flush=True)
            try:
                results[name] = function(context)
            except LeftOut as reason:
                results[name] = f"left out: {reason}"
            except Exception as reason:  # the other benchmarks must still be run
                results[name] = f"failed: {type(reason).__name__}: {reason}"
                traceback.print_exc()
    print("\n".join(table(results)))
    return int(any(str(result).startswith("failed") for result in results.values()))


def number(value: float) -> str:
    """Return a number with at least 4 digits, and without an exponent below a thousand million."""
    is_whole = abs(value) >= 1000 or value == int(value)
    if is_whole:
        return f"{value:,.0f}".replace(",", " ")
    return f"{value:.4g}"


def table(results: dict[str, list[Figure] | str]) -> list[str]:
    """Return lines with the figures, their values and targets, and whether they are reached."""
    figures: list[Figure] = []
    for found in results.values():
        if not isinstance(found, str):
            figures += found
    width = max((len(each.name) for each in figures), default=0)
    lines = []
    for name, found in results.items():
        lines.append(name)
        if isinstance(found, str):
            lines.append(f"  {found}")
            continue
        for each in found:
            verdict = {True: "reached", False: "MISSED", None: ""}[each.reached]
            words = f"{each.name:{width}}  {number(each.value):>12}  {each.unit:18}"
            lines.append(f"  {words}  {each.target:9}  {verdict:7}  {each.note}".rstrip())
    reached = [each.reached for each in figures]
    summary = f"targets: {reached.count(True)} reached, {reached.count(False)} missed"
    return [*lines, "", summary]


if __name__ == "__main__":
    sys.exit(main())
