"""Python with the core in C under AddressSanitizer and UndefinedBehaviorSanitizer, whose libraries must be loaded before all others."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from kontronik_can_gw.native.compile import compile_core, compiler
from kontronik_can_gw.native.objects import OPTIONS

SANITIZED = (
    "-g",
    "-O1",
    "-fsanitize=address,undefined",
    "-fno-sanitize-recover=all",
    "-fno-wrapv",
)


def run_sanitized(folder: Path, *command: str) -> str:
    """What Python prints with these arguments and the core's path; skips the test where there is no compiler."""
    program, target = compiler(), folder / "core.so"
    if program is None:
        pytest.skip("no C compiler: sudo apt-get install gcc libc6-dev")
    assert compile_core(target, (*SANITIZED, *OPTIONS)) is None
    asked = [[program, f"-print-file-name=lib{name}.so"] for name in ("asan", "ubsan")]
    found = [subprocess.run(each, capture_output=True, text=True, check=True) for each in asked]
    environment = os.environ | {
        "LD_PRELOAD": " ".join(each.stdout.strip() for each in found),
        "ASAN_OPTIONS": "detect_leaks=0",
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
    }
    done = subprocess.run(
        [sys.executable, *command, str(target)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    return done.stdout
