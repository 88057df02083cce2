"""What a benchmark is, and what it gives.

    @benchmark("cpu", "CPU time a live frame, beside C")
    def cpu(context: Context) -> list[Figure]:
        program = context.compiled("gateway.c")   # raises LeftOut where there is no gcc
        return [Figure("ours / C", ratio, "x", "<= 1.35")]

A missed target is no error; what fails is an exception.
"""

import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
GCC_LINE = "sudo apt-get install gcc libc6-dev"


class LeftOut(Exception):
    """This benchmark cannot be run here. The text says what is missing and how to get it, in one line."""


@dataclass(frozen=True)
class Figure:
    """A line of the table. ``target``: "<= 2.2" or ">= 4"; what is not ``fair`` has not reached it."""

    name: str
    value: float
    unit: str
    target: str = ""
    note: str = ""
    fair: bool = True

    @property
    def reached(self) -> bool | None:
        """None where there is no target."""
        if not self.target:
            return None
        sign, limit = self.target.split()
        good = self.value <= float(limit) if sign == "<=" else self.value >= float(limit)
        return self.fair and good


@dataclass
class Context:
    """What a benchmark is given: how long it may measure, and where it may write."""

    folder: Path
    """For files of the moment and compiled programs; it stays from run to run."""
    seconds: float = 5.0
    """How long one measurement lasts."""
    rounds: int = 3
    """How often measurements that are compared are taken by turns."""
    quick: bool = False
    """As short as it can be: for trying the benchmarks themselves. Figures mean little."""

    def say(self, text: str) -> None:
        """A line of progress, to standard error."""
        print(f"  {text}", file=sys.stderr, flush=True)

    def compiled(self, name: str, *options: str) -> Path:
        """The program made of a C file in peers/ by gcc -O2; made anew only where the file has changed."""
        source = HERE / "peers" / name
        gcc = shutil.which("gcc")
        if gcc is None:
            raise LeftOut(f"no gcc to compile {name} with:  {GCC_LINE}")
        program = self.folder / source.stem
        if not program.exists() or program.stat().st_mtime < source.stat().st_mtime:
            command = [gcc, "-O2", "-Wall", "-Wextra", "-o", str(program), str(source), *options]
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode:
                raise RuntimeError(f"gcc: {name}: {done.stderr.strip()}")
        return program


Measures = Callable[[Context], list[Figure]]
BENCHMARKS: dict[str, tuple[str, Measures]] = {}
"""What each measures, in words, and by what; filled by importing the modules that have them."""


def benchmark(name: str, text: str) -> Callable[[Measures], Measures]:
    """Register a function as a benchmark."""

    def register(function: Measures) -> Measures:
        BENCHMARKS[name] = text, function
        return function

    return register
