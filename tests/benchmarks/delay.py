"""The delay from a live frame's last byte to the last of its five CAN frames: beside C, with everything switched on, under load."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator

from live import CANOPEN, compare, losses
from programs import Measured, end, median, once, start
from registry import Context, Figure, LeftOut, benchmark, judged

_PRIORITY = 60
RIGHT_LINE = "sudo prlimit --rtprio=99 --pid $$"


def of_runs(runs: list[Measured], key: str) -> float:
    """A figure of the delay, the median of the rounds."""
    return median([run.delay[key] for run in runs])


@benchmark("delay", "from the last byte to the fifth CAN frame: C, ours, the obvious program")
def delay(context: Context) -> list[Figure]:
    """One ESC, the three programs by turns."""
    found = compare(context, 1)
    figures = []
    for program, runs in found.items():
        note = f"99 %: {of_runs(runs, 'p99'):.0f}, longest {of_runs(runs, 'max'):.0f}"
        figures.append(Figure(f"{program}, median", of_runs(runs, "p50"), "us", note=note))
    value = median(
        [a.delay["p50"] / b.delay["p50"] for a, b in zip(found["ours"], found["c"], strict=True)]
    )
    figures.append(judged("ours / c, median", value, "x", "<= 1.1"))
    figures.append(judged("ours, 99 %", of_runs(found["ours"], "p99"), "us", "<= 2000"))
    return figures


EVERYTHING = f"""{CANOPEN}[record]
directory = "captures"
[statistics]
file = "status.json"
"""
"""Recorder, status file, nodes."""


@benchmark("delay-full", "the same with 8 ESCs, recorder, statistics, CANopen and a polling master")
def full(context: Context) -> list[Figure]:
    """8 ESCs with recorder, status file, CANopen nodes and a master that asks 200 times a second for one of 20 objects."""
    runs = [once(context, "ours", 8, "--sdo", config=EVERYTHING) for _ in range(context.rounds)]
    context.data["runs"] = [run.result for run in runs]
    asked = sum(run.result["sdo_sent"] for run in runs)
    answered = sum(run.result["sdo_answers"] for run in runs)
    lost = max(0, asked - answered - len(runs))  # the last of each run may be on its way
    answer = median([run.result["sdo_us"]["p99"] for run in runs])
    if not answered:
        raise RuntimeError("the nodes answered no SDO request")
    longest = f"longest {of_runs(runs, 'max'):.0f}"
    return [
        Figure("8 ESCs and all, median", of_runs(runs, "p50"), "us"),
        judged("8 ESCs and all, 99 %", of_runs(runs, "p99"), "us", "<= 1000", longest),
        Figure("SDO answers, 99 %", answer, "us"),
        Figure("SDO requests not answered", lost, f"of {asked}", "0", lost == 0),
        Figure(
            "CPU, all of it", median([run.cpu_us for run in runs]), "us/frame", note=losses(runs)
        ),
    ]


@contextlib.contextmanager
def burners() -> Iterator[None]:
    """Two programs a core that do nothing but work."""
    children: list[subprocess.Popen[str]] = []
    try:
        for _ in range(2 * len(os.sched_getaffinity(0))):
            children.append(start([sys.executable, "-c", "while True: pass"]))
        yield
    finally:
        for child in children:
            child.kill()
            end(child)


def may_have_priority(priority: int) -> bool:
    """Whether a child of ours may have it."""
    attempt = f"import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param({priority}))"
    return (
        subprocess.run([sys.executable, "-c", attempt], stderr=subprocess.DEVNULL).returncode == 0
    )


@benchmark("delay-realtime", "the same with real-time priority while other programs load all cores")
def realtime(context: Context) -> list[Figure]:
    """With and without real-time priority while other programs load all cores."""
    if not may_have_priority(_PRIORITY):
        raise LeftOut(f"no right to real-time priority; for this shell:  {RIGHT_LINE}")
    normal, preferred = [], []
    with burners():
        for _ in range(context.rounds):
            normal.append(once(context, "ours", 8))
            preferred.append(
                once(context, "ours", 8, config=f"[run]\nrealtime_priority = {_PRIORITY}\n")
            )
    context.data["runs"] = {
        "normal": [run.result for run in normal],
        "real-time": [run.result for run in preferred],
    }
    longest = f"longest {of_runs(preferred, 'max'):.0f}"
    return [
        Figure("loaded, normal priority, 99 %", of_runs(normal, "p99"), "us"),
        judged(
            "loaded, real-time priority, 99 %", of_runs(preferred, "p99"), "us", "<= 500", longest
        ),
    ]
