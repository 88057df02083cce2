"""Bulk work on UART bytes: finding frames, candump logs, tables; beside C, beside the obvious program, and over growing files.

The bytes are a simulated flight of four minutes, over and over; for the damaged file one byte of one frame in a hundred is another one.
"""

import json
import subprocess
import sys
import time
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
_SUMS = ("live", "info", "bytes", "voltage", "speed", "errors", "max_speed")


# --- files --------------------------------------------------------------------------------------------------------------


def flight(context: Context) -> bytes:
    """About a MB."""
    from kontronik_can_gw.simulator import EscOptions, SimulatedEsc

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
    import numpy as np

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
                data = data[: data.rindex(b"KOD", 0, size - written)] if size - written > 100 else data[:40]
            if damaged:
                spoilt = np.frombuffer(data, np.uint8).copy()
                chance = np.random.default_rng(written)
                hits = chance.choice(len(data), len(data) // 40 // 100, replace=False)
                spoilt[hits] ^= chance.integers(1, 256, len(hits), np.uint8)
                data = spoilt.tobytes()
            out.write(data)
            written += len(data)
            if len(data) < len(once):
                break
    made.rename(file)
    return file


def sizes(context: Context) -> list[float]:
    """In MB."""
    if context.quick:
        return [0.5, 1]
    return [1, 10, 100, 1000] if context.long else [1, 10, 100]


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


def convert(context: Context, form: str, source: Path, *options: object, name: str = "") -> Run:
    """One conversion in a process of its own."""
    suffix = {"candump": ".log"}.get(form, f".{form}")
    target = context.folder / f"{name or 'converted'}{suffix}"
    command = [sys.executable, str(HERE / "convert_driver.py"), form, source, target, *options]
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True, timeout=3600)
    if done.returncode:
        raise RuntimeError(f"{form}: {(done.stderr.strip().splitlines() or ['no word'])[-1]}")
    found: dict[str, Any] = json.loads(done.stdout)
    return Run(found["cpu_s"], found["wall_s"], found["peak_mb"], found["told"], target)


def best(context: Context, form: str, source: Path, *options: object) -> Run:
    """The quickest of the rounds."""
    return min((convert(context, form, source, *options) for _ in range(context.rounds)), key=lambda run: run.cpu_s)


def equal_to_streaming(context: Context, form: str, source: Path, *options: object) -> int:
    """Convert both ways. NotEqual where a byte (of Parquet: a value or a name) differs; how many rows or frames it were."""
    ours = convert(context, form, source, *options, name="blocks")
    theirs = convert(context, form, source, *options, "--streaming", name="streaming")
    if form == "parquet":
        import pyarrow.parquet  # type: ignore[import-untyped]

        mine, other = (pyarrow.parquet.read_table(run.target) for run in (ours, theirs))
        same = mine.equals(other, check_metadata=False)
    else:
        same = ours.target.read_bytes() == theirs.target.read_bytes()
    if not same or ours.told != theirs.told:
        raise NotEqual(
            f"{form} of {source.name}: blocks gave {ours.told}, the streaming way {theirs.told}, or other values"
        )
    for run in (ours, theirs):
        run.target.unlink()
    return ours.count


