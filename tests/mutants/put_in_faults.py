"""Puts each fault of faults.toml into a copy of the project and runs the tests that must detect it.

    python tests/mutants/put_in_faults.py [WORDS...]

WORDS select the faults whose description contains one of them. A fault can be in a Python file, in
a C source or in a systemd unit of kontronik_can_gw. Exits with 0 if the tests detected every fault,
else with 1 and one line for each fault that they missed or that no longer fits the code. The tests
of a fault must pass without it: otherwise their failure says nothing. If `seen_by` names one test
of a file ("file.py::test"), this test itself must fail: an error of a fixture or of a tool does not
count. If the tests are slow, a run without an end does not count, either.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import textwrap
import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2]
LIST = Path(__file__).with_name("faults.toml")
LIMIT_S = 1800
FAILED = 1
"""The exit code of pytest if a test failed. Any other code proves nothing."""
SLOW = ("tests/proofs", "tests/plug")
"""Tests that need minutes. If they do not end in time, that says nothing about a fault."""
SUFFIXES = (".py", ".c", ".h", ".service")
"""The kinds of files that can have a fault."""
IN_C = (".c", ".h")


@dataclass(frozen=True)
class Fault:
    what: str
    search: str
    replace: str
    seen_by: tuple[str, ...]

    def put_in(self, project: Path = PROJECT) -> tuple[Path, str]:
        """Return the file and its text with the fault. ValueError if it does not fit the code."""
        # any white space may be between the words
        pattern = re.compile(r"\s+".join(map(re.escape, self.search.split())))
        folder = project / "kontronik_can_gw"
        found = []
        for file in folder.rglob("*"):
            if file.suffix in SUFFIXES:
                found += [(file, match) for match in pattern.finditer(file.read_text())]
        if len(found) != 1:
            raise ValueError(
                f"its text is in {len(found)} places instead of one: "
                "write it again for the present code"
            )
        file, match = found[0]
        text = match.string
        line_start = text.rfind("\n", 0, match.start()) + 1
        margin = " " * (match.start() - line_start)
        put_in = textwrap.indent(self.replace.strip("\n"), margin).removeprefix(margin)
        changed = text[: match.start()] + put_in + text[match.end() :]
        if file.suffix == ".py":
            try:
                compile(changed, file.name, "exec")
            except SyntaxError as error:
                raise ValueError(f"with it {file.name} is no Python: {error}") from None
        return file, changed

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
        if set(each) != {"what", "search", "replace", "seen_by"} or not each["seen_by"]:
            raise ValueError(
                f"{path.name}: fault {number + 1} needs what, search, replace, seen_by, "
                "and nothing else"
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
