"""Compiles the C core for a test, also with AddressSanitizer and UndefinedBehaviorSanitizer."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from kontronik_can_gw.native.compile import compile_core, compiler
from kontronik_can_gw.native.objects import OPTIONS

WARNINGS = ("-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Wshadow", "-Werror")
STRICT = ["-pedantic", *WARNINGS]
SANITIZERS = "-g -O1 -fsanitize=address,undefined -fno-sanitize-recover=all -fno-wrapv"
SANITIZED = tuple(SANITIZERS.split())
COMPILERS = ["gcc", pytest.param("clang", marks=pytest.mark.extended)]


def there(program: str | None = None) -> str:
    """Return a compiler, by default the machine's. Skip the test if it is missing."""
    found = compiler() if program is None else shutil.which(program)
    if found is None:
        pytest.skip(f"no {program or 'cc'}: sudo apt-get install {program or 'gcc'} libc6-dev")
    return found


def built(target: Path, *options: str, program: str | None = None) -> Path:
    """Compile the core as a shared object. Return its path."""
    problem = compile_core(target, options, there(program))
    assert problem is None, problem
    return target


def run_sanitized(folder: Path, *command: str) -> str:
    """Run Python with these arguments and the path of a sanitized core. Return its output.

    The sanitizers' libraries must be loaded before all others.
    """
    target = built(folder / "core.so", *SANITIZED, *OPTIONS)
    asked = [[there(), f"-print-file-name=lib{name}.so"] for name in ("asan", "ubsan")]
    found = [subprocess.run(each, capture_output=True, text=True, check=True) for each in asked]
    environment = os.environ | {
        "LD_PRELOAD": " ".join(each.stdout.strip() for each in found),
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