def of_c(context: Context, source: Path) -> dict[str, Any]:
    """What C finds, and how long it takes."""
    program = context.compiled("scan.c")
    done = subprocess.run([program, source, str(max(3, context.rounds))], capture_output=True, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


# --- scan ---------------------------------------------------------------------------------------------------------------


def of_ours(source: Path) -> dict[str, Any]:
    """The same, by the scanner; what is between its stretches by the Deframer."""
    from kontronik_can_gw.offline.bulk.scan import Stretch, pass_over, pieces
    from kontronik_can_gw.protocol.deframer import Deframer, Frame
    from kontronik_can_gw.protocol.fields import LiveData

    found = dict.fromkeys(_SUMS, 0)
    deframer = Deframer()

    def add(frames: list[Frame]) -> None:
        for frame in frames:
            data = frame.data
            found["bytes"] += frame.form.length
            if isinstance(data, LiveData):
                found["live"] += 1
                found["voltage"] += data.battery_voltage
                found["speed"] += data.electrical_speed
                found["errors"] += data.operating_errors
            else:
                found["info"] += 1
                found["max_speed"] += data.max_electrical_speed

    begun = time.process_time()
    with source.open("rb") as file:
        for piece in pieces(file.read):
            if not isinstance(piece, Stretch):
                add(deframer.feed(piece))
                continue
            pass_over(deframer, piece)
            live = piece.live
            found["live"] += len(live)
            found["info"] += len(piece.infos)
            found["bytes"] += len(piece.data)
            found["voltage"] += int(live["battery_voltage"].sum(dtype="u8"))
            found["speed"] += int(live["electrical_speed"].sum(dtype="u8"))
            found["errors"] += int(live["operating_errors"].sum(dtype="u8"))
            found["max_speed"] += int(piece.info["max_electrical_speed"].sum(dtype="u8"))
    add(deframer.flush())
    return found | {"seconds": time.process_time() - begun}


def scan(context: Context) -> list[Figure]:
    """Clean and damaged, beside C."""
    figures = []
    megabytes = 1 if context.quick else 40
    for damaged in (False, True):
        source = recording(context, megabytes, damaged)
        ratios, speeds = [], []
        for _ in range(context.rounds):
            c, ours = of_c(context, source), of_ours(source)
            for name in _SUMS:
                if c[name] != ours[name]:
                    raise NotEqual(f"scan of {source.name}: {name}: C {c[name]}, ours {ours[name]}")
            ratios.append(ours["seconds"] / c["seconds"])
            speeds.append(source.stat().st_size / _MB / ours["seconds"])
        what = "1 % of the frames damaged" if damaged else "clean"
        ratio = sorted(ratios)[len(ratios) // 2]
        target, reached = ("", None) if damaged else ("<= 8", ratio <= 8)
        figures.append(Figure(f"scan, ours / C, {what}", ratio, "x", target, reached, f"{max(speeds):.0f} MB/s"))
    return figures


# --- candump ------------------------------------------------------------------------------------------------------------


def of_obvious(context: Context, source: Path) -> tuple[float, int, Path]:
    """CPU seconds and live frames of the obvious program, and its log."""
    target = context.folder / "obvious.log"
    program = HERE / "peers" / "obvious_offline.py"
    done = subprocess.run([sys.executable, program, FIVE, source, target], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    return found["cpu_s"], found["live"], target


def candump(context: Context) -> list[Figure]:
    """Raw bytes to a log of CAN frames, beside the obvious program, whose log is the same."""
    small, large = recording(context, 1), recording(context, 1 if context.quick else 40)
    for part, options in ((small, ()), (small, ("--dbc", FIVE))):
        equal_to_streaming(context, "candump", part, *options)
    lives = of_c(context, large)["live"]
    ratios, micros = [], []
    for _ in range(context.rounds):
        obvious_s, obvious_lives, log = of_obvious(context, small)
        ours = convert(context, "candump", large, "--dbc", FIVE)
        if ours.count != 5 * lives:
            raise NotEqual(f"candump: {ours.count} frames of {lives} live frames")
        micros.append(ours.cpu_s / lives * 1e6)
        ratios.append(obvious_s / obvious_lives * 1e6 / micros[-1])
    same = convert(context, "candump", small, "--dbc", FIVE)
    if same.target.read_bytes() != log.read_bytes():
        raise NotEqual("candump: the obvious program's log is another one")
    shipped = best(context, "candump", large)
    text = context.folder / "converted.log"
    ratio = sorted(ratios)[len(ratios) // 2]
    figures = [
        Figure(
            "candump, the obvious program / ours", ratio, "x", ">= 100", ratio >= 100, "five CAN frames a live frame"
        ),
        Figure("candump, CPU a live frame", min(micros), "us", note="five CAN frames"),
        Figure("candump, CPU a live frame, shipped DBC", shipped.cpu_s / lives * 1e6, "us", note=shipped.told),
        Figure("candump, peak memory", shipped.peak_mb, "MB", "<= 250", shipped.peak_mb <= 250),
    ]
    text.unlink()
    return figures


def text(context: Context) -> list[Figure]:
    """Columns to candump lines, beside C with the same columns."""
    import numpy as np

    from kontronik_can_gw.config import shipped
    from kontronik_can_gw.offline.bulk.candump import Lines
    from kontronik_can_gw.offline.bulk.sending import CanFrames, Part
    from kontronik_can_gw.offline.layouts import layout_of_dbc

    plans = layout_of_dbc(shipped("dbc/kontronik_esc.dbc")).layout.messages
    count, blocks = 20_000, 2 if context.quick else 50
    chance = np.random.default_rng(SEED)
    records, found = [], []
    for block in range(blocks):
        times = np.sort(chance.integers(0, 10**11, count)) + block * 10**11
        messages = chance.integers(0, len(plans), count)
        data = chance.integers(0, 256, (count, 8), np.uint8)
        record = np.zeros(count, [("ns", "<i8"), ("id", "<u4"), ("nothing", "<u4"), ("data", "u1", 8)])
        record["ns"], record["data"] = times, data
        record["id"] = np.array([plan.can_id for plan in plans])[messages]
        records.append(record)
        parts = []
        for index in range(len(plans)):
            places = np.flatnonzero(messages == index)
            parts.append(Part(index, times[places], places, data[places]))
        found.append(CanFrames(parts))
    source, theirs, ours = (context.folder / name for name in ("records.bin", "c.log", "ours.log"))
    source.write_bytes(b"".join(record.tobytes() for record in records))
    program = context.compiled("candump.c")
    ratios, speeds = [], []
    for _ in range(context.rounds):
        done = subprocess.run([program, source, theirs, "3"], capture_output=True, text=True, check=True)
        lines = Lines(plans)
        begun = time.process_time()
        with ours.open("wb") as file:
            for block_of_frames in found:
                file.write(lines.text(block_of_frames, 0))
        seconds = time.process_time() - begun
        ratios.append(seconds / float(done.stdout))
        speeds.append(ours.stat().st_size / _MB / seconds)
    if ours.read_bytes() != theirs.read_bytes():
        raise NotEqual("candump text: C's is another one")
    for made in (source, theirs, ours):
        made.unlink()
    ratio, speed = sorted(ratios)[len(ratios) // 2], max(speeds)
    return [
        Figure("candump text, ours / C", ratio, "x"),
        Figure("candump text", speed, "MB/s", ">= 100", speed >= 100),
    ]


# --- tables -------------------------------------------------------------------------------------------------------------


def tables(context: Context) -> list[Figure]:
    """Parquet and CSV: with the sixteen live values, and with all signals of the shipped DBC."""
    figures = []
    small = recording(context, 0.5 if context.quick else 1)
    for form, least, megabytes in (("parquet", 80, 40), ("csv", 10, 10)):
        source = recording(context, 1 if context.quick else megabytes)
        lives = of_c(context, source)["live"]
        for what, options in (("16 live values", ("--dbc", FIVE)), ("all signals", ())):
            equal_to_streaming(context, form, small, *options)
            run = best(context, form, source, *options)
            if run.count != lives:
                raise NotEqual(f"{form}: {run.count} rows of {lives} live frames")
            speed = source.stat().st_size / _MB / run.wall_s
            target, reached = (f">= {least}", speed >= least) if options else ("", None)
            note = f"{source.stat().st_size / _MB / run.cpu_s:.0f} MB a CPU second, {run.peak_mb:.0f} MB of memory"
            figures.append(Figure(f"{form}, {what}", speed, "MB/s", target, reached, note))
            run.target.unlink()
    return figures


# --- growth and damage --------------------------------------------------------------------------------------------------

_FORMS = {"candump": (), "parquet": ("--dbc", FIVE), "csv": ("--dbc", FIVE)}


def growth(context: Context) -> list[Figure]:
    """Time and memory of each conversion over growing files."""
    series: dict[str, list[dict[str, float]]] = {}
    figures = []
    for form, options in _FORMS.items():
        for megabytes in sizes(context):
            source = recording(context, megabytes)
            run = convert(context, form, source, *options)
            lives = of_c(context, source)["live"]
            if form != "candump" and run.count != lives:
                raise NotEqual(f"{form}: {run.count} rows of {lives} live frames")
            run.target.unlink()
            told = {"mb": source.stat().st_size / _MB, "cpu_s": run.cpu_s, "wall_s": run.wall_s, "peak_mb": run.peak_mb}
            series.setdefault(form, []).append(told)
            context.say(f"{form}, {megabytes:g} MB: {run.cpu_s:.2f} s of CPU, {run.peak_mb:.0f} MB of memory")
        rows = series[form]
        peak = max(row["peak_mb"] for row in rows)
        largest = rows[-1]["mb"]
        figures.append(Figure(f"{form}, peak memory up to {largest:.0f} MB", peak, "MB", "<= 250", peak <= 250))
        paces = [row["cpu_s"] / row["mb"] for row in rows]
        worst = max(after / before for before, after in pairwise(paces))
        pace = ", ".join(f"{1000 * one:.1f}" for one in paces)
        figures.append(
            Figure(f"{form}, ms a MB: next size / size", worst, "x", "<= 1.3", worst <= 1.3, f"{pace} ms of CPU a MB")
        )
    context.data["growth"] = series
    if context.plots is not None:
        draw(context.plots / "offline_growth.png", series)
    return figures


def draw(file: Path, series: dict[str, list[dict[str, float]]]) -> None:
    """Time over size, both by powers of ten: a line of slope one is linear."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.5))
    for form, rows in series.items():
        mb = [row["mb"] for row in rows]
        left.loglog(mb, [row["cpu_s"] for row in rows], "o-", label=form)
        right.semilogx(mb, [row["peak_mb"] for row in rows], "o-", label=form)
    left.set(xlabel="UART bytes [MB]", ylabel="CPU time [s]", title="Time")
    right.set(xlabel="UART bytes [MB]", ylabel="peak memory [MB]", title="Memory", ylim=(0, None))
    for axes in (left, right):
        axes.grid(True, which="both", alpha=0.3)
        axes.legend()
    figure.tight_layout()
    figure.savefig(file, dpi=120)
    plt.close(figure)


def damage(context: Context) -> list[Figure]:
    """A file with one frame in a hundred damaged, beside the clean one."""
    figures = []
    megabytes = 0.5 if context.quick else 4
    clean, damaged = recording(context, megabytes), recording(context, megabytes, damaged=True)
    for form, options in _FORMS.items():
        equal_to_streaming(context, form, recording(context, min(1, megabytes), damaged=True), *options)
        ratios = []
        for _ in range(context.rounds):
            runs = [convert(context, form, source, *options) for source in (clean, damaged)]
            ratios.append(runs[1].cpu_s / runs[0].cpu_s)
        pace = damaged.stat().st_size / _MB / runs[1].cpu_s
        ratio = sorted(ratios)[len(ratios) // 2]
        figures.append(Figure(f"{form}, 1 % damaged / clean", ratio, "x", note=f"{pace:.1f} MB a CPU second"))
        runs[0].target.unlink()
    return figures


BENCHMARKS = [
    Benchmark("offline-scan", "frames found in a file of UART bytes, beside C", scan),
    Benchmark("offline-candump", "UART bytes to a candump log, beside the obvious program", candump),
    Benchmark("offline-text", "columns of CAN frames to candump lines, beside C", text),
    Benchmark("offline-tables", "UART bytes to Parquet and CSV", tables),
    Benchmark("offline-growth", "time and memory over the size of the file", growth),
    Benchmark("offline-damage", "a damaged file beside a clean one", damage),
]
