"""Measures the gateway beside a small C program and beside the obvious Python program, and says which targets are reached.

    .venv/bin/python tests/benchmarks/bench.py [--only NAME ...] [--list] [--seconds N] [--quick] [--vcan NAME]

Standard output has the table, standard error what is going on; the table and every single run go to build/bench.json. Exit code 1
where two programs do not agree or one fails; a missed target is told and is no error.
"""

import argparse
import fnmatch
import json
import os
import platform
import sys
import time
import traceback
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import instructions  # noqa: F401  registers its benchmarks, as the others do
import live  # noqa: F401
import offline  # noqa: F401
import registry
import start_and_memory  # noqa: F401
from registry import Benchmark, Context, Figure, LeftOut, NotEqual


def seconds(text: str) -> float:
    number = float(text)
    if not 0.1 <= number <= 3600:
        raise argparse.ArgumentTypeError(f"{text} is not within 0.1 to 3600")
    return number


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(prog="bench", description=__doc__.splitlines()[0])
    option = made.add_argument
    option("--only", nargs="+", default=["*"], metavar="NAME", help="these alone; as 'cpu*' too")
    option("--list", action="store_true", help="list the benchmarks and end")
    option("--seconds", type=seconds, default=5.0, metavar="N", help="of one measurement (5)")
    option("--quick", action="store_true", help="as short as it can be: tries the benchmarks")
    option("--vcan", default="", metavar="NAME", help="an interface in place of the local socket")
    return made


def main(arguments: list[str] | None = None) -> int:
    args = parser().parse_args(arguments)
    # what must be equal comes first
    known = sorted(registry.BENCHMARKS, key=lambda each: each.name != "equal")
    if args.list:
        for each in known:
            print(f"{each.name:15} {each.help}")
        return 0
    for one in args.only:
        if not fnmatch.filter([each.name for each in known], one):
            print(f"bench: there is no benchmark {one}. See --list.", file=sys.stderr)
            return 2
    lasts, turns = (min(args.seconds, 0.5), 1) if args.quick else (args.seconds, 3)
    folder = registry.ROOT / "build" / "bench"
    folder.mkdir(parents=True, exist_ok=True)
    common = Context(folder, lasts, turns, args.quick, args.vcan)
    results, interrupted = [], False
    try:
        for each in known:
            if any(fnmatch.fnmatch(each.name, one) for one in args.only):
                results.append(run_one(each, replace(common, data={})))
    except KeyboardInterrupt:
        interrupted = True
        print("bench: ended by hand; what is done is written", file=sys.stderr)
    file = registry.ROOT / "build" / "bench.json"
    file.write_text(json.dumps(document(common, results), indent=1, allow_nan=False) + "\n")
    print("\n".join(table(results)))
    print(f"JSON: {file}", file=sys.stderr)
    if interrupted:
        return 130
    return 1 if any(result["error"] for result in results) else 0


def run_one(benchmark: Benchmark, context: Context) -> dict[str, Any]:
    """Run it and note what came of it, whatever that is."""
    print(f"{benchmark.name}: {benchmark.help}", file=sys.stderr, flush=True)
    figures: list[Figure] = []
    left_out = error = ""
    begun = time.monotonic()
    try:
        figures = benchmark.function(context)
    except LeftOut as reason:
        left_out = str(reason)
    except NotEqual as reason:
        error = f"not equal: {reason}"
    except Exception as reason:  # one that fails must not end the others
        error = f"failed: {type(reason).__name__}: {reason}"
        traceback.print_exc()
    if left_out or error:
        context.say(error or f"left out: {left_out}")
    return {
        "name": benchmark.name,
        "figures": [asdict(figure) for figure in figures],
        "left_out": left_out,
        "error": error,
        "took_s": round(time.monotonic() - begun, 2),
        "data": context.data,
    }


def document(context: Context, results: list[dict[str, Any]]) -> dict[str, Any]:
    """What goes into the JSON file."""
    return {
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "kernel": platform.release(),
        "python": platform.python_version(),
        "seconds": context.seconds,
        "quick": context.quick,
        "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "benchmarks": results,
    }


def number(value: float) -> str:
    """As people read it: 4 figures, no exponent below a thousand million."""
    whole = abs(value) >= 1000 or value == int(value)
    return f"{value:,.0f}".replace(",", " ") if whole else f"{value:.4g}"


def table(results: list[dict[str, Any]]) -> list[str]:
    """Figure, value, target, reached or not."""
    figures = [figure for result in results for figure in result["figures"]]
    width = max((len(figure["name"]) for figure in figures), default=0)
    lines = []
    for result in results:
        lines.append(result["name"])
        for figure in result["figures"]:
            verdict = {True: "reached", False: "MISSED", None: ""}[figure["reached"]]
            words = f"{figure['name']:{width}}  {number(figure['value']):>12}  {figure['unit']:18}  {figure['target']:9}"
            lines.append(f"  {words}  {verdict:7}  {figure['note']}".rstrip())
        for word in ("left_out", "error"):
            if result[word]:
                lines.append(f"  {word.replace('_', ' ')}: {result[word]}")
    reached = [figure["reached"] for figure in figures]
    left_out, failed = (
        sum(bool(result[word]) for result in results) for word in ("left_out", "error")
    )
    counts = f"{reached.count(True)} reached, {reached.count(False)} missed"
    return [*lines, "", f"targets: {counts}; {left_out} left out, {failed} failed"]


if __name__ == "__main__":
    sys.exit(main())
