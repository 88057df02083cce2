"""The fault programme seen from outside of its virtual machine: starts it, and decides which of its rows can be judged.

Processor time that the virtual machine wants and does not get is taken by the host of this machine ("steal" in /proc/stat) or by other
work on it (run queue, /proc/PID/schedstat); nobody inside can see that. Both are sampled while each fault runs. A fault that was late or
lost values while much was taken is not judged. Nothing is run twice.
"""

import argparse
import contextlib
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, Self

from fault_report import FAILED, NOT_JUDGED, Fault, Report, line

PROJECT = Path(__file__).resolve().parents[2]
BEGIN, END = ">>>", "<<<"
"""What the programme prints in there, followed by area and name, around each fault."""
WINDOW_S = 1.0
"""A tenth of it is what the shortest limits of the programme leave to a gateway."""


class Sample(NamedTuple):
    at_s: float
    stolen: int
    total: int
    waited_s: float = 0.0
    """For a processor, by all that belongs to the virtual machine."""

    def share(self, since: "Sample") -> float:
        """What was taken since an earlier one."""
        ticks, seconds = self.total - since.total, self.at_s - since.at_s
        stolen = (self.stolen - since.stolen) / ticks if ticks else 0.0
        return stolen + ((self.waited_s - since.waited_s) / seconds if seconds else 0.0)


def sample(text: str, at_s: float, waited_s: float = 0.0) -> Sample:
    """Of the first line of /proc/stat: user, nice, system, idle, iowait, irq, softirq, load."""
    ticks = [int(word) for word in text.split("\n", 1)[0].split()[1:9]]
    return Sample(at_s, ticks[7], sum(ticks), waited_s)


def worst_share(samples: Sequence[Sample], begin_s: float, end_s: float) -> float:
    """The largest share that was taken away over ``WINDOW_S``, or over the whole time if that is shorter."""
    before = [each for each in samples if each.at_s <= begin_s][-1:]
    inside = before + [each for each in samples if begin_s < each.at_s <= end_s]
    worst = 0.0
    first = 0
    for last in range(1, len(inside)):
        while inside[last].at_s - inside[first + 1].at_s >= WINDOW_S:
            first += 1
        if inside[last].at_s - inside[first].at_s < min(
            WINDOW_S, 0.9 * (inside[-1].at_s - inside[0].at_s)
        ):
            continue
        worst = max(worst, inside[last].share(inside[first]))
    return worst


class Load:
    """Samples in a thread."""

    def __init__(self) -> None:
        self.samples: list[Sample] = []
        self.machine: int | None = None
        """The process that has started the virtual machine, in a session of its own."""
        self.waits: dict[str, int] = {}
        """What each thread of it has waited so far, in ns."""
        self._waited_ns = 0
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def take(self) -> None:
        with self._lock:
            self._add_waits()
            waited_s = self._waited_ns / 1e9
            self.samples.append(sample(Path("/proc/stat").read_text(), time.monotonic(), waited_s))

    def _add_waits(self) -> None:
        """What each thread of the virtual machine has waited since the last time; its processes come and go."""
        sessions: dict[str, list[Path]] = {}
        mine: list[str] = []  # it starts another one that watches over it
        for stat in Path("/proc").glob("[0-9]*/stat") if self.machine else ():
            with contextlib.suppress(OSError):
                _, parent, _, session, *_ = (
                    stat.read_text(errors="replace").rpartition(")")[2].split()
                )
                sessions.setdefault(session, []).append(stat.parent)
                if parent == str(self.machine):
                    mine.append(session)
        for process in (each for session in mine for each in sessions[session]):
            with contextlib.suppress(OSError, IndexError):
                # it may end meanwhile, even while its threads are listed
                for file in process.glob("task/*/schedstat"):
                    waited = int(file.read_text().split()[1])
                    self._waited_ns += waited - self.waits.get(str(file), 0)
                    self.waits[str(file)] = waited

    def _run(self) -> None:
        while not self._stop.wait(0.5):
            self.take()

    def __enter__(self) -> Self:
        self.take()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()


