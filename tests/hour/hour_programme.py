"""An hour of telemetry through every command that reads recordings, and each result read back by libraries that are not ours.

    python tests/hour/hour_programme.py [--minutes 60] [--escs 1] [--folder DIR] [--json FILE]

Makes a capture of so many minutes without waiting (hour_recording.py), converts, replays, decodes and reports it by the real commands as
processes of their own, converts the CAN logs back, reads every file by pandas, pyarrow, asammdf, python-can and cantools (hour_check.py),
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
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

# A process's peak memory counts that of the process it was started from: so commands are started by a small one.
_RUNNER = """
import json, os, subprocess, sys, time
for line in sys.stdin:
    command, out, err = json.loads(line)
    with open(out, "wb") as output, open(err, "wb") as errors:
        begun = time.monotonic()
        child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=errors)
        _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
    took = time.monotonic() - begun
    print(json.dumps([child.returncode, took, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024]), flush=True)
"""


@dataclass
class Result:
    """A line of the table."""

    name: str
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    rows: int = 0
    peak_mb: float = 0.0
    peak_mb_of_a_tenth: float | None = None
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
    check: Callable[[], Any]
    tenth: list[str] | None = None
    """The same of the first tenth."""
    to_output: bool = False
    """What it prints is the result."""


class Runner:
    """Runs commands one behind the other, beside this process."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._process = subprocess.Popen(
            [sys.executable, "-c", _RUNNER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def submit(self, arguments: list[str], output: Path) -> None:
        """Run ``kontronik-can-gw`` with these arguments when the ones before are done."""
        assert self._process.stdin is not None
        command = [sys.executable, "-m", "kontronik_can_gw", *arguments]
        self._process.stdin.write(json.dumps([command, str(output), str(self._folder / "errors.txt")]) + "\n")
        self._process.stdin.flush()

    def result(self) -> tuple[float, float, float]:
        """Wall seconds, CPU seconds, peak memory in MB of the next command. RuntimeError where it failed."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError("the runner has ended")
        code, seconds, cpu, peak = json.loads(line)
        if code:
            raise RuntimeError(f"exit code {code}: {(self._folder / 'errors.txt').read_text().strip()}")
        return seconds, cpu, peak

    def close(self) -> None:
        """End it."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(60)


def steps_of(folder: Path, truth: Any, seconds: float) -> list[Step]:
    """All that is done with the capture."""
    import hour_check as check

    capture = truth.recording.path
    one_esc = len(truth.escs) == 1
    decoded = check.Decoded(truth)
    frames: dict[str, check.Frames] = {}
    steps = []

    def log_step(name: str, arguments: list[str], path: Path, tenth: list[str] | None) -> Step:
        def compare() -> check.Verdict:
            verdict, frames[path.suffix] = check.check_log(path, truth, decoded)
            return verdict

        return Step(name, arguments, path, "python-can, cantools", compare, tenth)

    for form in check.TABLES:
        path = folder / f"hour.{form}"
        library, chunks = check.TABLE_READERS[form]
        steps.append(
            Step(
                f"convert to {form}",
                ["convert", str(capture), str(path)],
                path,
                library,
                lambda path=path, chunks=chunks: check.check_table(path, truth, chunks(path, truth)),  # type: ignore[misc]
                ["convert", str(capture), str(folder / f"tenth.{form}"), "--until", f"{seconds / 10:.3f}"],
            )
        )
        if form == "parquet":
            steps[-1].read_by = "pyarrow; pandas"
            steps[-1].check = lambda path=path: _both(  # type: ignore[misc]
                check.check_table(path, truth, check.parquet_chunks(path, truth)),
                check.check_table(path, truth, check.pandas_parquet_chunks(path, truth)),
            )
    for form in check.LOGS:
        path = folder / f"hour.{form}"
        tenth = ["convert", str(capture), str(folder / f"tenth.{form}"), "--until", f"{seconds / 10:.3f}"]
        steps.append(log_step(f"convert to {form}", ["convert", str(capture), str(path)], path, tenth))
    if one_esc:
        for form in check.LOGS:
            path = folder / f"of_{form}.csv"
            steps.append(
                Step(
                    f"convert {form} to csv",
                    ["convert", str(folder / f"hour.{form}"), str(path)],
                    path,
                    "pandas against python-can, cantools",
                    lambda path=path, form=form: check.check_table_of_log(path, truth, frames[f".{form}"], decoded),  # type: ignore[misc]
                )
            )
    replayed = folder / "replayed.log"
    steps.append(
        log_step("replay to log", ["replay", str(capture), "--to", "log", "-o", str(replayed)], replayed, None)
    )
    for index in range(len(truth.escs)):
        path = folder / f"esc{index + 1}.bin"
        more = [] if one_esc else ["--esc", f"esc{index + 1}"]
        steps.append(
            Step(
                "convert to bin",
                ["convert", str(capture), str(path), *more],
                path,
                "numpy",
                lambda path=path, index=index: check.check_bytes(path, truth, index),  # type: ignore[misc]
            )
        )
        lines = folder / f"esc{index + 1}.decoded.jsonl"
        steps.append(
            Step(
                "decode the bin",
                ["decode", str(path)],
                lines,
                "json",
                lambda lines=lines, index=index: check.check_decoded(lines, truth, index),  # type: ignore[misc]
                to_output=True,
            )
        )
    page, last = folder / "hour.html", folder / "last.json"
    steps += [
        Step(
            "report",
            ["report", str(capture), "-o", str(page)],
            page,
            "its text",
            lambda: check.check_report(page, truth),
        ),
        Step(
            "monitor --once",
            ["monitor", str(capture), "--once"],
            last,
            "json against cantools",
            lambda: check.check_last(last.read_text(encoding="utf-8"), truth, decoded),
            to_output=True,
        ),
    ]
    return steps


def _both(first: Any, second: Any) -> Any:
    first.values += second.values
    first.differences += second.differences
    first.problems += second.problems
    return first


def run(steps: list[Step], folder: Path, say: Callable[[str], None] = print) -> list[Result]:
    """Run all commands in their order, and compare each result while the next one runs."""
    runner = Runner(folder)
    results = []
    try:
        for step in steps:
            runner.submit(step.arguments, step.output if step.to_output else folder / "output.txt")
            if step.tenth is not None:
                runner.submit(step.tenth, folder / "output.txt")
        for step in steps:
            result = Result(step.name, read_by=step.read_by)
            result.seconds, result.cpu_seconds, result.peak_mb = runner.result()
            if step.tenth is not None:
                result.peak_mb_of_a_tenth = runner.result()[2]
            result.size_mb = step.output.stat().st_size / 1e6
            verdict = step.check()
            result.rows, result.values = verdict.rows, verdict.values
            result.differences = verdict.differences + (not verdict.values)
            say(f"{step.name}: {result.values} values compared, {result.differences} differ")
            for line in verdict.problems:
                say(f"    {line}")
            results.append(result)
    finally:
        runner.close()
    return results


def table(results: list[Result]) -> str:
    """The results as a Markdown table."""
    heads = (
        "",
        "seconds",
        "CPU s",
        "rows/CPU s",
        "peak MB",
        "of a tenth",
        "size MB",
        "values compared",
        "read back by",
    )
    lines = ["| " + " | ".join(heads) + " |", "|---" + "|---:" * 7 + "|---|"]
    for one in results:
        tenth = "" if one.peak_mb_of_a_tenth is None else f"{one.peak_mb_of_a_tenth:.0f}"
        rate = f"{one.rows / one.cpu_seconds:,.0f}".replace(",", " ") if one.rows > 10 else ""
        values = f"{one.values:,}".replace(",", " ") + (f" ({one.differences} differ)" if one.differences else "")
        cells = (
            *(one.name, f"{one.seconds:.1f}", f"{one.cpu_seconds:.1f}", rate, f"{one.peak_mb:.0f}", tenth),
            *(f"{one.size_mb:.1f}", values, one.read_by),
        )
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--escs", type=int, default=1)
    parser.add_argument(
        "--folder", type=Path, help="keep the files there (default: a temporary folder that is removed)"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results there too")
    args = parser.parse_args()
    if not 0.5 <= args.minutes <= 600 or not 1 <= args.escs <= 8:
        parser.error("--minutes 0.5 to 600, --escs 1 to 8")
    from hour_recording import record
    from hour_truth import Truth

    folder = args.folder or Path(tempfile.mkdtemp(prefix="hour."))
    folder.mkdir(parents=True, exist_ok=True)
    for old in (
        *folder.glob("hour.*"),
        *folder.glob("tenth.*"),
        *folder.glob("of_*"),
        *folder.glob("*.bin"),
        *folder.glob("*.log"),
    ):
        old.unlink(missing_ok=True)
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
        results = run(steps_of(folder, truth, seconds), folder, lambda text: print(text, flush=True))
    finally:
        if args.folder is None:
            shutil.rmtree(folder, ignore_errors=True)
    print(f"\n{head}\n\n{table(results)}")
    if args.json is not None:
        args.json.write_text(json.dumps({"head": head, "results": [asdict(one) for one in results]}, indent=1) + "\n")
    bad = [one.name for one in results if one.differences]
    print(
        f"\n{sum(one.values for one in results)} values compared, "
        + (f"not equal: {', '.join(bad)}" if bad else "all equal")
    )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
