"""The core in C, compiled for a test."""

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


def built(target: Path, *options: str) -> Path:
    """The core as a shared object; the test is skipped where there is no compiler."""
    if compiler() is None:
        pytest.skip("no C compiler: sudo apt-get install gcc libc6-dev")
    assert compile_core(target, options) is None
    return target
