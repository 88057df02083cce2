"""What a benchmark is, and what it gives: the modules live_*.py, run_*.py and offline_*.py beside this one have ``BENCHMARKS``.

    BENCHMARKS = [Benchmark("cpu", "CPU time a live frame, beside C", cpu)]

    def cpu(context: Context) -> list[Figure]:
        program = context.compiled("gateway.c")   # raises LeftOut where there is no gcc
        if ours != theirs:
            raise NotEqual("cpu: frame 12: 3 is not 4")
        return [Figure("cpu, ours / C", ratio, "x", "<= 8", ratio <= 8)]

A missed target is a Figure whose ``reached`` is False, never an error. What is not equal, and what fails, is an exception.
"""

import hashlib
import importlib
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
PEERS = HERE / "peers"
PATTERNS = ("live_*.py", "run_*.py", "offline_*.py")
GCC_LINE = "sudo apt-get install gcc libc6-dev"
VALGRIND_LINE = "sudo apt-get install valgrind libc6-dbg"


class LeftOut(Exception):
    """This benchmark cannot be run here. The text says what is missing and how to get it, in one line."""


class NotEqual(Exception):
    """Two programs that must agree do not: the run ends with 1."""


@dataclass(frozen=True)
class Figure:
    """A line of the table. ``target`` is text for people ("<= 2.2"), ``reached`` None where there is no target."""

    name: str
    value: float
    unit: str
    target: str = ""
    reached: bool | None = None
    note: str = ""


@dataclass
class Context:
    """What a benchmark is given: how long it may measure, where it may write, and what else was asked for."""

    folder: Path
    """For files of the moment and compiled programs; it stays from run to run."""
    seconds: float = 5.0
    """How long one measurement lasts."""
    rounds: int = 3
    """How often measurements that are compared are taken by turns."""
    quick: bool = False
    """As short as it can be: for trying the benchmarks themselves. Figures mean little."""
    realtime: int = 0
    """Real-time priority of the gateway, where it is measured with one; 0: the benchmark's own choice."""
    vcan: str = ""
    """A vcan interface to use in place of the local socket that stands for the bus."""
    long: bool = False
    """Take what takes minutes, and gigabytes of disk, too."""
    data: dict[str, Any] = field(default_factory=dict)
    """What else goes into the JSON, under the benchmark's name: tables, series."""

    def say(self, text: str) -> None:
        """A line of progress, to standard error."""
        print(f"  {text}", file=sys.stderr, flush=True)

    def compiled(self, name: str, *options: str) -> Path:
        """The program made of a C file in peers/ by gcc -O2; made anew only where the file has changed."""
        source = PEERS / name
        gcc = shutil.which("gcc")
        if gcc is None:
            raise LeftOut(f"no gcc to compile {name} with:  {GCC_LINE}")
        key = hashlib.sha256(source.read_bytes() + " ".join(options).encode()).hexdigest()[:12]
        program = self.folder / f"{source.stem}-{key}"
        if not program.exists():
            self.folder.mkdir(parents=True, exist_ok=True)
            made = program.with_suffix(".new")
            command = [gcc, "-O2", "-Wall", "-Wextra", "-o", str(made), str(source), *options]
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode and "No such file" in done.stderr:
                raise LeftOut(f"no C library to compile {name} with:  {GCC_LINE}")
            if done.returncode:
                raise RuntimeError(f"gcc: {name}: {done.stderr.strip()}")
            made.rename(program)
        return program


@dataclass(frozen=True)
class Benchmark:
    """``function`` measures, and checks what must be equal."""

    name: str
    help: str
    function: Callable[[Context], list[Figure]]


def modules() -> list[str]:
    """The names of the modules that have benchmarks."""
    return [path.stem for pattern in PATTERNS for path in sorted(HERE.glob(pattern))]


def benchmarks() -> list[Benchmark]:
    """All of them, what must be equal first; ValueError where two have one name."""
    found: dict[str, Benchmark] = {}
    for name in modules():
        for benchmark in importlib.import_module(name).BENCHMARKS:
            if benchmark.name in found:
                raise ValueError(f"{name}: there is a benchmark {benchmark.name} already")
            found[benchmark.name] = benchmark
    return sorted(found.values(), key=lambda benchmark: benchmark.name != "equal")
