"""Instructions for each live frame, counted by valgrind: the same in every run, whatever else the machine does.

Each program takes N and 3 N live frames; the difference is divided by 2 N, so that its start does not count. Counted is the whole way
from the port's bytes to the frames that are handed to the socket, and the time's share of what is done now and then; not the kernel's part.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from bench_programs import Feeder, Gateway, die_with_us
from registry import HERE, VALGRIND_LINE, Benchmark, Context, Figure, LeftOut

_SUMMARY = re.compile(r"^(?:summary|totals): (\d+)", re.MULTILINE)


def counted_by(file: Path) -> list[str]:
    """What comes in front of a command."""
    valgrind = shutil.which("valgrind")
    if valgrind is None:
        raise LeftOut(f"no valgrind to count instructions with:  {VALGRIND_LINE}")
    return [valgrind, "-q", "--tool=callgrind", f"--callgrind-out-file={file}"]


def total(file: Path) -> int:
    """Instructions of a whole run."""
    found = _SUMMARY.findall(file.read_text())
    if not found:
        raise RuntimeError(f"valgrind left no total in {file}")
    return max(map(int, found))


def of_python(program: str, frames: int) -> int:
    """Instructions of the driver with so many frames."""
    with tempfile.TemporaryDirectory(prefix="kontronik-bench-") as folder:
        out = Path(folder) / "callgrind"
        command = [*counted_by(out), sys.executable, str(HERE / "instruction_driver.py"), program, str(frames)]
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=600,
            env=os.environ | {"PYTHONHASHSEED": "0"},
            preexec_fn=die_with_us,
        )
        if done.returncode:
            raise RuntimeError(f"{program}: {done.stderr.strip()[-1500:]}")
        return total(out)


def of_c(context: Context, frames: int) -> int:
    """Instructions of the C gateway with so many frames."""
    with tempfile.TemporaryDirectory(prefix="kontronik-bench-") as folder:
        out = Path(folder) / "callgrind"
        feeder = Feeder(context, 1, "--warmup", "0", "--period", "5000", seconds=frames * 0.005)
        try:
            gateway = Gateway(context, "c", feeder, wrap=lambda command: [*counted_by(out), *command])
            try:
                sent = feeder.measure(gateway).sent
            finally:
                gateway.close()
        finally:
            feeder.close()
        return round(total(out) * frames / sent) if sent != frames else total(out)


def for_each(count: Callable[[int], int], frames: int) -> float:
    """Instructions for each live frame, by two runs side by side."""
    with ThreadPoolExecutor(2) as pool:
        short, long = pool.map(count, (frames, 3 * frames))
    return (long - short) / (2 * frames)


def instructions(context: Context) -> list[Figure]:
    """The three programs."""
    frames = 20 if context.quick else 200
    figures = []
    ours = for_each(lambda n: of_python("ours", n), frames)
    context.say(f"ours {ours:.0f}")
    core = for_each(lambda n: of_python("core", n), frames)
    context.say(f"ours without the loop {core:.0f}")
    obvious = for_each(lambda n: of_python("obvious", n), frames)
    context.say(f"obvious {obvious:.0f}")
    try:
        floor = for_each(lambda n: of_c(context, n), frames)
        figures.append(Figure("c", floor, "instructions/frame"))
    except LeftOut as reason:
        context.say(f"C left out: {reason}")
    figures.append(Figure("ours: decode, pack, schedule", core, "instructions/frame", "<= 40000", core <= 40_000))
    figures.append(Figure("ours: the whole loop, read and send too", ours, "instructions/frame"))
    figures.append(Figure("obvious", obvious, "instructions/frame"))
    figures.append(Figure("obvious / ours, both whole", obvious / ours, "x", ">= 12", obvious >= 12 * ours))
    figures.append(Figure("obvious, whole / ours: decode, pack, schedule", obvious / core, "x"))
    return figures


BENCHMARKS = [Benchmark("instructions", "instructions for each live frame, by valgrind (two minutes)", instructions)]
