"""Measures the gateway beside a small C program and beside the obvious Python program, and says which targets are reached.

    .venv/bin/python tests/benchmarks/bench.py [--only NAME ...] [--list] [--seconds N] [--json FILE]

Standard output has the table, standard error what is going on. Exit code 1 where two programs do not agree or one fails; a missed target
is told and is no error.
"""

import argparse
import fnmatch
import json
import os
import platform
import sys
import time
import traceback
from dataclasses import asdict
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import registry
from registry import Benchmark, Context, Figure, LeftOut, NotEqual


def seconds(text: str) -> float:
    number = float(text)
    if not 0.1 <= number <= 3600:
        raise argparse.ArgumentTypeError(f"{text} is not within 0.1 to 3600")
    return number


def rounds(text: str) -> int:
    number = int(text)
    if not 1 <= number <= 1000:
        raise argparse.ArgumentTypeError(f"{text} is not within 1 to 1000")
    return number


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        prog="bench", description="Measure the gateway beside C and beside the obvious program."
    )
    made.add_argument("--only", nargs="+", action="extend", metavar="NAME", help="these alone; as 'cpu*' too")
    made.add_argument("--list", action="store_true", help="list the benchmarks and end")
    made.add_argument(
        "--seconds", type=seconds, default=5.0, metavar="N", help="length of one measurement (default: 5)"
    )
    made.add_argument("--rounds", type=rounds, default=3, metavar="N", help="turns of what is compared (default: 3)")
    made.add_argument("--long", action="store_true", help="files of up to 100 MB too, which takes minutes")
    made.add_argument("--quick", action="store_true", help="as short as it can be: tries the benchmarks themselves")
    made.add_argument("--json", type=Path, default=registry.ROOT / "build" / "bench.json", metavar="FILE")
    made.add_argument(
        "--realtime", type=int, default=0, choices=range(1, 100), metavar="1..99", help="real-time priority to measure"
    )
    made.add_argument("--vcan", default="", metavar="NAME", help="a vcan interface in place of the local socket")
    return made


def main(arguments: list[str] | None = None) -> int:
    args = parser().parse_args(arguments)
    known = registry.benchmarks()
    if args.list:
        width = max(len(each.name) for each in known) if known else 0
        for each in known:
            print(f"{each.name:{width}}  {each.help}")
        return 0
    chosen = [each for each in known if not args.only or any(fnmatch.fnmatch(each.name, one) for one in args.only)]
    for one in args.only or ():
        if not any(fnmatch.fnmatch(each.name, one) for each in known):
            print(f"bench: there is no benchmark {one}. See --list.", file=sys.stderr)
            return 2
    lasts, turns = (min(args.seconds, 0.5), 1) if args.quick else (args.seconds, args.rounds)
    folder = registry.ROOT / "build" / "bench"
    folder.mkdir(parents=True, exist_ok=True)
    try:
        if not args.json.parent.is_dir():
            raise NotADirectoryError(2, "there is no such folder")
        args.json.open("a").close()  # before half an hour of measuring, not behind it
    except OSError as error:
        print(f"bench: {error.filename or args.json.parent}: {error.strerror}", file=sys.stderr)
        return 2
    results, interrupted = [], False
    try:
        for each in chosen:
            context = Context(folder, lasts, turns, args.quick, args.realtime, args.vcan, args.long)
            results.append(run_one(each, context))
    except KeyboardInterrupt:
        interrupted = True
        print("bench: ended by hand; what is done is written", file=sys.stderr)
    args.json.write_text(json.dumps(document(args, results), indent=1, allow_nan=False) + "\n")
    print(table(results))
    print(f"JSON: {args.json}", file=sys.stderr)
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
        context.say(f"left out: {left_out}")
    except NotEqual as reason:
        error = f"not equal: {reason}"
        context.say(error)
    except Exception as reason:  # one that fails must not end the others
        error = f"failed: {type(reason).__name__}: {reason}"
        traceback.print_exc()
    return {
        "name": benchmark.name,
        "help": benchmark.help,
        "figures": [asdict(figure) for figure in figures],
        "left_out": left_out,
        "error": error,
        "took_s": round(time.monotonic() - begun, 2),
        "data": context.data,
    }


def document(args: argparse.Namespace, results: list[dict[str, Any]]) -> dict[str, Any]:
    """What goes into the JSON file."""
    return {
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "kernel": platform.release(),
        "python": platform.python_version(),
        "seconds": args.seconds,
        "rounds": args.rounds,
        "quick": args.quick,
        "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "benchmarks": results,
    }


def number(value: float) -> str:
    """As people read it: 4 figures, no exponent below a thousand million."""
    if value == int(value) and abs(value) < 1e15:
        return f"{int(value):,}".replace(",", " ")
    if abs(value) >= 1000:
        return f"{value:,.0f}".replace(",", " ")
    return f"{value:.4g}"


def table(results: list[dict[str, Any]]) -> str:
    """Figure, value, target, reached or not."""
    rows = [("", "value", "unit", "target", "", "")]
    for result in results:
        rows.append((f"{result['name']}", "", "", "", "", ""))
        for figure in result["figures"]:
            verdict = {True: "reached", False: "MISSED", None: ""}[figure["reached"]]
            if verdict == "MISSED" and (short := shortfall(figure["value"], figure["target"])):
                verdict = f"MISSED by {short}"
            rows.append(
                (
                    f"  {figure['name']}",
                    number(figure["value"]),
                    figure["unit"],
                    figure["target"],
                    verdict,
                    figure["note"],
                )
            )
        for word in ("left_out", "error"):
            if result[word]:
                rows.append((f"  {word.replace('_', ' ')}: {result[word]}", "", "", "", "", ""))
    alone = [row for row in rows if any(row[1:])]
    widths = [max((len(row[i]) for row in alone), default=0) for i in range(6)]
    lines = []
    for row in rows:
        cells = [
            f"{cell:>{width}}" if i == 1 else f"{cell:{width}}"
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    missed = sum(figure["reached"] is False for result in results for figure in result["figures"])
    reached = sum(figure["reached"] is True for result in results for figure in result["figures"])
    left_out = sum(bool(result["left_out"]) for result in results)
    failed = sum(bool(result["error"]) for result in results)
    lines.append("")
    lines.append(f"targets: {reached} reached, {missed} missed; {left_out} left out, {failed} failed")
    return "\n".join(lines)


def shortfall(value: float, target: str) -> str:
    """How far a value is from a target such as "<= 2.2", in per cent of it; empty where it is not, or the target is other text."""
    sign, _, rest = target.partition(" ")
    try:
        limit = float(rest.split(" ")[0])
    except ValueError:
        return ""
    too_much = {"<=": value - limit, "<": value - limit, ">=": limit - value, ">": limit - value}.get(sign, 0)
    return f"{too_much / abs(limit):.0%}" if limit and too_much > 0 else ""


if __name__ == "__main__":
    sys.exit(main())
