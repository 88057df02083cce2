"""The core in C gives what the core in Python gives; gcc and clang build it without a warning, for a small machine too."""

from pathlib import Path
from typing import Any

import equality
import pytest
from built import STRICT, built, run_sanitized

from kontronik_can_gw.native.binding import WrongObject, load
from kontronik_can_gw.native.objects import OPTIONS

SEEDS = 16


@pytest.mark.parametrize("group", range(4))
def test_both_cores_give_the_same_frames_events_counters_and_deadlines(
    native_library: Any, group: int
) -> None:
    counts = [equality.run(native_library, seed) for seed in range(group, SEEDS, 4)]
    assert sum(counts) > 500, "the layouts are hardly sent"


@pytest.mark.extended
@pytest.mark.parametrize("group", range(20))
def test_both_cores_are_equal_over_a_million_frames(native_library: Any, group: int) -> None:
    """Of all groups together; about as many layouts, of up to 30 messages, as there are seeds."""
    seeds = range(10_000 + group, 10_100, 20)
    counts = [equality.run(native_library, seed, steps=2000, most=30) for seed in seeds]
    assert sum(counts) > 15_000


@pytest.mark.extended
def test_every_source_builds_without_a_warning_of_clang(tmp_path: Path) -> None:
    """And of gcc, as ``native_library`` is built."""
    built(tmp_path / "core.so", *STRICT, "-O2", *OPTIONS, program="clang")


@pytest.mark.extended
def test_no_byte_outside_its_memory_and_nothing_undefined(tmp_path: Path) -> None:
    script = (
        "import pathlib, sys\nimport equality, offline_equality\nfrom kontronik_can_gw.native.binding import load\n"
        "path = pathlib.Path(sys.argv[1])\nlibrary = load(path)\n"
        "print(sum(equality.run(library, seed) for seed in range(10)))\n"
        "print(sum(offline_equality.run(library, seed, path.parent) for seed in range(3)))\n"
    )
    assert all(int(count) > 200 for count in run_sanitized(tmp_path, "-c", script).split())


def test_an_object_with_other_tables_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(WrongObject, match="made of other sources"):
        load(built(tmp_path / "small.so", "-DKCG_DATA=8", "-DKCG_SLOTS=1"))
