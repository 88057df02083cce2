"""The three programs by turns: the CPU time each takes for a live frame, and the delay."""

import os
import sys

from programs import CANOPEN, EVERYTHING, PROGRAMS, Measured, median, once
from registry import Context, Figure, LeftOut, benchmark

# --- CPU time


def compare(context: Context, escs: int) -> dict[str, list[Measured]]:
    """Rounds of the three programs by turns, so that what disturbs the machine disturbs all."""
    found: dict[str, list[Measured]] = {program: [] for program in PROGRAMS}
    for _ in range(context.rounds):
        for program, runs in found.items():
            runs.append(once(context, program, escs))
    return found


def cpu_of(runs: list[Measured]) -> float:
    """Median of the rounds."""
    if not all(run.cpu_us for run in runs):
        raise LeftOut("this kernel counts CPU time by ticks, too coarse to compare")
    return median([run.cpu_us for run in runs])


def lost_share(runs: list[Measured]) -> float:
    return median([run.lost_share for run in runs])


def losses(runs: list[Measured]) -> str:
    """In words, where they are worth a word."""
    return f"{lost_share(runs):.1%} of its CAN frames lost" if lost_share(runs) >= 0.001 else ""


def ratio(above: list[Measured], below: list[Measured]) -> float:
    """Median of the ratios of the rounds."""
    return median([a.cpu_us / b.cpu_us for a, b in zip(above, below, strict=True)])


def beside(context: Context, escs: int, most: str, least: str) -> list[Figure]:
    """The three programs, and ours beside the two others. What is not sent costs nothing: with losses no target is reached."""
    found = compare(context, escs)
    ours, fair = found["ours"], lost_share(found["ours"]) < 0.01
    return [
        *(
            Figure(f"{program}, {escs} ESC", cpu_of(runs), "us/frame", note=losses(runs))
            for program, runs in found.items()
        ),
        Figure(f"ours / c, {escs} ESC", ratio(ours, found["c"]), "x", most, fair=fair),
        Figure(f"obvious / ours, {escs} ESC", ratio(found["obvious"], ours), "x", least, fair=fair),
    ]


@benchmark("cpu", "CPU time a live frame at 1, 8 and 64 ESCs: C, ours, the obvious program")
def cpu(context: Context) -> list[Figure]:
    """The table of the three programs."""
    figures = beside(context, 1, "<= 1.35", ">= 6")
    if context.quick:
        return figures
    return figures + beside(context, 8, "<= 1.25", ">= 6") + beside(context, 64, "<= 1.2", "")


@benchmark("cpu-canopen", "CPU time with CANopen nodes and default PDOs, beside that without")
def canopen(context: Context) -> list[Figure]:
    """Ours at 8 ESCs with nodes and default PDOs, and without, by turns."""
    plain, both = [], []
    for _ in range(context.rounds):
        plain.append(once(context, "ours", 8))
        both.append(once(context, "ours", 8, config=CANOPEN))
    frames = median([run.result["others"] / run.sent for run in both])
    if not frames:
        raise RuntimeError("the CANopen nodes sent nothing")
    return [
        Figure(
            "ours, 8 ESC, CANopen too",
            cpu_of(both),
            "us/frame",
            note=f"{frames:.1f} CANopen frames each",
        ),
        Figure("with / without CANopen", ratio(both, plain), "x", "<= 1.25"),
    ]


def pinned(command: list[str]) -> list[str]:
    """The command on one core; the last, where the feeder need not be."""
    core = max(os.sched_getaffinity(0))
    text = f"import os, sys; os.sched_setaffinity(0, [{core}]); os.execv(sys.argv[1], sys.argv[1:])"
    return [sys.executable, "-c", text, *command]


@benchmark("many", "128 ESCs in one process; 15 000 CAN frames a second on one core: none lost")
def many(context: Context) -> list[Figure]:
    """128 ESCs in one process, and two buses' worth (15 000 CAN frames a second by 30 ESCs) on one core.

    A frame that is replaced by the next one, because the process had to wait, counts as lost.
    """
    figures = []
    for escs, where in ((4, list), (2, pinned)) if context.quick else ((128, list), (30, pinned)):
        run = once(context, "ours", escs, wrap=where)
        what = f"{escs} ESCs" + (" on one core" if where is pinned else "")
        note = f"delay, 99 %: {run.delay['p99']} us, longest {run.delay['max']:.0f}"
        figures += [
            Figure(f"{what}: CAN frames lost", run.lost, f"of {5 * run.sent}", "<= 0", note),
            Figure(f"{what}: share of a core", run.cpu_share * 100, "%"),
        ]
    return figures


# --- delay


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
    pairs = zip(found["ours"], found["c"], strict=True)
    value = median([ours.delay["p50"] / c.delay["p50"] for ours, c in pairs])
    figures.append(Figure("ours / c, median", value, "x", "<= 1.1"))
    figures.append(Figure("ours, 99 %", of_runs(found["ours"], "p99"), "us", "<= 2000"))
    return figures


@benchmark("delay-full", "the same with 8 ESCs, recorder, statistics, CANopen and a polling master")
def full(context: Context) -> list[Figure]:
    """8 ESCs with recorder, status file, CANopen nodes and a master that asks 200 times a second for one of 20 objects."""
    runs = [once(context, "ours", 8, "--sdo", config=EVERYTHING) for _ in range(context.rounds)]
    asked = sum(run.result["sdo_sent"] for run in runs)
    answered = sum(run.result["sdo_answers"] for run in runs)
    lost = max(0, asked - answered - len(runs))  # the last of each run may be on its way
    answer = median([run.result["sdo_us"]["p99"] for run in runs])
    if not answered:
        raise RuntimeError("the nodes answered no SDO request")
    longest = f"longest {of_runs(runs, 'max'):.0f}"
    return [
        Figure("8 ESCs and all, median", of_runs(runs, "p50"), "us"),
        Figure("8 ESCs and all, 99 %", of_runs(runs, "p99"), "us", "<= 1000", longest),
        Figure("SDO answers, 99 %", answer, "us"),
        Figure("SDO requests not answered", lost, f"of {asked}", "<= 0"),
        Figure(
            "CPU, all of it", median([run.cpu_us for run in runs]), "us/frame", note=losses(runs)
        ),
    ]