def run_inside(
    load: Load,
    script: str,
    words: Sequence[str],
    backend: str,
    timeout_s: float,
    prepare: Callable[[Path], None],
) -> Report:
    """Run a script of this folder in a virtual machine; its rows, with what was taken from us meanwhile."""
    shares: dict[str, float] = {}
    begun: dict[str, float] = {}

    def ended(name: str) -> None:
        load.take()
        shares[name] = max(
            shares.get(name, 0.0), worst_share(load.samples, begun.pop(name), time.monotonic())
        )

    with tempfile.TemporaryDirectory(prefix="kcg-faults.") as folder:
        prepare(Path(folder))
        machine = [sys.executable, str(PROJECT / "tests" / "vm" / "vm_run.py")]
        machine += [f"--backend={backend}", f"--timeout={timeout_s:g}", f"--rw={folder}", "--"]
        inside = [
            sys.executable,
            "-B",
            str(Path(__file__).with_name(script)),
            f"--inside={folder}",
            *words,
        ]
        pipe = subprocess.PIPE
        with subprocess.Popen(
            [*machine, *inside], stdin=subprocess.DEVNULL, stdout=pipe, text=True
        ) as process:
            assert process.stdout
            load.machine = process.pid
            for text in process.stdout:
                mark, _, name = text.rstrip().partition(" ")
                if mark == BEGIN:
                    begun[name] = time.monotonic()
                elif mark == END:
                    ended(name)
                else:
                    print(text, end="", flush=True)
        for name in list(begun):
            ended(name)
        file = Path(folder, "report.json")
        report = Report.read([file] if file.exists() else [])
        report.about["exit code"] = process.returncode
    for row in report.rows:
        row.taken = shares.get(str(row), 0.0)
    return report


def conclude(report: Report, out: Path | None, junit: Path | None) -> int:
    """Write it down, and say in the end what failed and what was not judged."""
    for path, write in ((out, report.write), (junit, report.write_junit)):
        if path is not None:
            write(path)
    states = [row.state for row in report.rows]
    for state in (NOT_JUDGED, FAILED):
        for row in report.rows:
            if row.state == state:
                print(line(row))
    counts = ", ".join(f"{states.count(state)} {state}" for state in sorted(set(states)))
    print(f"{len(states)} faults: {counts}", flush=True)
    return int(FAILED in states or not states)


def parser(doc: str | None) -> argparse.ArgumentParser:
    """The options that all parts of the programme have."""
    made = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    made.add_argument("--out", type=Path, help="what came of it, as JSON")
    made.add_argument("--junit", type=Path, help="the same as a JUnit report")
    made.add_argument("--long", action="store_true", help="each fault more often, and longer")
    made.add_argument(
        "--only", action="append", default=[], help="faults whose area or name holds this text"
    )
    made.add_argument("--inside", type=Path, help=argparse.SUPPRESS)
    return made


def chosen(faults: Sequence[Fault], only: Sequence[str]) -> list[Fault]:
    return [each for each in faults if not only or any(text in str(each) for text in only)]


def main(
    args: argparse.Namespace,
    script: str,
    faults: Sequence[Fault],
    *,
    backend: str = "uml",
    timeout_s: float,
    words: Sequence[str] = (),
    prepare: Callable[[Path], None] = lambda _folder: None,
) -> int:
    """Run these faults by a script of this folder in a virtual machine; what came of them."""
    options = [*words, *(["--long"] if args.long else [])]
    options += [f"--only={text}" for text in args.only]
    with Load() as load:
        report = run_inside(load, script, options, backend, timeout_s, prepare)
    for fault in faults:
        report.row(fault)  # one that was not reached has failed
    return conclude(report, args.out, args.junit)
