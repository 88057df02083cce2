"""The benchmarks as a program: all are listed, and a short run gives a table and JSON. No time is judged."""

import json
from pathlib import Path

import bench
import pytest
import registry
from registry import Benchmark, Context, Figure, LeftOut, NotEqual


@pytest.fixture
def build(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Where results go."""
    monkeypatch.setattr(registry, "ROOT", tmp_path)
    return tmp_path / "build"


def test_the_benchmarks_are_listed_and_an_unknown_name_is_reported(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert bench.main(["--list"]) == 0
    names = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert len(set(names)) == len(names)
    assert names[0] == "equal", "figures of programs that do not agree say nothing"
    assert bench.main(["--only", "cqu"]) == 2
    assert capsys.readouterr().err == "bench: there is no benchmark cqu. See --list.\n"


@pytest.mark.extended
def test_a_short_run_gives_a_table_and_json(
    build: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench.main(["--quick", "--only", "many"]) == 0
    document = json.loads((build / "bench.json").read_text())
    (result,) = document["benchmarks"]
    assert document["quick"] is True
    if result["left_out"]:
        pytest.skip(result["left_out"])
    names = [figure["name"] for figure in result["figures"]]
    assert "4 ESCs: CAN frames lost" in names
    said = capsys.readouterr().out
    assert all(name in said for name in names)


@pytest.mark.parametrize(
    ("outcome", "code", "said"),
    [
        ([registry.judged("a", 3.3, "x", "<= 2.2")], 0, "MISSED"),
        ([registry.judged("a", 3, "x", ">= 4")], 0, "MISSED"),
        ([registry.judged("a", 5, "x", ">= 4")], 0, "reached"),
        ([registry.judged("a", 5, "x", ">= 4", fair=False)], 0, "MISSED\n"),
        ([Figure("a", 2, "of 10", "0", False)], 0, "MISSED\n"),
        (
            LeftOut("no gcc: sudo apt-get install gcc"),
            0,
            "left out: no gcc: sudo apt-get install gcc",
        ),
        (NotEqual("row 3"), 1, "error: not equal: row 3"),
        (RuntimeError("c ended"), 1, "error: failed: RuntimeError: c ended"),
    ],
)
def test_only_what_is_not_equal_or_fails_is_an_error(
    outcome: list[Figure] | Exception,
    code: int,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    build: Path,
) -> None:
    def function(_: Context) -> list[Figure]:
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    monkeypatch.setattr(registry, "BENCHMARKS", [Benchmark("one", "a try", function)])
    assert bench.main([]) == code
    assert said in capsys.readouterr().out
    assert json.loads((build / "bench.json").read_text())["benchmarks"][0]["name"] == "one"
