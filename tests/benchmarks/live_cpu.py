"""CPU time for each live frame: C, ours and the obvious program by turns, at several numbers of ESCs; what else costs; how it grows."""

from dataclasses import asdict
from pathlib import Path

from bench_programs import Measured, median, once
from registry import Benchmark, Context, Figure


def compare(context: Context, programs: tuple[str, ...], escs: int, *options: str) -> dict[str, list[Measured]]:
    """Rounds by turns, so that what disturbs the machine disturbs all."""
    found: dict[str, list[Measured]] = {program: [] for program in programs}
    for _ in range(context.rounds):
        for program in programs:
            found[program].append(once(context, program, escs, *options))
    return found


def cpu_of(runs: list[Measured]) -> float:
    return median([run.cpu_us for run in runs])


def ratio(above: list[Measured], below: list[Measured]) -> float:
    """Median of the ratios of the rounds."""
    return median([a.cpu_us / b.cpu_us for a, b in zip(above, below, strict=True)])


def keep(context: Context, name: str, found: dict[str, list[Measured]]) -> None:
    """Every run into the JSON."""
    context.data[name] = {program: [asdict(run) for run in runs] for program, runs in found.items()}


def cpu(context: Context) -> list[Figure]:
    """The table of the three programs."""
    figures = []
    for escs, c_target, obvious_target in ((1, 3.2, None), (8, 2.2, 4.0), (64, None, None)):
        found = compare(context, ("c", "ours", "obvious"), escs)
        keep(context, str(escs), found)
        for program, runs in found.items():
            lost = median([run.lost_share for run in runs])
            note = f"{lost:.0%} of its CAN frames lost" if lost > 0.005 else ""
            figures.append(Figure(f"{program}, {escs} ESC", cpu_of(runs), "us/frame", note=note))
        beside_c, beside_obvious = ratio(found["ours"], found["c"]), ratio(found["obvious"], found["ours"])
        target = f"<= {c_target}" if c_target else ""
        figures.append(
            Figure(f"ours / c, {escs} ESC", beside_c, "x", target, beside_c <= c_target if c_target else None)
        )
        target = f">= {obvious_target}" if obvious_target else ""
        reached = beside_obvious >= obvious_target if obvious_target else None
        figures.append(Figure(f"obvious / ours, {escs} ESC", beside_obvious, "x", target, reached))
    return figures


BENCHMARKS = [Benchmark("cpu", "CPU time a live frame at 1, 8 and 64 ESCs: C, ours, the obvious program", cpu)]
