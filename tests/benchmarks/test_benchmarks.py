"""The benchmarks as a program: all are listed, and a short run gives a table. No time is judged."""

from pathlib import Path

import bench
import pytest
from programs import Context, Figure, LeftOut


@pytest.fixture(autouse=True)
def build(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(bench, "FOLDER", tmp_path)


def test_the_benchmarks_are_listed_and_an_unknown_name_is_reported(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert bench.main(["--list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(bench.BENCHMARKS)
    assert bench.main(["--only", "cqu"]) == 2
    assert capsys.readouterr().err == "bench: there is no benchmark cqu. See --list.\n"


@pytest.mark.extended
def test_a_short_run_of_the_three_programs_gives_a_table(
    capsys: pytest.CaptureFixture[str],
) -> None:
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
def test_only_what_fails_is_an_error(
    outcome: Figure | Exception,
    code: int,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def function(_: Context) -> list[Figure]:
        if isinstance(outcome, Exception):
            raise outcome
        return [outcome]

    monkeypatch.setattr(bench, "BENCHMARKS", {"one": function})
    assert bench.main([]) == code
    assert said in capsys.readouterr().out
