"""Names of tests begin with their subject, not with an article.

"test_that_" and the like say nothing either.
"""

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

pytestmark = pytest.mark.promise("plain-english")
TESTS = Path(__file__).resolve().parents[1]
ARTICLES = ("a", "an", "the")
EMPTY_WORDS = ("that", "test", "verify", "ensure")


class Name(NamedTuple):
    """The name of a test function, and its place."""

    place: str
    name: str


def names_of_tests(folder: Path) -> Iterator[Name]:
    """Yield the test functions below a folder. Names of files that begin with a dot are skipped."""
    for path in sorted(folder.rglob("*.py")):
        relative = path.relative_to(folder)
        if any(part.startswith(".") for part in relative.parts):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            match node:
                case ast.FunctionDef(name=name) if name.startswith("test_"):
                    yield Name(f"{relative}:{node.lineno}", name)


def fault_of(name: str) -> str:
    """Return what is wrong with the name of a test, or ""."""
    first = name.split("_")[1] if "_" in name else ""
    if first in ARTICLES:
        return f'begins with the article "{first}". Begin with the subject.'
    if first in EMPTY_WORDS:
        return f'begins with "{first}". Begin with the subject.'
    return ""


def test_names_of_tests_begin_with_their_subject() -> None:
    wrong = []
    for place, name in names_of_tests(TESTS):
        fault = fault_of(name)
        if fault:
            wrong.append(f"tests/{place}: {name} {fault}")
    assert not wrong, f"{len(wrong)} names"


def test_names_in_a_module_differ() -> None:
    """A second test with the same name in a file would silently replace the first one."""
    places: dict[tuple[str, str], list[str]] = {}
    for place, name in names_of_tests(TESTS):
        file = place.partition(":")[0]
        places.setdefault((file, name), []).append(place)
    assert not [found for found in places.values() if len(found) > 1]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("test_id_conflict_is_reported_once_and_cleared", ""),
        ("test_an_id_conflict_is_reported_once", 'the article "an"'),
        ("test_a_lost_port_is_opened_again", 'the article "a"'),
        ("test_the_loop_ends", 'the article "the"'),
        ("test_that_loop_ends", 'begins with "that"'),
    ],
)
def test_wrong_names_are_found(name: str, said: str) -> None:
    assert said in fault_of(name)
    assert bool(said) == bool(fault_of(name))
