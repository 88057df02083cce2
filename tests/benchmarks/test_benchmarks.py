"""The benchmarks as a program: all are listed, and a short run gives a table and JSON. No time is judged."""

import json
import subprocess
import sys
from pathlib import Path

import bench
import pytest
import registry
from registry import Benchmark, Context, Figure, LeftOut, NotEqual

BENCH = Path(__file__).with_name("bench.py")


def test_every_module_has_benchmarks_and_every_benchmark_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.main(["--list"]) == 0
    listed = {line.split()[0] for line in capsys.readouterr().out.splitlines()}
    assert listed == {benchmark.name for benchmark in registry.benchmarks()}
    assert {"equal", "cpu", "cpu-growth", "delay", "delay-full", "delay-realtime", "instructions", "many"} <= listed
    assert all(benchmark.help for benchmark in registry.benchmarks())


def test_an_unknown_name_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.main(["--only", "cqu"]) == 2
    assert capsys.readouterr().err == "bench: there is no benchmark cqu. See --list.\n"


@pytest.mark.extended
def test_a_short_run_gives_a_table_and_json(tmp_path: Path) -> None:
    file = tmp_path / "bench.json"
    command = [sys.executable, str(BENCH), "--quick", "--only", "many", "--json", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    document = json.loads(file.read_text())
    (result,) = document["benchmarks"]
    assert document["quick"] is True
    if result["left_out"]:
        pytest.skip(result["left_out"])
    names = [figure["name"] for figure in result["figures"]]
    assert "4 ESCs: CAN frames lost" in names
    assert all(name in done.stdout for name in names)


@pytest.mark.parametrize(
    ("outcome", "code", "said"),
    [
        ([Figure("a", 3.3, "x", "<= 2.2", False)], 0, "MISSED by 50%"),
        ([Figure("a", 2, "x", "<= 2.2", True)], 0, "reached"),
        (LeftOut("no gcc: sudo apt-get install gcc"), 0, "left out: no gcc: sudo apt-get install gcc"),
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
    tmp_path: Path,
) -> None:
    def function(_: Context) -> list[Figure]:
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    monkeypatch.setattr(registry, "benchmarks", lambda: [Benchmark("one", "a try", function)])
    assert bench.main(["--json", str(tmp_path / "b.json")]) == code
    assert said in capsys.readouterr().out
    assert json.loads((tmp_path / "b.json").read_text())["benchmarks"][0]["name"] == "one"
