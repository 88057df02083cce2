"""The benchmarks as a program: a short run prints a table. Times are not judged."""

from pathlib import Path

import bench
import pytest
from busy import paused
from programs import Context, Figure, LeftOut

pytestmark = pytest.mark.promise("sharp-tests")


@pytest.mark.extended
@pytest.mark.usefixtures("c_compiler")
def test_short_run_of_the_three_programs_gives_a_table(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setattr(bench, "FOLDER", tmp_path)
    assert bench.main(["--quick", "--only", "cpu"]) == 0
    said = capsys.readouterr().out
    if "left out" in said:
        pytest.skip(said)
    assert all(f"{name}, 1 ESC" in said for name in ("c", "ours", "obvious", "ours / c"))


@pytest.mark.parametrize(
    ("outcome", "code", "said"),
    [
        (Figure("a", 3.3, "x", "<= 2.2"), 0, "MISSED"),
        (Figure("a", 5, "x", ">= 4"), 0, "reached"),
        (LeftOut("no gcc: sudo apt-get install gcc"), 0, "left out: no gcc: sudo apt-get"),
        (RuntimeError("c ended"), 1, "failed: RuntimeError: c ended"),
    ],
)
def test_only_a_failed_benchmark_is_an_error(
    outcome: Figure | Exception,
    code: int,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    monkeypatch.setattr(bench, "FOLDER", tmp_path)

    def function(_: Context) -> list[Figure]:
        if isinstance(outcome, Exception):
            raise outcome
        return [outcome]

    monkeypatch.setattr(bench, "BENCHMARKS", {"one": function})
    assert bench.main([]) == code
    assert said in capsys.readouterr().out
    assert bench.main(["--only", "cqu"]) == 2


@pytest.mark.parametrize(
    ("pauses", "total"),
    [
        ([], 0),
        ([(0, 100)], 0),
        ([(50, 150)], 50),
        ([(150, 160), (170, 300)], 40),
        ([(120, 140), (110, 130)], 30),
        ([(0, 500), (120, 140)], 100),
    ],
)
def test_pauses_of_both_cpus_are_counted_once_within_a_delay(
    pauses: list[tuple[int, int]],
    total: int,
) -> None:
    assert paused((100, 200), pauses) == total
