"""Puts each fault of faults.toml into a copy of the project and runs the tests that must detect it.

    python tests/mutants/put_in_faults.py [WORDS...]

WORDS select the faults whose description contains one of them. A fault names a function in a Python
file or a C source, or a systemd unit, and a small edit of it. Exits with 0 if the tests detected
every fault, else with 1 and one line for each fault that they missed or that no longer fits the
code. The tests of a fault must pass without it: otherwise their failure says nothing. If `seen_by`
names one test of a file ("file.py::test"), this test itself must fail: an error of a fixture or of
a tool does not count. If the tests are slow, a run without an end does not count, either.
"""

import argparse
import ast
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeVar

PROJECT = Path(__file__).resolve().parents[2]
LIST = Path(__file__).with_name("faults.toml")
LIMIT_S = 1800
FAILED = 1
"""The exit code of pytest if a test failed. Any other code proves nothing."""
SLOW = ("tests/proofs", "tests/plug")
"""Tests that need minutes. If they do not end in time, that says nothing about a fault."""
IN_C = (".c", ".h")
WHITE = r"(?:\s|/\*.*?\*/)+"
"""White space and comments of C."""
T = TypeVar("T")


@dataclass(frozen=True)
class Fault:
    what: str
    place: str
    """A file below kontronik_can_gw, or "file: function", or "file: Class.method"."""
    find: str
    """An expression or statements of that place. In C and units: a text of that place."""
    replace: str
    seen_by: tuple[str, ...] = ()
    nth: int = 0
    """The number of the occurrence, from 1. 0: there must be only one."""

    def put_in(self, project: Path = PROJECT) -> tuple[Path, str]:
        """Return the file and its text with the fault. ValueError if it does not fit the code.

        In Python, syntax trees are compared, so comments, docstrings and line ends do not count. In
        C and in units, white space and comments do not count.
        """
        name, _, function = self.place.partition(": ")
        file = project / "kontronik_can_gw" / name
        if not file.is_file():
            raise ValueError(f"{name} does not exist")
        edit = changed_python if file.suffix == ".py" else changed_text
        return file, edit(file.read_text(encoding="utf-8"), function, self)

    def chosen(self, found: Sequence[T]) -> T:
        """Return the occurrence that is meant."""
        if self.nth > len(found) or (not self.nth and len(found) != 1):
            wanted = f"number {self.nth}" if self.nth else "exactly one"
            raise ValueError(
                f"{self.place}: {len(found)} places have `{self.find.strip()}`, and {wanted} is "
                "needed. Write the fault for the present code."
            )
        return found[self.nth - 1]

    def control(self, copy: Path) -> str:
        """Return why the tests prove nothing, or "" if they pass without the fault."""
        try:
            file, _ = self.put_in(copy)
        except ValueError:
            return ""  # `problem` reports it
        code = passed_without_fault(copy, self.seen_by, file.suffix in IN_C)
        return "" if code == 0 else f"NOT DECIDED, its tests fail without it (pytest: {code})"

    def problem(self, copy: Path) -> str:
        """Return why the fault is not detected, or "" if a test fails with it."""
        try:
            file, changed = self.put_in(copy)
        except ValueError as error:
            return str(error)
        is_in_c = file.suffix in IN_C
        whole = file.read_text()
        try:
            file.write_text(changed)
            if is_in_c and not is_compiled(copy):
                return f"with it {file.name} does not compile"
            code = tested(copy, self.seen_by, core_in_c=is_in_c)
        finally:
            file.write_text(whole)
            if is_in_c:
                is_compiled(copy)
        return "" if code == FAILED else f"NOT CAUGHT (pytest: {code})"


def changed_python(text: str, function: str, fault: Fault) -> str:
    """Return Python code with the fault in a function."""
    tree = ast.parse(text)
    scope: ast.AST = tree
    for name in filter(None, function.split(".")):
        inside = [each for each in ast.walk(scope) if getattr(each, "name", "") == name]
        if not inside:
            raise ValueError(f"{fault.place}: there is no {name}")
        scope = inside[0]
    wanted = ast.parse(fault.find.strip()).body
    replacement = ast.parse(fault.replace.strip()).body
    if len(wanted) == 1 and isinstance(wanted[0], ast.Expr):
        expression = wanted[0].value
        found = _equal_expressions(scope, expression)
        if found and isinstance(replacement[0], ast.Expr) and len(replacement) == 1:
            parent, key, index = fault.chosen(found)
            _put(parent, key, index, replacement[0].value)
            return ast.unparse(tree)
    body, start = fault.chosen(_equal_statements(scope, wanted))
    body[start : start + len(wanted)] = replacement
    return ast.unparse(ast.fix_missing_locations(tree))


def _equal_expressions(scope: ast.AST, wanted: ast.expr) -> list[tuple[ast.AST, str, int | None]]:
    """Return the places of expressions that are equal, in the order of the text."""
    dumped = ast.dump(wanted)
    found: list[tuple[int, int, ast.AST, str, int | None]] = []
    for parent in ast.walk(scope):
        for key, value in ast.iter_fields(parent):
            children = list(enumerate(value)) if isinstance(value, list) else [(None, value)]
            for index, child in children:
                if isinstance(child, type(wanted)) and ast.dump(child) == dumped:
                    found.append((child.lineno, child.col_offset, parent, key, index))
    found.sort(key=lambda each: each[:2])
    return [(parent, key, index) for _, _, parent, key, index in found]


