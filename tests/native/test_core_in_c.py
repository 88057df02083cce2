"""The core in C gives what the core in Python gives; it builds without a warning for a small machine too."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import equality
import pytest
from built import STRICT, built

from kontronik_can_gw.native.binding import WrongObject, load
from kontronik_can_gw.native.compile import FOR_LINUX, compiler

SEEDS = 16


@pytest.mark.parametrize("group", range(4))
def test_both_cores_give_the_same_frames_events_counters_and_deadlines(
    native_library: Any, group: int
) -> None:
    counts = [equality.run(native_library, seed) for seed in range(group, SEEDS, 4)]
    assert sum(counts) > 500, "the layouts are hardly sent"


@pytest.mark.extended
@pytest.mark.parametrize("group", range(20))
def test_both_cores_are_equal_over_many_more_layouts(native_library: Any, group: int) -> None:
    assert (
        sum(equality.run(native_library, 10_000 + seed) for seed in range(group, 400, 20)) > 5_000
    )


@pytest.mark.parametrize(
    "options", ["", "-DKCG_SLICES=0 -DKCG_LEGACY=0", "-DKCG_SLICES=1 -DKCG_FOUND=1"]
)
def test_it_builds_for_a_small_machine(tmp_path: Path, options: str) -> None:
    built(tmp_path / "core.so", *STRICT, "-Os", *options.split())


@pytest.mark.extended
def test_no_byte_outside_its_memory_and_nothing_undefined(tmp_path: Path) -> None:
    """Under AddressSanitizer and UndefinedBehaviorSanitizer, whose libraries must be loaded before all others."""
    sanitizers = "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-fno-wrapv"
    target = built(tmp_path / "core.so", "-g", "-O1", *sanitizers, *FOR_LINUX)
    asked = [[str(compiler()), f"-print-file-name=lib{name}.so"] for name in ("asan", "ubsan")]
    found = [subprocess.run(each, capture_output=True, text=True, check=True) for each in asked]
    script = tmp_path / "many.py"
    script.write_text(
        "import pathlib\nimport equality\nfrom kontronik_can_gw.native.binding import load\n"
        f"library = load(pathlib.Path({str(target)!r}))\n"
        "print(sum(equality.run(library, seed) for seed in range(10)))\n"
    )
    environment = os.environ | {
        "LD_PRELOAD": " ".join(each.stdout.strip() for each in found),
        "ASAN_OPTIONS": "detect_leaks=0",
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
    }
    done = subprocess.run(
        [sys.executable, str(script)], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert all(int(count) > 1_000 for count in done.stdout.split())


def test_an_object_with_other_tables_or_none_at_all_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(WrongObject, match="made of other sources"):
        load(built(tmp_path / "small.so", "-DKCG_DATA=8"))
    (tmp_path / "text.so").write_text("no object" * 100)
    with pytest.raises(WrongObject, match=r"text\.so: .*invalid ELF header"):
        load(tmp_path / "text.so")
