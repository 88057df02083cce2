"""Each promise and rule of the product has a test, and each file with tests holds a rule."""

import pytest
from promises import PAGE, list_problems, promises_page, read_markers, read_rules, read_tests

pytestmark = pytest.mark.promise("docs")

RULES = {"Group": {"one": "A rule.", "two": "Another rule."}}
MARKED = """
import pytest

pytestmark = [pytest.mark.promise("one"), pytest.mark.extended]

@pytest.mark.promise("two", "three")
def test_thing():
    pass
"""


def test_each_rule_has_a_test_and_each_file_a_rule() -> None:
    assert list(list_problems(read_rules(), read_tests())) == []


def test_page_is_made_from_rules_and_markers() -> None:
    assert PAGE.read_text(encoding="utf-8") == promises_page(), "run: make docs"


def test_markers_of_files_and_of_tests_are_read() -> None:
    file = read_markers("samples/test_a.py", MARKED)
    assert file is not None
    found = [(str(test), key) for test, key in file.markers]
    link = "* [samples/test_a.py](../samples/test_a.py)"
    named = f"{link}:\n  `test_thing`"
    assert found == [(link, "one"), (named, "two"), (named, "three")]
    assert read_markers("samples/helper.py", "def make(): pass") is None


def test_missing_test_and_a_missing_rule_are_named() -> None:
    marked = read_markers("samples/test_a.py", MARKED.replace('"two", ', ""))
    bare = read_markers("samples/test_b.py", "def test_b(): pass")
    assert marked is not None
    assert bare is not None
    assert list(list_problems(RULES, [marked, bare])) == [
        'rule "two" has no test. Add pytest.mark.promise("two") to the test that holds it.',
        'samples/test_a.py names the rule "three". Add it to promises.toml.',
        "samples/test_b.py names no rule. Add pytestmark = pytest.mark.promise(KEY) to it.",
    ]


def test_rule_with_too_many_tests_or_two_groups_is_named() -> None:
    many = []
    for number in range(11):
        file = read_markers(f"tests/test_{number}.py", MARKED.replace(', "three"', ""))
        assert file is not None
        many.append(file)
    twice = {"First": {"one": "A rule."}, "Second": {"two": "Another.", "one": "Again."}}
    problems = set(list_problems(twice, many))
    assert 'rule "two" has 11 tests. Divide it into several rules.' in problems
    assert 'rule "one" is in two groups. Give each its own key.' in problems