def _put(parent: ast.AST, key: str, index: int | None, node: ast.expr) -> None:
    """Put an expression into the tree."""
    if index is None:
        setattr(parent, key, node)
    else:
        getattr(parent, key)[index] = node


def _equal_statements(
    scope: ast.AST, wanted: Sequence[ast.stmt]
) -> list[tuple[list[ast.stmt], int]]:
    """Return the lists of statements, and the positions in them, that have these statements."""
    dumped = [ast.dump(each) for each in wanted]
    found = []
    for parent in ast.walk(scope):
        for _, value in ast.iter_fields(parent):
            if isinstance(value, list) and value and isinstance(value[0], ast.stmt):
                texts = [ast.dump(each) for each in value]
                for start in range(len(value) - len(wanted) + 1):
                    if texts[start : start + len(wanted)] == dumped:
                        found.append((value[start].lineno, value, start))
    found.sort(key=lambda each: each[0])
    return [(value, start) for _, value, start in found]


def changed_text(text: str, function: str, fault: Fault) -> str:
    """Return the text of a C source or a unit with the fault in a function."""
    start, end = 0, len(text)
    if function:
        head = re.search(rf"^\w[^;{{}}=]*?\b{function}\([^;{{}}]*?\)\s*\{{", text, re.MULTILINE)
        if head is None:
            raise ValueError(f"{fault.place}: there is no {function}")
        start = head.start()
        end = text.index("\n}", head.end())
    pattern = re.compile(WHITE.join(map(re.escape, fault.find.split())))
    match = fault.chosen(list(pattern.finditer(text, start, end)))
    return text[: match.start()] + fault.replace.strip("\n") + text[match.end() :]


def is_compiled(copy: Path) -> bool:
    """Compile the core in C of the copy. False if the compiler refuses it."""
    command = [sys.executable, "-m", "kontronik_can_gw.native.compile"]
    done = subprocess.run(command, cwd=copy, env=environment_of(copy), capture_output=True)
    return done.returncode == 0


def environment_of(copy: Path, core_in_c: bool = False) -> dict[str, str]:
    """Return the environment in which Python imports the copy instead of the project."""
    return {
        **os.environ,
        "KONTRONIK_PURE": "0" if core_in_c else "1",
        "PYTHONPATH": str(copy),
        "PYTHONDONTWRITEBYTECODE": "1",
    }


def tested(copy: Path, tests: tuple[str, ...], core_in_c: bool) -> int | str:
    """Run the tests in the copy and return pytest's exit code.

    With a fault in Python the core is in Python too, except in tests that choose the core.
    """
    words = ["-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-n", "0", "--tb=no"]
    command = [sys.executable, *words, "-m", "not extended", *tests]
    environment = environment_of(copy, core_in_c)
    is_one_test = any("::" in name for name in tests)
    try:
        done = subprocess.run(
            command,
            cwd=copy,
            env=environment,
            capture_output=True,
            timeout=LIMIT_S,
        )
    except subprocess.TimeoutExpired:
        if any(test.startswith(SLOW) for test in tests):
            return f"no end within {LIMIT_S} s"
        return FAILED  # the fault lets a test wait for ever
    if is_one_test and done.returncode and not re.search(r"\b\d+ failed\b", done.stdout.decode()):
        return f"{done.returncode}, but the test did not fail"
    return done.returncode


@cache
def passed_without_fault(copy: Path, tests: tuple[str, ...], core_in_c: bool) -> int | str:
    """Run the tests once in the copy without a fault and return pytest's exit code."""
    return tested(copy, tests, core_in_c)


def faults(path: Path = LIST) -> list[Fault]:
    """Return the faults of a list. ValueError if one of them is incomplete."""
    listed = tomllib.loads(path.read_text())["fault"]
    for number, each in enumerate(listed):
        needed = {"what", "place", "find", "replace", "seen_by"}
        if set(each) - {"nth"} != needed or not each["seen_by"]:
            raise ValueError(
                f"{path.name}: fault {number + 1} needs what, place, find, replace, seen_by, "
                "and perhaps nth"
            )
    return [Fault(**each | {"seen_by": tuple(each["seen_by"])}) for each in listed]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("words", nargs="*", metavar="WORDS")
    words = parser.parse_args().words
    chosen = faults()
    if words:
        chosen = [fault for fault in chosen if any(word in fault.what for word in words)]
    wrong = 0
    with tempfile.TemporaryDirectory(prefix="kcg-faults.") as folder:
        copy = Path(folder, "project")
        left_out = shutil.ignore_patterns(".git", ".venv", ".cache", "__pycache__", "build")
        shutil.copytree(PROJECT, copy, ignore=left_out)
        for fault in chosen:
            problem = fault.control(copy) or fault.problem(copy)
            wrong += bool(problem)
            print(f"{problem or 'caught'}: {fault.what}  [{' '.join(fault.seen_by)}]", flush=True)
    print(f"{len(chosen) - wrong} of {len(chosen)} faults caught")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
