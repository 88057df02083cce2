"""The core in C, built for the tests by the machine's compiler."""

import shutil
import subprocess
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[2] / "kontronik_can_gw" / "native" / "core.c"
STRICT = [
    "-std=c99",
    "-pedantic",
    "-Wall",
    "-Wextra",
    "-Wconversion",
    "-Wdouble-promotion",
    "-Werror",
]
FOR_LINUX = ["-DKCG_DATA=64", "-DKCG_FLOATS=1", "-DKCG_FOUND=512"]


def compiler() -> str:
    """A C compiler; the test is skipped where there is none."""
    found = shutil.which("cc") or shutil.which("gcc")
    if found is None:
        pytest.skip("no C compiler: sudo apt-get install gcc libc6-dev")
    return found


def build(target: Path, *options: str) -> Path:
    """The core as a shared object."""
    command = [compiler(), *STRICT, *options, "-fPIC", "-shared", "-o", str(target), str(SOURCE)]
    subprocess.run(command, check=True)
    return target
