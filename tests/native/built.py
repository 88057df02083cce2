"""Finds a C compiler, and compiles the C core for a test, also with sanitizers.

A test that uses a compiler asks for it through the fixture ``c_compiler`` (tests/conftest.py).
Other tests find only programs that fail. So all tests that need a compiler are skipped on a machine
without one.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from kontronik_can_gw.native.compile import compile_core, compiler
from kontronik_can_gw.native.objects import OPTIONS

HIDDEN = "hidden-compilers"
WARNINGS = ("-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Wshadow", "-Werror")
STRICT = ["-pedantic", *WARNINGS]
SANITIZERS = "-g -O1 -fsanitize=address,undefined -fno-sanitize-recover=all -fno-wrapv"
SANITIZED = tuple(SANITIZERS.split())
PROGRAMS = ("cc", "c++", "gcc", "g++", "clang", "clang++")
ASK = "This test uses a compiler and does not ask for it. Add the fixture c_compiler."
_OTHERS = {"gcc": "cc", "g++": "c++"}
"""The machine's own compiler is as good as GNU's."""
COMPILERS = ["gcc", pytest.param("clang", marks=pytest.mark.extended)]


def there(program: str | None = None) -> str:
    """Return a compiler, by default the machine's. Skip the test if it is missing.

    The test fails if it has not asked for the fixture ``c_compiler``.
    """
    found = compiler() if program is None else shutil.which(program)
    if found is None and program in _OTHERS:
        found = shutil.which(_OTHERS[program])
    if found is None:
        pytest.skip(f"no {program or 'cc'}: sudo apt-get install {program or 'gcc'} libc6-dev")
    if Path(found).parent.name == HIDDEN:
        pytest.fail(ASK)
    return found


def hide_compilers(folder: Path) -> Path:
    """Fill a folder with compilers that only fail. Return it for the beginning of PATH."""
    hidden = folder / HIDDEN
    hidden.mkdir()
    for name in PROGRAMS:
        (hidden / name).write_text(f"#!/bin/sh\necho '{ASK}' >&2\nexit 1\n")
        (hidden / name).chmod(0o755)
    return hidden


def built(target: Path, *options: str, program: str | None = None) -> Path:
    """Compile the core as a shared object. Return its path."""
    problem = compile_core(target, options, there(program))
    assert problem is None, problem
    return target


def run_sanitized(folder: Path, *command: str) -> str:
    """Run Python with these arguments and the path of a sanitized core. Return its output.

    The sanitizers' libraries must be loaded before all others.
    """
    asked = [[there(), f"-print-file-name=lib{name}.so"] for name in ("asan", "ubsan")]
    found = [subprocess.run(each, capture_output=True, text=True).stdout.strip() for each in asked]
    if not all(map(os.path.isfile, found)):
        pytest.skip(f"{there()} has no sanitizers: sudo apt-get install gcc libc6-dev")
    target = built(folder / "core.so", *SANITIZED, *OPTIONS)
    environment = os.environ | {
        "LD_PRELOAD": " ".join(found),
        "ASAN_OPTIONS": "detect_leaks=0",
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
    }
    words = [sys.executable, *command, str(target)]
    done = subprocess.run(
        words,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    return done.stdout
