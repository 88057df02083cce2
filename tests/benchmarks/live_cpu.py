"""CPU time for each live frame: C, ours and the obvious program by turns, at several numbers of ESCs; what else costs; how it grows."""

from dataclasses import asdict
from itertools import pairwise

from bench_programs import Measured, median, once
from registry import Benchmark, Context, Figure, LeftOut


def compare(context: Context, programs: tuple[str, ...], escs: int, *options: str) -> dict[str, list[Measured]]:
    """Rounds by turns, so that what disturbs the machine disturbs all."""
    found: dict[str, list[Measured]] = {program: [] for program in programs}
    for _ in range(context.rounds):
        for program in programs:
            found[program].append(once(context, program, escs, *options))
    return found


def cpu_of(runs: list[Measured]) -> float:
    """Median of the rounds."""
    if not all(run.cpu_us for run in runs):
        raise LeftOut("this kernel counts CPU time by ticks (User Mode Linux): too coarse to compare. Use a real one")
    return median([run.cpu_us for run in runs])


def losses(runs: list[Measured]) -> str:
    """In words, where they are worth a word."""
    lost = median([run.lost_share for run in runs])
    return f"{lost:.1%} of its CAN frames lost" if lost >= 0.001 else ""


def keeps_up(runs: list[Measured]) -> bool:
    """Whether next to nothing is lost: what is not sent costs nothing, so the CPU time of who does not keep up says little."""
    return median([run.lost_share for run in runs]) < 0.01


def ratio(above: list[Measured], below: list[Measured]) -> float:
    """Median of the ratios of the rounds."""
    return median([a.cpu_us / b.cpu_us for a, b in zip(above, below, strict=True)])


def keep(context: Context, name: str, found: dict[str, list[Measured]]) -> None:
    """Every run into the JSON."""
    context.data[name] = {program: [asdict(run) for run in runs] for program, runs in found.items()}


def cpu(context: Context) -> list[Figure]:
    """The table of the three programs."""
    figures = []
    cases = ((1, 3.2, 0.0), (8, 2.2, 4.0), (64, 0.0, 0.0))
    for escs, most, least in cases[:1] if context.quick else cases:
        found = compare(context, ("c", "ours", "obvious"), escs)
        keep(context, str(escs), found)
        for program, runs in found.items():
            figures.append(Figure(f"{program}, {escs} ESC", cpu_of(runs), "us/frame", note=losses(runs)))
        beside_c, beside_obvious = ratio(found["ours"], found["c"]), ratio(found["obvious"], found["ours"])
        below, above = f"ours / c, {escs} ESC", f"obvious / ours, {escs} ESC"
        fair = keeps_up(found["ours"])
        figures += [
            Figure(below, beside_c, "x", f"<= {most}", fair and beside_c <= most)
            if most
            else Figure(below, beside_c, "x"),
            Figure(above, beside_obvious, "x", f">= {least}", fair and beside_obvious >= least)
            if least
            else Figure(above, beside_obvious, "x"),
        ]
    return figures


CANOPEN = """[canopen]
enabled = true
self_start = true
store = "store"
"""


def canopen(context: Context) -> list[Figure]:
    """Ours at 8 ESCs with nodes and default PDOs, and without, by turns."""
    ratios, nodes, frames = [], [], []
    for _ in range(context.rounds):
        plain = once(context, "ours", 8)
        both = once(context, "ours", 8, config=CANOPEN)
        if not both.result["others"]:
            raise RuntimeError("the CANopen nodes sent nothing")
        ratios.append(both.cpu_us / plain.cpu_us)
        nodes.append(both.cpu_us)
        frames.append(both.result["others"] / both.sent)
    value = median(ratios)
    return [
        Figure("ours, 8 ESC, CANopen too", median(nodes), "us/frame"),
        Figure("CANopen frames for each live frame", median(frames), "frames"),
        Figure("with / without CANopen", value, "x", "<= 1.6", value <= 1.6),
    ]


def shipped(context: Context) -> list[Figure]:
    """Ours with the DBC that it comes with."""
    figures = []
    for escs in (1, 8):
        runs = [once(context, "ours", escs, dbc=None) for _ in range(context.rounds)]
        if not all(run.result["others"] for run in runs):
            raise RuntimeError("nothing was sent")
        frames = median([run.result["others"] / run.sent for run in runs])
        figures.append(
            Figure(f"ours, shipped DBC, {escs} ESC", cpu_of(runs), "us/frame", note=f"{frames:.1f} frames each")
        )
    return figures


def bytewise(context: Context) -> list[Figure]:
    """Bytes one by one as the wire brings them, in place of whole frames."""
    figures = []
    for escs in (1, 8):
        found = compare(context, ("c", "ours", "obvious"), escs, "--bytewise")
        keep(context, str(escs), found)
        for program, runs in found.items():
            figures.append(Figure(f"{program}, byte by byte, {escs} ESC", cpu_of(runs), "us/frame", note=losses(runs)))
        figures.append(Figure(f"ours / c, byte by byte, {escs} ESC", ratio(found["ours"], found["c"]), "x"))
    return figures


def growth(context: Context) -> list[Figure]:
    """CPU time a frame over the number of ESCs; falling or flat is the target."""
    numbers = [1, 2] if context.quick else [1, 2, 4, 8, 16, 32, 64, 128]
    series: dict[str, list[float]] = {"c": [], "ours": []}
    figures, all_kept_up = [], True
    for escs in numbers:
        found = compare(context, ("c", "ours"), escs)
        keep(context, str(escs), found)
        for program, runs in found.items():
            series[program].append(cpu_of(runs))
            figures.append(Figure(f"{program}, {escs} ESC", cpu_of(runs), "us/frame", note=losses(runs)))
        all_kept_up &= keeps_up(found["ours"])
    context.data["escs"], context.data["cpu_us"] = numbers, series
    ours = series["ours"]
    worst = max(after / before for before, after in pairwise(ours))
    figures.append(
        Figure("steepest step up, ours, doubling the ESCs", worst, "x", "<= 1.15", worst <= 1.15 and all_kept_up)
    )
    return figures


BENCHMARKS = [
    Benchmark("cpu", "CPU time a live frame at 1, 8 and 64 ESCs: C, ours, the obvious program", cpu),
    Benchmark("cpu-canopen", "CPU time with CANopen nodes and default PDOs beside the DBC's messages", canopen),
    Benchmark("cpu-shipped", "CPU time with the shipped DBC", shipped),
    Benchmark("cpu-bytewise", "CPU time where the bytes come one by one", bytewise),
    Benchmark("cpu-growth", "CPU time a live frame over 1 to 128 ESCs", growth),
]
