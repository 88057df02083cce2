"""The benchmarks themselves: all are listed, the programs they compare agree, and a short run gives a table and JSON. No time is judged."""

import json
import subprocess
import sys
from pathlib import Path

import bench
import live_equal
import pytest
import registry
from registry import Benchmark, Context, Figure, LeftOut, NotEqual

BENCH = Path(__file__).with_name("bench.py")


@pytest.fixture(scope="module")
def context(tmp_path_factory: pytest.TempPathFactory) -> Context:
    return Context(tmp_path_factory.mktemp("bench"), seconds=0.3, rounds=1, quick=True)


def test_every_module_has_benchmarks_and_every_benchmark_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.main(["--list"]) == 0
    listed = {line.split()[0] for line in capsys.readouterr().out.splitlines()}
    assert listed == {benchmark.name for benchmark in registry.benchmarks()}
    assert {"equal", "cpu", "cpu-growth", "delay", "delay-full", "delay-realtime", "instructions", "many"} <= listed
    assert all(benchmark.help for benchmark in registry.benchmarks())


def test_an_unknown_name_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.main(["--only", "cqu"]) == 2
    assert capsys.readouterr().err == "bench: there is no benchmark cqu. See --list.\n"


@pytest.mark.parametrize("seed", [2, 3])
def test_the_pieces_hold_every_byte_once(seed: int) -> None:
    data = live_equal.stream(60, seed)
    cut, lives = live_equal.pieces(data)
    rest, whole, ends = cut, b"", 0
    while rest:
        size = rest[0] & 0x7F
        whole += rest[1 : 1 + size]
        ends += rest[0] >> 7
        rest = rest[1 + size :]
    assert whole == data
    assert ends == len(lives) > 40


def test_c_and_the_obvious_program_send_what_the_gateway_sends(context: Context) -> None:
    try:
        figures = live_equal.equal(context)
    except LeftOut as reason:
        pytest.skip(str(reason))
    assert [figure.reached for figure in figures] == [True] * 3  # our values, C's frames, the obvious program's


@pytest.mark.parametrize("program", ["ours", "core", "obvious"])
def test_the_driver_whose_instructions_are_counted_gets_all_frames_through(program: str) -> None:
    command = [sys.executable, str(BENCH.with_name("instruction_driver.py")), program, "30"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_a_difference_is_found() -> None:
    ours = {0x110: ["01", "02"], 0x190: ["03"]}
    assert live_equal.first_difference("c", ours, {0x110: ["01", "02"], 0x190: ["03"]}) == ""
    assert live_equal.first_difference("c", ours, {0x110: ["01", "FF"], 0x190: ["03"]}) == (
        "id 110h, frame 1: ours 02, c FF"
    )
    assert live_equal.first_difference("c", ours, {0x110: ["01", "02"]}) == "id 190h: ours 1 frames, c 0"


def test_a_short_run_gives_a_table_and_json(tmp_path: Path) -> None:
    file = tmp_path / "bench.json"
    command = [sys.executable, str(BENCH), "--quick", "--only", "many", "--json", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
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
