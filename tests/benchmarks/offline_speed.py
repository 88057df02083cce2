"""Conversion of UART bytes: candump logs and tables, beside the obvious program, over growing files, and of a damaged file.

The bytes are a simulated flight of four minutes, over and over; for the damaged file one byte of one frame in a hundred is another one.
The obvious program says how many frames a file has.
"""

import json
import random
import subprocess
import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from registry import HERE, Benchmark, Context, Figure, NotEqual

FIVE = HERE / "five.dbc"
"""All sixteen values of a live frame, in five messages with each."""
FLIGHT_S = 240
SEED = 6
_MB = 1_000_000


# --- files --------------------------------------------------------------------------------------------------------------


def flight(context: Context) -> bytes:
    """About a MB."""
    from kontronik_can_gw.esc.kontronik.simulator import EscOptions, SimulatedEsc

    file = context.folder / f"flight-{FLIGHT_S}-{SEED}.bin"
    if not file.exists():
        context.say("a flight is simulated")
        context.folder.mkdir(parents=True, exist_ok=True)
        sent = SimulatedEsc(EscOptions(), seed=SEED).frames_until(FLIGHT_S * 1_000_000_000)
        file.with_suffix(".new").write_bytes(b"".join(one.wire for one in sent))
        file.with_suffix(".new").rename(file)
    return file.read_bytes()


def recording(context: Context, megabytes: float, damaged: bool = False) -> Path:
    """A file of that size, of whole frames where nothing is damaged."""
    file = context.folder / f"{'damaged' if damaged else 'clean'}-{megabytes:g}.bin"
    size = int(megabytes * _MB)
    if file.exists():
        return file
    once = flight(context)
    made = file.with_suffix(".new")
    with made.open("wb") as out:
        written = 0
        while written < size:
            data = once
            if size - written < len(data):
                data = (
                    data[: data.rindex(b"KOD", 0, size - written)]
                    if size - written > 100
                    else data[:40]
                )
            out.write(spoilt(data, written) if damaged else data)
            written += len(data)
            if len(data) < len(once):
                break
    made.rename(file)
    return file


