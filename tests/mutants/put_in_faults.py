"""Puts each fault of faults.toml into a copy of the project and runs the tests that must see it.

    python tests/mutants/put_in_faults.py [WORDS...]

WORDS choose the faults whose text has one of them. The working tree is not touched. Exits with 0 if all faults were caught;
with 1 and one line each for those that were not, or cannot be put in any more because the code is another one.
"""

import argparse
import os
import re
import resource
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
NOT_COPIED = (
    ".git",
    ".venv",
    ".cache",
    ".*_cache",
    ".hypothesis",
    "__pycache__",
    "node_modules",
    "build",
    "dist",
)
LIMIT_FACTOR, MIN_LIMIT_S = 20, 60
"""CPU time for tests with a fault, in proportion to that without."""
BLOCKED_S = 900
FAILED, BROKEN_AT_IMPORT = 1, 2  # pytest's


@dataclass(frozen=True)
class Fault:
    what: str
    search: str
    replace: str
    seen_by: tuple[str, ...]

    @property
    def pattern(self) -> re.Pattern[str]:
        """The text with any white space."""
        return re.compile(r"\s+".join(map(re.escape, self.search.split())))

    def put_in(self, package: Path) -> tuple[Path, str]:
        """The file it is in and the text that this is to have. ValueError where it cannot be put in."""
        found = [
            (file, match)
            for file in package.rglob("*.py")
            for match in self.pattern.finditer(file.read_text())
        ]
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


def faults(path: Path = LIST) -> list[Fault]:
    """The faults of a list. ValueError for one that is not whole."""
    listed = tomllib.loads(path.read_text())["fault"]
    for number, each in enumerate(listed):
        if set(each) != {"what", "search", "replace", "seen_by"} or not each["seen_by"]:
            raise ValueError(
                f"{path.name}: fault {number + 1} needs what, search, replace, seen_by, and nothing else"
            )
    return [
        Fault(each["what"], each["search"], each["replace"], tuple(each["seen_by"]))
        for each in listed
    ]


def run(tests: tuple[str, ...], folder: Path, limit_s: float) -> tuple[int, float]:
    """pytest's status in a copy of the project, and the CPU time it took."""
    options = ["-x", "-q", "-p", "no:cacheprovider", "--tb=no", "-m", "not extended"]
    command = [sys.executable, "-m", "pytest", *options, *tests]
    environment = {
        **os.environ,
        "PYTHONPATH": str(folder),
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONHASHSEED": "0",
    }
    before = _children_s()
    process = subprocess.run(
        command,
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        timeout=BLOCKED_S,
        preexec_fn=lambda: resource.setrlimit(
            resource.RLIMIT_CPU, (int(limit_s), int(limit_s) + 5)
        ),
        check=False,
    )
    return process.returncode, _children_s() - before


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


class Copy:
    """A copy of the project. ``try_out`` says what is wrong, None if a fault was caught."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "project"
        shutil.copytree(PROJECT, self.folder, ignore=shutil.ignore_patterns(*NOT_COPIED))
        self._limits: dict[tuple[str, ...], float] = {}

    def try_out(self, fault: Fault) -> str | None:
        try:
            file, changed = fault.put_in(self.folder / "kontronik_can_gw")
        except ValueError as error:
            return str(error)
        if fault.seen_by not in self._limits:
            status, seconds = run(fault.seen_by, self.folder, BLOCKED_S)
            self._limits[fault.seen_by] = 0 if status else max(MIN_LIMIT_S, LIMIT_FACTOR * seconds)
        if not (limit := self._limits[fault.seen_by]):
            return f"{' '.join(fault.seen_by)}: the tests fail without it"
        whole = file.read_text()
        file.write_text(changed)
        try:
            status, _ = run(fault.seen_by, self.folder, limit)
        except subprocess.TimeoutExpired:
            return "not decided: the tests wait for something"
        finally:
            file.write_text(whole)
        return None if status in (FAILED, BROKEN_AT_IMPORT) or status < 0 else "NOT CAUGHT"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("words", nargs="*", metavar="WORDS")
    options = parser.parse_args()
    chosen = [
        fault
        for fault in faults()
        if not options.words or any(word in fault.what for word in options.words)
    ]
    wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder))
        for fault in chosen:
            problem = copy.try_out(fault)
            wrong += problem is not None
            print(
                f"{'caught' if problem is None else problem}: {fault.what}  [{' '.join(fault.seen_by)}]",
                flush=True,
            )
    print(f"{len(chosen) - wrong} of {len(chosen)} faults caught")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
