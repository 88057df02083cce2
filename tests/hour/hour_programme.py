"""An hour of telemetry through every command that reads recordings, and each result read back by libraries that are not ours.

    python tests/hour/hour_programme.py [--minutes 60] [--escs 1] [--folder DIR]

Makes a capture of so many minutes without waiting (hour_recording.py), converts, decodes and reports it by the real commands as
processes of their own, converts the CAN logs back, reads every file by pandas, pyarrow, python-can and cantools (hour_check.py),
and compares every value of every row with what the simulated ESCs meant (hour_truth.py). Prints a table of times and peak memory.
Exits with 1 and the first differences where anything is not equal.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    tests = Path(__file__).resolve().parents[1]
    sys.path[:0] = [str(tests.parent), str(tests), str(tests / "capture")]

# A process's peak memory counts that of the process it was started from: so commands are started by a small one.
_MEASURE = """
import json, os, subprocess, sys, time
begun = time.monotonic()
child = subprocess.Popen(sys.argv[2:], stdin=subprocess.DEVNULL, stdout=open(sys.argv[1], "wb"))
_, status, used = os.wait4(child.pid, 0)
child.returncode = os.waitstatus_to_exitcode(status)
took = time.monotonic() - begun
print(json.dumps([child.returncode, took, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024]))
"""


@dataclass
class Result:
    """A line of the table."""

    name: str
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    rows: int = 0
    peak_mb: float = 0.0
    size_mb: float = 0.0
    read_by: str = ""
    values: int = 0
    differences: int = 0


@dataclass
class Step:
    """A command, the file that it makes, and what is compared. ``check`` gives a Verdict."""

    name: str
    arguments: list[str]
    output: Path
    read_by: str
    check: partial[Any]
    to_output: bool = False
    """What it prints is the result."""


def measured(arguments: list[str], output: Path) -> tuple[float, float, float]:
    """Wall seconds, CPU seconds and peak memory in MB of a command, whose output goes to a file. RuntimeError where it failed."""
    command = [
        sys.executable,
        "-c",
        _MEASURE,
        str(output),
        sys.executable,
        "-m",
        "kontronik_can_gw",
    ]
    done = subprocess.run([*command, *arguments], capture_output=True, text=True, check=True)
    code, *found = json.loads(done.stdout)
    if code:
        raise RuntimeError(f"exit code {code}: {done.stderr.strip()}")
    seconds, cpu, peak = found
    return seconds, cpu, peak


def steps_of(folder: Path, truth: Any) -> list[Step]:
    """All that is done with the capture."""
    import hour_check as check

    capture = str(truth.recording.path)
    one_esc = len(truth.escs) == 1
    decoded = check.Decoded(truth)
    frames: dict[str, check.Frames] = {}
    by_can = "python-can, cantools"
    steps: list[Step] = []

    def step(
        name: str,
        words: list[str],
        output: str,
        read_by: str,
        compare: Callable[..., Any],
        *of: Any,
    ) -> None:
        """A command whose words have OUT for the file that it makes; one without it prints what is to be there."""
        path = folder / output
        arguments = [str(path) if word == "OUT" else word for word in words]
        check_it = partial(compare, *of, path)
        steps.append(Step(name, arguments, path, read_by, check_it, "OUT" not in words))

    def compare_log(path: Path) -> Any:
        verdict, found = check.check_log(path, truth, decoded)
        frames.setdefault(path.suffix, found)
        return verdict

    def compare_table_of_log(form: str, path: Path) -> Any:
        return check.check_table_of_log(path, truth, frames[f".{form}"], decoded)

    convert = ["convert", capture, "OUT"]
    for form, library in check.TABLES.items():
        step(f"convert to {form}", convert, f"hour.{form}", library, check.check_table, truth)
    for form in check.LOGS:
        step(f"convert to {form}", convert, f"hour.{form}", by_can, compare_log)
    for form in check.LOGS if one_esc else ():
        words = ["convert", str(folder / f"hour.{form}"), "OUT"]
        compare = f"pandas against {by_can}", compare_table_of_log, form
        step(f"convert {form} to csv", words, f"of_{form}.csv", *compare)
    for index in range(len(truth.escs)):
        name = f"esc{index + 1}"
        words = convert if one_esc else [*convert, "--esc", name]
        step("convert to bin", words, f"{name}.bin", "numpy", check.check_bytes, truth, index)
        words = ["decode", str(folder / f"{name}.bin")]
        compare_decoded = check.check_decoded, truth, index
        step("decode the bin", words, f"{name}.decoded.jsonl", "json", *compare_decoded)
    words = ["report", capture, "-o", "OUT"]
    step("report", words, "hour.html", "its text", check.check_report, truth)
    words = ["monitor", capture, "--once"]
    of_last = "json against cantools", check.check_last, truth, decoded
    step("monitor --once", words, "last.json", *of_last)
    return steps


def run(steps: list[Step], folder: Path, say: Callable[[str], None] = print) -> list[Result]:
    """Run all commands in their order, and compare each result."""
    results = []
    for step in steps:
        result = Result(step.name, read_by=step.read_by)
        output = step.output if step.to_output else folder / "output.txt"
        result.seconds, result.cpu_seconds, result.peak_mb = measured(step.arguments, output)
        result.size_mb = step.output.stat().st_size / 1e6
        verdict = step.check()
        result.rows, result.values = verdict.rows, verdict.values
        result.differences = verdict.differences + (not verdict.values)
        say(f"{step.name}: {result.values} values compared, {result.differences} differ")
        for line in verdict.problems:
            say(f"    {line}")
        results.append(result)
    return results


def table(results: list[Result]) -> str:
    """The results as a Markdown table."""
    heads = ("seconds", "CPU s", "rows/CPU s", "peak MB", "size MB", "values compared")
    lines = [f"| | {' | '.join(heads)} | read back by |", "|---" + "|---:" * 6 + "|---|"]
    for one in results:
        rate = f"{one.rows / one.cpu_seconds:,.0f}".replace(",", " ") if one.rows > 10 else ""
        differ = f" ({one.differences} differ)" if one.differences else ""
        values = f"{one.values:,}".replace(",", " ") + differ
        numbers = f"{one.seconds:.1f} | {one.cpu_seconds:.1f} | {rate} | {one.peak_mb:.0f}"
        lines.append(f"| {one.name} | {numbers} | {one.size_mb:.1f} | {values} | {one.read_by} |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--escs", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="a new one, in which the files are kept")
    args = parser.parse_args()
    if not 0.5 <= args.minutes <= 600 or not 1 <= args.escs <= 8:
        parser.error("--minutes 0.5 to 600, --escs 1 to 8")
    from hour_recording import record
    from hour_truth import Truth

    folder = args.folder or Path(tempfile.mkdtemp(prefix="hour."))
    if args.folder:
        folder.mkdir(parents=True)
    try:
        begun = time.monotonic()
        seconds = args.minutes * 60
        truth = Truth(record(folder / "hour.kcap", seconds, args.escs))
        size = (folder / "hour.kcap").stat().st_size / 1e6
        head = (
            f"{args.minutes:g} minutes of {args.escs} ESC: {truth.recording.telemetry_frames} telemetry frames, {len(truth.row_ns)} rows, "
            f"{len(truth.sent_ns)} CAN frames; capture of {size:.1f} MB, made in {time.monotonic() - begun:.0f} s"
        )
        print(head, flush=True)
        results = run(steps_of(folder, truth), folder, lambda text: print(text, flush=True))
    finally:
        if args.folder is None:
            shutil.rmtree(folder, ignore_errors=True)
    print(f"\n{head}\n\n{table(results)}")
    bad = [one.name for one in results if one.differences]
    print(
        f"\n{sum(one.values for one in results)} values compared, "
        + (f"not equal: {', '.join(bad)}" if bad else "all equal")
    )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
