"""The reader and player of dialogues: tables, texts, parts, and that nothing passes that is not as written."""

import pytest
from dialogue import bench_of
from script import play_lines

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
