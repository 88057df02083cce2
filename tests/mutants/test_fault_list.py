"""The list of faults fits the present code, and only a failure due to a fault detects it."""

import subprocess
from pathlib import Path
from typing import Any

import put_in_faults
import pytest
from put_in_faults import PROJECT, Fault, faults

pytestmark = pytest.mark.promise("sharp-tests")


@pytest.mark.parametrize("fault", faults(), ids=lambda fault: fault.what)
def test_each_fault_of_the_list_can_be_put_in(fault: Fault) -> None:
    file, changed = fault.put_in()
    assert changed != file.read_text()
    for tests in fault.seen_by:
        path, _, name = tests.partition("::")
        assert (PROJECT / path).exists()
        assert not name or f"def {name}(" in (PROJECT / path).read_text(encoding="utf-8")


@pytest.mark.parametrize(("code", "is_decided"), [(0, True), (1, False), ("no end", False)])
def test_tests_that_fail_without_a_fault_decide_nothing(
    code: int | str,
    is_decided: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(put_in_faults, "tested", lambda *_, **__: code)
    put_in_faults.passed_without_fault.cache_clear()
    problem = faults()[0].control(PROJECT)
    put_in_faults.passed_without_fault.cache_clear()
    assert problem == "" if is_decided else problem.startswith("NOT DECIDED")


@pytest.mark.parametrize(
    ("test", "code"),
    [
        ("tests/esc/test_deframer.py", put_in_faults.FAILED),
        ("tests/proofs/long_eva.py", f"no end within {put_in_faults.LIMIT_S} s"),
        ("tests/plug/power_cuts.py", f"no end within {put_in_faults.LIMIT_S} s"),
    ],
)
def test_a_time_out_detects_a_fault_only_if_the_tests_are_quick(
    test: str,
    code: int | str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def wait_too_long(*_: Any, **__: Any) -> None:
        raise subprocess.TimeoutExpired("pytest", 0)

    monkeypatch.setattr(subprocess, "run", wait_too_long)
    assert put_in_faults.tested(Path(), (test,), False) == code
