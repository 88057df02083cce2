"""What a benchmark is, and what it gives.

    @benchmark("cpu", "CPU time a live frame, beside C")
    def cpu(context: Context) -> list[Figure]:
        program = context.compiled("gateway.c")   # raises LeftOut where there is no gcc
        if ours != theirs:
            raise NotEqual("scan: row 12: 3 is not 4")
        return [Figure("scan, ours / C", ratio, "x", "<= 8")]

A missed target is no error. What is not equal, and what fails, is an exception.
"""

import hashlib
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
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


def judged(
    name: str, value: float, unit: str, target: str, note: str = "", fair: bool = True
) -> Figure:
    """A figure with a target such as "<= 2.2" or ">= 4"; what is not ``fair`` has not reached it."""
    sign, limit = target.split()
    reached = value <= float(limit) if sign == "<=" else value >= float(limit)
    return Figure(name, value, unit, target, fair and reached, note)


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
    vcan: str = ""
    """A vcan interface to use in place of the local socket that stands for the bus."""
    data: dict[str, Any] = field(default_factory=dict)
    """What else goes into the JSON, under the benchmark's name: tables, series."""

    def say(self, text: str) -> None:
        """A line of progress, to standard error."""
        print(f"  {text}", file=sys.stderr, flush=True)

    def compiled(self, name: str, *options: str) -> Path:
        """The program made of a C file in peers/ by gcc -O2; made anew only where the file has changed."""
        source = HERE / "peers" / name
        gcc = shutil.which("gcc")
        if gcc is None:
            raise LeftOut(f"no gcc to compile {name} with:  {GCC_LINE}")
        key = hashlib.sha256(source.read_bytes() + " ".join(options).encode()).hexdigest()[:12]
        program = self.folder / f"{source.stem}-{key}"
        if not program.exists():
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


BENCHMARKS: list[Benchmark] = []
"""Filled by importing the modules that have them."""


def benchmark(
    name: str, text: str
) -> Callable[[Callable[[Context], list[Figure]]], Callable[[Context], list[Figure]]]:
    """Register a function as a benchmark."""

    def register(function: Callable[[Context], list[Figure]]) -> Callable[[Context], list[Figure]]:
        BENCHMARKS.append(Benchmark(name, text, function))
        return function

    return register
