"""Puts each fault of faults.toml into a copy of the project and runs the tests there that must see it.

    python tests/mutants/put_in_faults.py [WORDS...]

WORDS choose the faults whose text has one of them. Exits with 0 if all faults were caught; with 1 and one line each for those that
were not, or cannot be put in any more because the code is another one.
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
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2]
LIST = Path(__file__).with_name("faults.toml")
LIMIT_S = 1800
FAILED = 1
"""Of pytest: some test has failed. Everything else, as a collection that breaks off, judges nothing."""


@dataclass(frozen=True)
class Fault:
    what: str
    search: str
    replace: str
    seen_by: tuple[str, ...]

    def put_in(self, project: Path = PROJECT) -> tuple[Path, str]:
        """The file it is in and the text that this is to have. ValueError where it cannot be put in."""
        # with any white space
        pattern = re.compile(r"\s+".join(map(re.escape, self.search.split())))
        files = (project / "kontronik_can_gw").rglob("*.py")
        found = [(file, match) for file in files for match in pattern.finditer(file.read_text())]
        if len(found) != 1:
            raise ValueError(
                f"its text stands in {len(found)} places instead of one: write it anew for the present code"
            )
        file, match = found[0]
        text = match.string
        margin = " " * (match.start() - text.rfind("\n", 0, match.start()) - 1)
        put_in = textwrap.indent(self.replace.strip("\n"), margin).removeprefix(margin)
        changed = text[: match.start()] + put_in + text[match.end() :]
        try:
            compile(changed, file.name, "exec")
        except SyntaxError as error:
            raise ValueError(f"with it {file.name} is no Python: {error}") from None
        return file, changed

    def problem(self, copy: Path) -> str:
        """What is wrong with it; nothing if a test fails with it, and with nothing else."""
        try:
            file, changed = self.put_in(copy)
        except ValueError as error:
            return str(error)
        whole = file.read_text()
        try:
            file.write_text(changed)
            code = tested(copy, self.seen_by)
        finally:
            file.write_text(whole)
        return "" if code == FAILED else f"NOT CAUGHT (pytest: {code})"


def tested(copy: Path, tests: tuple[str, ...]) -> int | str:
    """pytest's exit code in the copy; what is changed is Python, so the core is too."""
    words = ["-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-n", "0", "--tb=no"]
    command = [sys.executable, *words, "-m", "not extended", *tests]
    environment = {**os.environ, "KONTRONIK_PURE": "1", "PYTHONPATH": str(copy)}
    environment["PYTHONDONTWRITEBYTECODE"] = "1"
    try:
        done = subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, timeout=LIMIT_S
        )
    except subprocess.TimeoutExpired:
        return FAILED  # the fault lets a test wait for ever
    return done.returncode


def faults(path: Path = LIST) -> list[Fault]:
    """The faults of a list. ValueError for one that is not whole."""
    listed = tomllib.loads(path.read_text())["fault"]
    for number, each in enumerate(listed):
        if set(each) != {"what", "search", "replace", "seen_by"} or not each["seen_by"]:
            raise ValueError(
                f"{path.name}: fault {number + 1} needs what, search, replace, seen_by, and nothing else"
            )
    return [Fault(**each | {"seen_by": tuple(each["seen_by"])}) for each in listed]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("words", nargs="*", metavar="WORDS")
    words = parser.parse_args().words
    chosen = [each for each in faults() if not words or any(word in each.what for word in words)]
    wrong = 0
    with tempfile.TemporaryDirectory(prefix="kcg-faults.") as folder:
        copy = Path(folder, "project")
        left_out = shutil.ignore_patterns(".git", ".venv", ".cache", "__pycache__", "build")
        shutil.copytree(PROJECT, copy, ignore=left_out)
        for fault in chosen:
            problem = fault.problem(copy)
            wrong += bool(problem)
            print(f"{problem or 'caught'}: {fault.what}  [{' '.join(fault.seen_by)}]", flush=True)
    print(f"{len(chosen) - wrong} of {len(chosen)} faults caught")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
