"""``make test`` runs each step once and judges it by its report and its exit code.

A step that failed, did not run or left no report never counts as passed.
"""

import re
import signal
import sys
from pathlib import Path
from typing import Any

import pytest
import run as checks

pytestmark = pytest.mark.promise("independent-tests")

CASES = {
    "passed": "<testcase classname='a' name='b'/>",
    "failed": "<testcase name='crc'><failure message='3 is not 4'>trace</failure></testcase>",
    "broken": "<testcase><error/></testcase>",
    "skipped": "<testcase><skipped message='no such tool'/></testcase>",
}


@pytest.fixture
def step(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Return a function that runs a shell command as the step "unit".

    With ``cases`` the step leaves a report of them.
    """

    def run(
        command: str,
        *cases: str,
        arguments: tuple[str, ...] = (),
    ) -> Any:
        report = tmp_path / "made.xml"
        report.write_text(f"<testsuite>{''.join(CASES[case] for case in cases)}</testsuite>")
        copy = f"cp {report} {{report}}; " if cases else ": {report}; "
        monkeypatch.setitem(checks.STEPS, "unit", f"echo ran >>{tmp_path}/ran; {copy}{command}")
        result = checks.run("unit", 60, tmp_path, arguments, False)
        assert (tmp_path / "ran").read_text() == "ran\n", "once, whatever came of it"
        return result

    return run


@pytest.mark.parametrize(
    ("command", "cases", "counts", "state"),
    [
        ("false", ["passed", "failed", "broken"], (1, 2, 0), "FAILED"),
        ("true", ["passed", "failed"], (1, 1, 0), "FAILED"),
        ("true", ["passed", "skipped", "skipped"], (1, 0, 2), "passed"),
        ("exit 3", ["passed"], (1, 1, 0), "FAILED"),
        ("exit 2", [], (0, 1, 0), "FAILED"),
        ("true", [], (0, 1, 0), "FAILED"),
        ("exit 5", [], (0, 0, 0), "passed"),  # the chosen expression matches no test
    ],
)
def test_step_is_judged_by_its_report_and_its_exit_code(
    step: Any,
    command: str,
    cases: list[str],
    counts: tuple[int, int, int],
    state: str,
) -> None:
    result = step(command, *cases, arguments=("-k", "crc") if command == "exit 5" else ())
    assert (result.passed, result.failed, len(result.skipped), result.state) == (*counts, state)
    assert (".crc: 3 is not 4" in result.failures) == ("failed" in cases)


def test_step_whose_tests_were_all_skipped_has_failed(step: Any) -> None:
    result = step("true", *67 * ["skipped"])
    assert (result.passed, result.failed, len(result.skipped)) == (0, 1, 67)
    assert (result.state, result.note) == ("FAILED", "every test was skipped")


def test_chosen_test_may_be_skipped(step: Any) -> None:
    assert step("true", "skipped", arguments=("-k", "crc")).state == "passed"


@pytest.mark.parametrize("name", ["prove", "proofs", "years"])
def test_proof_without_a_compiler_is_not_run(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setitem(checks.STEPS, name, "true")
    result = checks.run(name, 60, tmp_path, (), False)
    assert (result.state, result.note) == ("not run", "there is no cc")
    assert result.enable == "sudo apt-get install gcc libc6-dev"


def test_step_without_tests_is_one_check_with_a_time_limit(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    for command, limit_s, counts, note in (
        ("true", 60, (1, 0), ""),
        ("exit 1", 60, (0, 1), ""),
        ("sleep 600", 0.1, (0, 1), "no end within 0.1 s"),
    ):
        monkeypatch.setitem(checks.STEPS, "lint", command)
        result = checks.run("lint", limit_s, tmp_path, (), False)
        assert (result.passed, result.failed) == counts
        assert result.note == note


def test_step_without_its_tools_is_not_run_and_the_remedy_is_named(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(checks.NEEDS, "faults", ("no-such-program", "sudo make one"))
    result = checks.run("faults", 60, tmp_path, (), False)
    assert result.state == "not run"
    assert result.note == "there is no no-such-program"
    assert checks.summarize([result], strict=False) == 1
    shown = capsys.readouterr().out
    assert "to enable it:  sudo make one" in shown
    assert "to leave it out:  --without faults" in shown


def test_step_that_cannot_run_can_be_left_out_by_name(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(checks.NEEDS, "lint", ("no-such-program", "sudo make one"))
    monkeypatch.setitem(checks.STEPS, "types", "true")
    monkeypatch.setattr(checks, "use_defaults_in_children", lambda: None)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    words = ["run.py", "test", "--only", "lint", "--only", "types"]
    for further, code in (((), 1), (("--without", "lint"), 0)):
        monkeypatch.setattr(sys, "argv", [*words, *further])
        assert checks.main() == code
        assert ("not run: lint" in capsys.readouterr().out) == bool(code)


@pytest.mark.parametrize(
    ("failed", "skipped", "code", "strict_code"),
    [(0, 0, 0, 0), (1, 0, 1, 1), (0, 2, 0, 1)],
)
def test_last_line_has_the_totals(
    capsys: pytest.CaptureFixture[str],
    failed: int,
    skipped: int,
    code: int,
    strict_code: int,
) -> None:
    reasons = [("a.b", "no such tool")] * skipped
    failures = ["a.crc: 3 is not 4"] * failed
    results = [
        checks.Result("unit", 1.0, 3, failed, reasons, failures),
        checks.Result("lint", 1.0, 1),
    ]
    assert checks.summarize(results, strict=False) == code
    *lines, last = capsys.readouterr().out.splitlines()
    assert lines.count("failed: a.crc: 3 is not 4") == failed
    assert sum(line.startswith("skipped: ") for line in lines) == bool(skipped)
    assert last == f"4 passed, {failed} failed, {skipped} skipped", "what CI reads"
    assert checks.summarize(results, strict=True) == strict_code


def test_every_step_is_in_one_tier_and_every_marker_is_run() -> None:
    steps = []
    for tier, lanes in checks.TIERS.items():
        if tier != "prove":  # a step of test-all alone
            steps += [step for lane in lanes for step in lane]
    assert sorted(steps) == sorted(checks.STEPS)
    for place in ("--ignore=tests/vcan", "-p no:cacheprovider tests/vcan"):
        chosen = []
        for step in checks.STEPS.values():
            found = re.search(" -m '?(not extended|extended)", step)
            if place in step and found:
                chosen.append(found[1])
        assert sorted(chosen) == ["extended", "not extended"]


def test_tools_and_slow_run_each_place_once() -> None:
    left_out = set(re.findall(r"--ignore=(\S+)", checks.STEPS["tools"]))
    elsewhere = set(re.findall(r"--ignore=(\S+)", checks.STEPS["unit"]))
    places = set(re.findall(r" (tests/\S+)", checks.STEPS["slow"]))
    assert left_out - elsewhere == places
    assert all((checks.PROJECT / place).exists() for place in places)
    for step in ("tools", "slow"):
        assert "-m 'extended or rights'" in checks.STEPS[step], "CI runs this one as root"


def test_step_may_take_as_long_as_the_page_about_proofs_says() -> None:
    page = (checks.PROJECT / "tests/proofs/README.md").read_text(encoding="utf-8")
    row = r"^\| `make release ARGS=\"--only (\w+)\".*\| (\d+) hours \|$"
    rows = re.findall(row, page, re.MULTILINE)
    assert dict(rows) == {"years": "9"}
    for step, hours in rows:
        assert checks.limit_s("release", step) >= 2 * 3600 * int(hours), "a slower machine, too"


def test_slow_tests_of_the_page_about_time_exist() -> None:
    page = (checks.PROJECT / "tests/README.md").read_text(encoding="utf-8")
    tests = re.findall(r"^\| `(\S+)::(\w+)` \|", page, re.MULTILINE)
    assert len(tests) == 50
    for file, name in tests:
        source = (checks.PROJECT / "tests" / file).read_text(encoding="utf-8")
        assert f"\ndef {name}(" in source, f"tests/README.md: {file}::{name}"
