"""How much one process takes: many ESCs, and two buses' worth of frames on one core, none lost."""

import os
import sys

from bench_programs import Measured, once
from registry import Benchmark, Context, Figure


def pinned(command: list[str]) -> list[str]:
    """The command on one core; the last, where the feeder need not be."""
    core = max(os.sched_getaffinity(0))
    text = f"import os, sys; os.sched_setaffinity(0, [{core}]); os.execv(sys.argv[1], sys.argv[1:])"
    return [sys.executable, "-c", text, *command]


def figures_of(what: str, run: Measured) -> list[Figure]:
    lost = run.lost
    return [
        Figure(f"{what}: CAN frames lost", lost, f"of {5 * run.sent}", "0", lost == 0, note=lateness(run)),
        Figure(f"{what}: share of a core", run.cpu_share * 100, "%"),
        Figure(f"{what}: CPU", run.cpu_us, "us/frame"),
        Figure(f"{what}: delay, 99 %", run.delay["p99"], "us"),
    ]


def lateness(run: Measured) -> str:
    """A frame that is replaced by the next one, because the process had to wait, counts as lost."""
    longest = run.delay["max"] / 1000
    return f"longest delay {longest:.0f} ms: two frames of an ESC were read at once" if run.lost and longest > 9 else ""


def many(context: Context) -> list[Figure]:
    """128 ESCs at 100 Hz in one process."""
    escs = 4 if context.quick else 128
    return figures_of(f"{escs} ESCs", once(context, "ours", escs))


def two_buses(context: Context) -> list[Figure]:
    """30 ESCs are 15 000 CAN frames a second."""
    escs = 2 if context.quick else 30
    return figures_of(f"{escs * 500} frames/s on one core", once(context, "ours", escs, wrap=pinned))


BENCHMARKS = [
    Benchmark("many", "128 ESCs at 100 Hz in one process, none lost", many),
    Benchmark("two-buses", "15 000 CAN frames a second on one core, none lost", two_buses),
]
