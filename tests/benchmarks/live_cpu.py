"""CPU time for each live frame: C, ours and the obvious program by turns, at several numbers of ESCs; how many ESCs are borne."""

import os
import sys
from dataclasses import asdict

from bench_programs import PROGRAMS, Measured, median, once
from registry import Benchmark, Context, Figure, LeftOut, judged

CANOPEN = '[canopen]\nenabled = true\nself_start = true\nstore = "store"\n'


def compare(context: Context, escs: int, *options: str) -> dict[str, list[Measured]]:
    """Rounds of the three programs by turns, so that what disturbs the machine disturbs all."""
    found: dict[str, list[Measured]] = {program: [] for program in PROGRAMS}
    for _ in range(context.rounds):
        for program, runs in found.items():
            runs.append(once(context, program, escs, *options))
    name = " ".join([str(escs), *options])
    context.data[name] = {program: [asdict(run) for run in runs] for program, runs in found.items()}
    return found


def cpu_of(runs: list[Measured]) -> float:
    """Median of the rounds."""
    if not all(run.cpu_us for run in runs):
        raise LeftOut(
            "this kernel counts CPU time by ticks (User Mode Linux): too coarse to compare. Use a real one"
        )
    return median([run.cpu_us for run in runs])


def lost_share(runs: list[Measured]) -> float:
    return median([run.lost_share for run in runs])


def losses(runs: list[Measured]) -> str:
    """In words, where they are worth a word."""
    return f"{lost_share(runs):.1%} of its CAN frames lost" if lost_share(runs) >= 0.001 else ""


def ratio(above: list[Measured], below: list[Measured]) -> float:
    """Median of the ratios of the rounds."""
    return median([a.cpu_us / b.cpu_us for a, b in zip(above, below, strict=True)])


def beside(context: Context, escs: int, most: str, least: str, *options: str) -> list[Figure]:
    """The three programs, and ours beside the two others. What is not sent costs nothing: with losses no target is reached."""
    found = compare(context, escs, *options)
    what = ", ".join([f"{escs} ESC", *options])
    figures = [
        Figure(f"{program}, {what}", cpu_of(runs), "us/frame", note=losses(runs))
        for program, runs in found.items()
    ]
    ours, fair = found["ours"], lost_share(found["ours"]) < 0.01
    for name, value, target in (
        ("ours / c", ratio(ours, found["c"]), most),
        ("obvious / ours", ratio(found["obvious"], ours), least),
    ):
        title = f"{name}, {what}"
        figures.append(
            judged(title, value, "x", target, fair=fair) if target else Figure(title, value, "x")
        )
    return figures


def cpu(context: Context) -> list[Figure]:
    """The table of the three programs."""
    figures = beside(context, 1, "<= 3.2", "")
    if context.quick:
        return figures
    return figures + beside(context, 8, "<= 2.2", ">= 4") + beside(context, 64, "", "")


def bytewise(context: Context) -> list[Figure]:
    """Bytes one by one as the wire brings them, in place of whole frames."""
    return [figure for escs in (1, 8) for figure in beside(context, escs, "", "", "--bytewise")]


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
            note=f"{frames:.1f} CANopen frames a live frame",
        ),
        judged("with / without CANopen", ratio(both, plain), "x", "<= 1.6"),
    ]


def pinned(command: list[str]) -> list[str]:
    """The command on one core; the last, where the feeder need not be."""
    core = max(os.sched_getaffinity(0))
    text = f"import os, sys; os.sched_setaffinity(0, [{core}]); os.execv(sys.argv[1], sys.argv[1:])"
    return [sys.executable, "-c", text, *command]


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
            Figure(
                f"{what}: CAN frames lost", run.lost, f"of {5 * run.sent}", "0", run.lost == 0, note
            ),
            Figure(f"{what}: share of a core", run.cpu_share * 100, "%"),
        ]
    return figures


BENCHMARKS = [
    Benchmark(
        "cpu", "CPU time a live frame at 1, 8 and 64 ESCs: C, ours, the obvious program", cpu
    ),
    Benchmark("cpu-bytewise", "the same where the bytes come one by one", bytewise),
    Benchmark(
        "cpu-canopen", "CPU time with CANopen nodes and default PDOs, beside that without", canopen
    ),
    Benchmark(
        "many", "128 ESCs in one process; 15 000 CAN frames a second on one core: none lost", many
    ),
]
