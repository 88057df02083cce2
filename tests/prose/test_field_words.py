"""Prose uses the terms of the field, not words of our own (field_words.py)."""

from pathlib import Path

import pytest
from field_words import find, find_in_text

pytestmark = pytest.mark.promise("plain-english")


def test_prose_uses_the_terms_of_the_field() -> None:
    assert not [str(found) for found in find(["."])]


@pytest.mark.parametrize(
    ("path", "text", "said"),
    [
        ("docs/a.md", "A time-out.", 'docs/a.md:1: "time-out". Write: timeout.'),
        ("docs/a.md", "```\na time-out\n```\n`time-out` [x](time-out.md)", ""),
        ("docs/a.md", "\nThe SDO answer", 'docs/a.md:2: "SDO answer". Write: SDO response.'),
        ("docs/a.md", "a data ID, E2EDataId", ""),
        ("docs/a.md", "at 99 % of them", 'docs/a.md:1: "99 %". Write: p99.'),
        ("docs/a.md", "a page for phones", ""),
        ("tests/dbc/a.py", "# each page", "multiplexer value, multiplexed group"),
        ("tests/dbc/a.py", "page = 1  # of a UART", ""),
        ("a.py", 'raise Error(f"{name}: a loss of power")', "power loss"),
        ("a.py", 'key = "data id"', ""),
        ("a.py", "# in turn, it turns off", ""),
        ("a.py", "# in the same turn", "iteration"),
        ("a.py", '"""``a data id`` is code."""', ""),
        ("a.c", "int time; /* the minimum distance */", "minimum delay time"),
        ("a.toml", 'a = "the obvious program"  # 1', "baseline program"),
    ],
)
def test_old_words_are_found_in_prose_only(path: str, text: str, said: str) -> None:
    found = [str(each) for each in find_in_text(text, Path(path))]
    assert len(found) == bool(said)
    assert all(said in each for each in found)