def spoilt(data: bytes, seed: int) -> bytes:
    """With one byte of one frame in a hundred another one."""
    chance = random.Random(seed)
    found = bytearray(data)
    for at in chance.sample(range(len(data)), len(data) // 40 // 100):
        found[at] ^= chance.randrange(1, 256)
    return bytes(found)


def sizes(context: Context) -> list[float]:
    """In MB."""
    if context.quick:
        return [0.2, 0.5]
    return [1, 10, 100] if context.long else [1, 4, 16]


# --- one run ------------------------------------------------------------------------------------------------------------


@dataclass
class Run:
    """One conversion. ``told``: in words, how much was written."""

    cpu_s: float
    wall_s: float
    peak_mb: float
    told: str
    target: Path

    @property
    def count(self) -> int:
        """Rows or frames."""
        return int(self.told.split()[0])


def convert(context: Context, form: str, source: Path, *options: object) -> Run:
    """One conversion in a process of its own."""
    suffix = {"candump": ".log"}.get(form, f".{form}")
    target = context.folder / f"converted{suffix}"
    command = [sys.executable, str(HERE / "convert_driver.py"), form, source, target, *options]
    done = subprocess.run(
        [str(word) for word in command], capture_output=True, text=True, timeout=3600
    )
    if done.returncode:
        raise RuntimeError(f"{form}: {(done.stderr.strip().splitlines() or ['no word'])[-1]}")
    found: dict[str, Any] = json.loads(done.stdout)
    return Run(found["cpu_s"], found["wall_s"], found["peak_mb"], found["told"], target)


def best(context: Context, form: str, source: Path, *options: object) -> Run:
    """The quickest of the rounds."""
    return min(
        (convert(context, form, source, *options) for _ in range(context.rounds)),
        key=lambda run: run.cpu_s,
    )


# --- candump ------------------------------------------------------------------------------------------------------------


def of_obvious(context: Context, source: Path) -> tuple[float, int, Path]:
    """CPU seconds and live frames of the obvious program, and its log."""
    target = context.folder / "obvious.log"
    program = HERE / "peers" / "obvious_offline.py"
    done = subprocess.run(
        [sys.executable, program, FIVE, source, target], capture_output=True, text=True, check=True
    )
    found = json.loads(done.stdout)
    return found["cpu_s"], found["live"], target


def candump(context: Context) -> list[Figure]:
    """Raw bytes to a log of CAN frames, beside the obvious program, whose log is the same."""
    source = recording(context, 0.5 if context.quick else 1)
    ratios, micros = [], []
    for _ in range(context.rounds):
        obvious_s, lives, log = of_obvious(context, source)
        ours = convert(context, "candump", source, "--dbc", FIVE)
        if ours.count != 5 * lives:
            raise NotEqual(f"candump: {ours.count} frames of {lives} live frames")
        if ours.target.read_bytes() != log.read_bytes():
            raise NotEqual("candump: the obvious program's log is another one")
        micros.append(ours.cpu_s / lives * 1e6)
        ratios.append(obvious_s / ours.cpu_s)
    shipped = best(context, "candump", source)
    shipped.target.unlink()
    ratio = sorted(ratios)[len(ratios) // 2]
    return [
        Figure(
            "candump, the obvious program / ours", ratio, "x", note="five CAN frames a live frame"
        ),
        Figure("candump, CPU a live frame", min(micros), "us", note="five CAN frames"),
        Figure(
            "candump, CPU a live frame, shipped DBC",
            shipped.cpu_s / lives * 1e6,
            "us",
            note=shipped.told,
        ),
        Figure("candump, peak memory", shipped.peak_mb, "MB", "<= 100", shipped.peak_mb <= 100),
    ]


# --- tables -------------------------------------------------------------------------------------------------------------


def tables(context: Context) -> list[Figure]:
    """Rows a CPU second, with the sixteen values of a live frame and with all values."""
    figures = []
    source = recording(context, 0.5 if context.quick else 2)
    lives = of_obvious(context, source)[1]
    for form in ("csv", "jsonl", "parquet"):
        for what, options in (("16 live values", ("--live",)), ("all values", ())):
            run = best(context, form, source, *options)
            if run.count != lives:
                raise NotEqual(f"{form}: {run.count} rows of {lives} live frames")
            note = f"a CPU second; {run.count / run.wall_s:.0f} by the clock, {run.peak_mb:.0f} MB of memory"
            figures.append(Figure(f"{form}, {what}", run.count / run.cpu_s, "rows/s", note=note))
            run.target.unlink()
    return figures


# --- growth and damage --------------------------------------------------------------------------------------------------

_FORMS = {"candump": (), "parquet": ("--live",), "csv": ("--live",)}


def growth(context: Context) -> list[Figure]:
    """Time and memory of each conversion over growing files."""
    series: dict[str, list[dict[str, float]]] = {}
    figures = []
    for form, options in _FORMS.items():
        for megabytes in sizes(context):
            source = recording(context, megabytes)
            run = convert(context, form, source, *options)
            lives = source.read_bytes().count(b"KODL")
            if form != "candump" and run.count != lives:
                raise NotEqual(f"{form}: {run.count} rows of {lives} live frames")
            run.target.unlink()
            told = {
                "mb": source.stat().st_size / _MB,
                "cpu_s": run.cpu_s,
                "wall_s": run.wall_s,
                "peak_mb": run.peak_mb,
            }
            series.setdefault(form, []).append(told)
            context.say(
                f"{form}, {megabytes:g} MB: {run.cpu_s:.2f} s of CPU, {run.peak_mb:.0f} MB of memory"
            )
        rows = series[form]
        peak = max(row["peak_mb"] for row in rows)
        largest = rows[-1]["mb"]
        figures.append(
            Figure(f"{form}, peak memory up to {largest:.0f} MB", peak, "MB", "<= 250", peak <= 250)
        )
        paces = [row["cpu_s"] / row["mb"] for row in rows]
        worst = max(after / before for before, after in pairwise(paces))
        pace = ", ".join(f"{1000 * one:.0f}" for one in paces)
        figures.append(
            Figure(
                f"{form}, ms a MB: next size / size",
                worst,
                "x",
                "<= 1.3",
                worst <= 1.3,
                f"{pace} ms of CPU a MB",
            )
        )
    context.data["growth"] = series
    return figures


def damage(context: Context) -> list[Figure]:
    """A file with one frame in a hundred damaged, beside the clean one."""
    figures = []
    megabytes = 0.5 if context.quick else 1
    clean, damaged = recording(context, megabytes), recording(context, megabytes, damaged=True)
    lives = of_obvious(context, damaged)[1]
    for form, options in _FORMS.items():
        ratios = []
        for _ in range(context.rounds):
            runs = [convert(context, form, source, *options) for source in (clean, damaged)]
            if form != "candump" and runs[1].count != lives:
                raise NotEqual(f"{form}: {runs[1].count} rows of {lives} live frames")
            ratios.append(runs[1].cpu_s / runs[0].cpu_s)
        pace = damaged.stat().st_size / _MB / runs[1].cpu_s
        ratio = sorted(ratios)[len(ratios) // 2]
        figures.append(
            Figure(f"{form}, 1 % damaged / clean", ratio, "x", note=f"{pace:.1f} MB a CPU second")
        )
        runs[0].target.unlink()
    return figures


BENCHMARKS = [
    Benchmark(
        "offline-candump", "UART bytes to a candump log, beside the obvious program", candump
    ),
    Benchmark("offline-tables", "UART bytes to CSV, JSON lines and Parquet", tables),
    Benchmark("offline-growth", "time and memory over the size of the file", growth),
    Benchmark("offline-damage", "a damaged file beside a clean one", damage),
]
