"""The core in C, compiled for a test."""

import shutil
from pathlib import Path

import pytest

from kontronik_can_gw.native.compile import compile_core, compiler

STRICT = [
    "-pedantic",
    "-Wall",
    "-Wextra",
    "-Wconversion",
    "-Wdouble-promotion",
    "-Wshadow",
    "-Werror",
]
COMPILERS = ["gcc", pytest.param("clang", marks=pytest.mark.extended)]


def there(program: str | None = None) -> str:
    """A compiler, as a rule the machine's; the test is skipped where there is none."""
    found = compiler() if program is None else shutil.which(program)
    if found is None:
        pytest.skip("no C compiler: sudo apt-get install gcc libc6-dev clang")
    return found


def built(target: Path, *options: str, program: str | None = None) -> Path:
    """The core as a shared object."""
    assert compile_core(target, options, there(program)) is None
    return target
