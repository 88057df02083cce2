"""The list of faults fits the present code, and only a failure due to a fault detects it."""

import ast
import re
import subprocess
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

import put_in_faults
import pytest
from put_in_faults import PROJECT, Fault, faults

pytestmark = pytest.mark.promise("sharp-tests")


def without_layout(file: Path) -> str:
    """Return the text of a file. Python is written from its syntax tree, as faults are."""
    text = file.read_text(encoding="utf-8")
    return ast.unparse(ast.parse(text)) if file.suffix == ".py" else text


PLAIN = """
class Port:
    def read(self, now):
        \"\"\"Read.\"\"\"
        if now - self.last > self.timeout:
            return b""
        return self.take(now)
"""
REWORDED = """
class Port:
    \"\"\"A port.\"\"\"

    def read(self, now: int) -> bytes:
        \"\"\"Return the bytes of the port.\"\"\"
        if (
            now - self.last  # the pause
            > self.timeout
        ):
            return b""
        return self.take(now)
"""


@pytest.mark.parametrize("text", [PLAIN, REWORDED], ids=["plain", "reworded"])
@pytest.mark.parametrize(
    ("find", "replace", "changed"),
    [
        ("self.timeout", "2 * self.timeout", "> 2 * self.timeout:"),
        ("self.take(now)", "b''", "return b''"),
        ("return self.take(now)", "now = 0\nreturn self.take(now)", "now = 0"),
    ],
)
def test_comments_docstrings_and_line_ends_do_not_count(
    text: str, find: str, replace: str, changed: str
) -> None:
    fault = Fault("", "port.py: Port.read", find, replace)
    assert changed in put_in_faults.changed_python(text, "Port.read", fault)


def test_comment_and_white_space_in_c_do_not_count() -> None:
    text = "static int f(int a)\n{\n    return a /* bytes */\n        + 1;\n}\n"
    fault = Fault("", "core.c: f", "return a + 1;", "return a + 2;")
    assert "return a + 2;" in put_in_faults.changed_text(text, "f", fault)


@pytest.mark.parametrize(
    ("function", "find", "nth", "problem"),
    [
        ("Port.write", "now", 0, "there is no write"),
        ("Port.read", "now", 0, "2 places have `now`, and exactly one is needed"),
        ("Port.read", "now", 3, "2 places have `now`, and number 3 is needed"),
        ("Port.read", "later", 0, "0 places have `later`"),
    ],
)
def test_fault_that_does_not_fit_names_its_place(
    function: str, find: str, nth: int, problem: str
) -> None:
    fault = Fault("", f"port.py: {function}", find, "0", nth=nth)
    with pytest.raises(ValueError, match=problem):
        put_in_faults.changed_python(PLAIN, function, fault)


@pytest.mark.parametrize("fault", faults(), ids=lambda fault: fault.what)
def test_each_fault_of_the_list_can_be_put_in(fault: Fault) -> None:
    file, changed = fault.put_in()
    assert changed not in (file.read_text(), without_layout(file))
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
def test_time_out_detects_a_fault_only_if_the_tests_are_quick(
    test: str,
    code: int | str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def wait_too_long(*_: Any, **__: Any) -> None:
        raise subprocess.TimeoutExpired("pytest", 0)

    monkeypatch.setattr(subprocess, "run", wait_too_long)
    assert put_in_faults.tested(Path(), (test,), False) == code


@pytest.mark.parametrize(
    ("words", "test"),
    [
        ("of the deframer", "proofs/test_small_scope.py"),
        ("of the packer", "proofs/test_every_value.py"),
        ("of both cores", "proofs/test_years.py"),
        ("of the code that writes files", "plug/power_cuts.py"),
        ("for the proof of instructions", "proofs/long_worst_case.py"),
        ("for the proof of no undefined behaviour", "proofs/long_eva.py"),
    ],
)
def test_readme_states_the_number_of_faults(words: str, test: str) -> None:
    files = Counter(name.partition("::")[0] for fault in faults() for name in fault.seen_by)
    assert stated_count(words) == files[f"tests/{test}"]


def test_readme_states_the_number_of_faults_of_the_compiler() -> None:
    path = PROJECT / "tests/mutants/plan_faults.toml"
    assert stated_count("of the compiler") == len(tomllib.loads(path.read_text())["fault"])


def stated_count(words: str) -> int:
    """Return the number of faults that the page about the proofs states."""
    page = (PROJECT / "tests/proofs/README.md").read_text(encoding="utf-8")
    (count,) = re.findall(rf"(\d+)\sfaults\s{words}\b", page)
    return int(count)
