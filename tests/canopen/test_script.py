"""The reader and player of dialogues: tables, texts, parts, and that nothing passes that is not as written."""

from pathlib import Path

import pytest
from dialogue import bench_of
from script import play_lines, read_dialogues

RIGHT = """
    0 <- 601 40 00 10 00 00*
    0 -> 581 43 .. 10 00 00*
 1000 -> 701 7F
 1500 -
"""
SAID = [
    (" 1000 -> 701 7F\n", "", "after a.txt:3: expected 'nothing', got '1000 -> 701 7F'"),
    ("43 .. 10 00 00*", "43 .. 10 00", "a.txt:3: expected '0 -> 581 43 .. 10 00', got"),
    ("1500 -", "2000 -> 701 7F\n 2001 -> 701 7F", "a.txt:6: expected '2001 -> 701 7F', got 'nothing'"),
    ("1500 -", "1500 write 1 1000:00 00", "got '1500 write 1 1000:00 00 ! 06010002'"),
    ("1500 -", "900 -", "a.txt:5: lines are not in the order of time"),
    ("1500 -", "1500 jump about", "what is 'jump about'?"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "said"), SAID)
def test_what_is_not_as_written_is_named_by_its_place(old: str, new: str, said: str) -> None:
    for text in (RIGHT, RIGHT.replace(old, new)):
        lines = [(f"a.txt:{n}", line) for n, line in enumerate(text.splitlines(), 1)]
        if text == RIGHT:
            play_lines(bench_of(["heartbeat"]), lines)
            continue
        with pytest.raises(AssertionError) as caught:
            play_lines(bench_of(["heartbeat"]), lines)
        assert said in str(caught.value)


def test_rows_texts_and_parts_are_worked_in(tmp_path: Path) -> None:
    file = tmp_path / "b.txt"
    file.write_text(
        "; about\nlet x = 01 02\npart both\n 0 <- {x}\n 1 -> {y}\n\n== first ; why\nwith nodes {n}\n"
        "each | n | y\n     | 2 | 05\n     | 3 | \nuse both\n{y}\n\n== second\n2 -\n"
    )
    first, again, second = read_dialogues(file)
    assert (first.name, first.options) == ("b: first [2, 05]", ["nodes 2"])
    assert first.lines == [("b.txt:4", "0 <- 01 02"), ("b.txt:5", "1 -> 05"), ("b.txt:13", "05")]
    assert (again.options, again.lines[1:]) == (["nodes 3"], [("b.txt:5", "1 -> ")])
    assert (second.name, second.options, second.lines) == ("b: second", [], [("b.txt:16", "2 -")])
