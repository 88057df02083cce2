"""Both cores run across every wrap of a time or a counter without a difference.

The oracle in years.c computes each CAN frame from exact integers of its own, and never looks into a
core. ``years_run.py`` runs ten years of virtual time in the same way.
"""

import re
from pathlib import Path
from typing import Any

import pytest
from years import WRAPS, RunInBoth, RunInC, Wrap, build, load_both
from years_run import main

pytestmark = [
    pytest.mark.promise("no-overflow"),
    pytest.mark.usefixtures("c_compiler"),
]
NAMES = [wrap.name for wrap in WRAPS]


@pytest.fixture(scope="module")
def years_library(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return load_both(build(tmp_path_factory.mktemp("years")))


def test_readme_states_the_number_of_wraps() -> None:
    page = Path(__file__).with_name("README.md").read_text(encoding="utf-8")
    assert re.findall(r"\| (\d+) wraps \|", page) == 2 * [str(len(WRAPS))]


@pytest.mark.parametrize("wrap", WRAPS, ids=NAMES)
def test_core_in_c_crosses_a_wrap_within_two_minutes(years_library: Any, wrap: Wrap) -> None:
    run = RunInC(years_library, wrap.started_ns)
    wrap.cross(run, 60)
    assert run.oracle.numbers.frames > 40_000


@pytest.mark.parametrize("wrap", WRAPS, ids=NAMES)
def test_core_in_python_crosses_a_wrap_and_equals_the_core_in_c(
    years_library: Any,
    wrap: Wrap,
) -> None:
    run = RunInBoth(years_library, wrap.started_ns)
    wrap.cross(run, 5)
    assert run.oracle.numbers.frames > 3_500


def test_run_without_jumps_crosses_the_end_of_charge_energy_and_positions(
    years_library: Any,
) -> None:
    """An hour: the ESC's charge passes 65 535 five times, and each hour has a gap."""
    run = RunInC(years_library, 0)
    run.run(362_000)
    assert run.oracle.numbers.losses == 2


@pytest.mark.parametrize("words", [["--years=0"], ["--years=1e9"], ["--processes=1"]])
def test_length_out_of_range_is_refused_in_one_line(
    words: list[str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert "--years is 0.0001 to 100, and --processes 2 to 8" in capsys.readouterr().err
