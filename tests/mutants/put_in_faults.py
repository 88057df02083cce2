"""Puts each fault of faults.toml into the code and runs the tests that must see it, each in a process of its own (mutants.py).

    python tests/mutants/put_in_faults.py [WORDS...]

WORDS choose the faults whose text has one of them. The working tree is not touched. Exits with 0 if all faults were caught;
with 1 and one line each for those that were not, or cannot be put in any more because the code is another one.
"""

import argparse
import functools
import re
import sys
import textwrap
import tomllib
from dataclasses import dataclass
from pathlib import Path

import mutants
from mutants import PROJECT
from mutations import Mutation

LIST = Path(__file__).with_name("faults.toml")
PACKAGE = PROJECT / "kontronik_can_gw"


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

    def put_in(self) -> tuple[Path, str]:
        """The file it is in and the text that this is to have. ValueError where it cannot be put in."""
        found = [
            (file, match)
            for file in PACKAGE.rglob("*.py")
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

    def problem(self) -> str:
        """What is wrong with it; nothing if a test fails with it."""
        try:
            file, changed = self.put_in()
        except ValueError as error:
            return str(error)
        mutant = Mutation.of_text(file.relative_to(PROJECT), changed)
        seconds = unmutated(self.seen_by)["seconds"]
        return "" if mutants.fails(mutant, self.seen_by, seconds) else "NOT CAUGHT"


unmutated = functools.cache(mutants.unmutated)


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
    mutants.settle()
    chosen = [each for each in faults() if not words or any(word in each.what for word in words)]
    wrong = 0
    for fault in chosen:
        problem = fault.problem()
        wrong += bool(problem)
        print(f"{problem or 'caught'}: {fault.what}  [{' '.join(fault.seen_by)}]", flush=True)
    print(f"{len(chosen) - wrong} of {len(chosen)} faults caught")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
