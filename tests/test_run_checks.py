"""What ``make test`` makes of tests that fail: a few of them are run once more, and that is told."""

import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

CASE = '<testcase classname="tests.vcan.test_x" name="{name}">{what}</testcase>'


@pytest.fixture(scope="module")
def run() -> ModuleType:
    spec = importlib.util.spec_from_file_location("run_checks", Path(__file__).parent / "run.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look there
    spec.loader.exec_module(module)
    return module


class Runs:
    """Stands for pytest: each run finds what the next of ``rounds`` says, test by test."""

    def __init__(self, *rounds: dict[str, bool]) -> None:
        self.rounds = list(rounds)
        self.commands: list[Sequence[str]] = []

    def __call__(self, command: Sequence[str], *_others: Any, **_options: Any) -> int:
        self.commands.append(command)
        found = self.rounds.pop(0)
        cases = [CASE.format(name=name, what="" if good else "<failure/>") for name, good in found.items()]
        Path(command[-1].removeprefix("--junitxml=")).write_text(f"<testsuite>{''.join(cases)}</testsuite>")
        return int(not all(found.values()))


def result(run: ModuleType, monkeypatch: pytest.MonkeyPatch, folder: Path, runs: Runs, *arguments: str) -> Any:
    monkeypatch.setattr(run, "call", runs)
    return run.pytest("vcan", ["pytest"], ["tests/vcan"], arguments, folder / "vcan.xml", {})


def test_a_test_that_passes_alone_is_named(run: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    runs = Runs({"a": True, "b[1-x]": False, "c": True}, {"b[1-x]": True})
    found = result(run, monkeypatch, tmp_path, runs)
    assert found.state == "passed"
    assert (found.suite.passed, found.suite.failed) == (3, 0)
    assert runs.commands[0][1:-1] == ["tests/vcan"]
    assert runs.commands[1][1:-1] == ["tests/vcan/test_x.py::b[1-x]"]
    assert "1 at the second attempt: tests/vcan/test_x.py::b[1-x]" in found.detail


def test_one_that_fails_again_has_failed(run: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = result(run, monkeypatch, tmp_path, Runs({"a": False, "b": False}, {"a": True, "b": False}))
    assert found.state == "FAILED"
    assert (found.suite.passed, found.suite.failed) == (1, 1)


def test_one_that_is_not_found_again_has_failed(
    run: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    found = result(run, monkeypatch, tmp_path, Runs({"a": False, "b": True}, {}))
    assert found.state == "FAILED"
    assert (found.suite.passed, found.suite.failed) == (1, 1)


def test_more_than_a_few_are_not_repeated(run: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = result(run, monkeypatch, tmp_path, Runs(dict.fromkeys("abcde", False)))
    assert (found.state, found.suite.failed) == ("FAILED", 5)


def test_who_picks_tests_sees_them_once(run: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = result(run, monkeypatch, tmp_path, Runs({"a": False}), "-k", "a")
    assert (found.state, found.suite.failed) == ("FAILED", 1)


def test_all_good_is_run_once(run: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = result(run, monkeypatch, tmp_path, Runs({"a": True}))
    assert (found.state, found.detail) == ("passed", "1 passed, 0 failed, 0 skipped")
