"""docs/promises.md: each promise and rule of the product, with the tests that hold it.

The rules are in tests/promises.toml. A test names the rules that it holds with the marker
``promise``. The markers are read from the sources, so tests that cannot run here count as well.
"""

import ast
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import indent, wrap
from typing import NamedTuple

TESTS = Path(__file__).resolve().parents[1]
RULES = TESTS / "promises.toml"
PAGE = TESTS.parent / "docs" / "promises.md"
MARKER = "pytest.mark.promise"
MOST_TESTS = 10
"""Tests of one rule. Whoever looks for the test of a rule does not open more."""


class MarkedTest(NamedTuple):
    """One test function, or all tests of a file if it has no name."""

    file: str
    name: str = ""

    def __str__(self) -> str:
        """Return the test as an item of a list."""
        link = f"* [{self.file}](../{self.file})"
        return f"{link}:\n  `{self.name}`" if self.name else link


@dataclass(frozen=True)
class MarkedFile:
    """A file with tests, and the keys of the rules in its markers."""

    name: str
    markers: tuple[tuple[MarkedTest, str], ...]


def read_rules(path: Path = RULES) -> dict[str, dict[str, str]]:
    """Return the text of each rule by title of its group and key."""
    return tomllib.loads(path.read_text(encoding="utf-8"))


def read_markers(name: str, source: str) -> MarkedFile | None:
    """Return a file with its markers, or None if it has no tests."""
    body = ast.parse(source).body
    tests = [each for each in body if isinstance(each, ast.FunctionDef)]
    tests = [each for each in tests if each.name.startswith("test_")]
    if not tests:
        return None
    found = []
    for each in body:
        if isinstance(each, ast.Assign) and ast.unparse(each.targets[0]) == "pytestmark":
            found += [(MarkedTest(name), key) for key in _keys(each.value)]
    for test in tests:
        for decorator in test.decorator_list:
            found += [(MarkedTest(name, test.name), key) for key in _keys(decorator)]
    return MarkedFile(name, tuple(found))


def _keys(node: ast.AST) -> Iterator[str]:
    """Yield the arguments of each marker in an expression."""
    for call in ast.walk(node):
        if isinstance(call, ast.Call) and ast.unparse(call.func) == MARKER:
            yield from map(ast.literal_eval, call.args)


def read_tests(folder: Path = TESTS) -> list[MarkedFile]:
    """Return all files of a folder that have tests. Hidden folders are left out."""
    found = []
    for path in sorted(folder.rglob("*.py")):
        inside = path.relative_to(folder.parent)
        if not any(part.startswith(".") for part in inside.parts):
            file = read_markers(inside.as_posix(), path.read_text(encoding="utf-8"))
            found += [] if file is None else [file]
    return found


def tests_of(files: Sequence[MarkedFile]) -> dict[str, list[MarkedTest]]:
    """Return the tests of each rule."""
    found: dict[str, list[MarkedTest]] = {}
    for file in files:
        for test, key in file.markers:
            found.setdefault(key, []).append(test)
    return found


def list_problems(
    rules: Mapping[str, Mapping[str, str]], files: Sequence[MarkedFile]
) -> Iterator[str]:
    """Yield a line for each rule without a test, and for each test without a rule."""
    tests = tests_of(files)
    keys = [key for group in rules.values() for key in group]
    for key in keys:
        if key not in tests:
            yield f'rule "{key}" has no test. Add {MARKER}("{key}") to the test that holds it.'
        elif len(tests[key]) > MOST_TESTS:
            yield f'rule "{key}" has {len(tests[key])} tests. Divide it into several rules.'
        if keys.count(key) > 1:
            yield f'rule "{key}" is in two groups. Give each its own key.'
    for file in files:
        if not file.markers:
            yield f"{file.name} names no rule. Add pytestmark = {MARKER}(KEY) to it."
        for _, key in file.markers:
            if key not in keys:
                yield f'{file.name} names the rule "{key}". Add it to {RULES.name}.'


def promises_page() -> str:
    """Return the text of docs/promises.md."""
    rules = read_rules()
    files = read_tests()
    tests = tests_of(files)
    count = sum(map(len, rules.values()))
    lines = [
        "# Promises and their tests",
        "",
        "Here you find the test that holds a promise or a rule of the product. A file without the",
        "name of a test holds the rule as a whole. Dialogues of CANopen nodes have a file for each",
        "service in [tests/canopen/dialogues](../tests/canopen/dialogues/README.md).",
        "",
        f"There are {count} rules and {len(files)} files with tests. Each rule has a test, and",
        "each file holds a rule. `make docs` writes this page from `tests/promises.toml` and from",
        "the markers in the tests. `tests/readme/test_promises.py` fails if a rule has no test, or",
        "a file no rule.",
    ]
    for title, group in rules.items():
        lines += ["", f"## {title}", ""]
        for key, text in group.items():
            lines += wrap(f"* **{key}**: {text}", 100, subsequent_indent="  ")
            lines += [indent(str(test), "  ") for test in tests.get(key, ())]
    return "\n".join(lines) + "\n"
