"""The core never needs more instructions on a Thumb-2 processor than docs/firmware.md states.

A step of `make release`: python -m pytest -s tests/proofs/long_worst_case.py
"""

import re
from pathlib import Path

import pytest
from built import there
from every_value import DBC
from worst_case import COMPILER, Limits, build_image, plan_of, search

pytestmark = [
    pytest.mark.promise("firmware"),
    pytest.mark.usefixtures("c_compiler"),
]
CALLS = 10_000_000
SEARCHED = {
    "one byte": "`kcg_receive` of one byte",
    "256 bytes": "`kcg_receive` of 256 bytes",
    "advance": "`kcg_advance`",
    "take": "`kcg_take` of all messages",
    "sent": "`kcg_sent` of all messages",
    "other": "each other call, except `kcg_init`",
}
"""The rows of the table that the search is about, by the names of count_instructions.c."""
FIRMWARE = Path(__file__).parents[2] / "docs" / "firmware.md"


def test_no_call_needs_more_instructions_than_the_stated_worst_case(tmp_path: Path) -> None:
    """The limit follows from the machine code and the limits of loops. The search stays below it.

    The limits in docs/firmware.md must not be lower. The search must find about as many
    instructions as it did when that table was written.
    """
    there(COMPILER)
    limits = Limits(build_image(tmp_path), plan_of(DBC))
    rows = table()
    assert rows.keys() == limits.stated().keys()
    for name, limit in limits.stated().items():
        assert limit <= rows[name][0], f"{name}: {limit}"
    said = search(tmp_path, limits, CALLS)
    print(said)
    found = dict(re.findall(r"^(.+): (\d+) of at most", said, re.MULTILINE))
    assert found.keys() == SEARCHED.keys()
    for name, row in SEARCHED.items():
        # another compiler may need fewer instructions, but a search that counts nothing is wrong
        assert int(found[name]) > rows[row][1] / 2, name


def table() -> dict[str, tuple[int, int]]:
    """Return the rows of docs/firmware.md: the limit, and what a search found, or 0."""
    page = FIRMWARE.read_text(encoding="utf-8").partition("### Instructions")[2]
    row = re.compile(r"^\| (.+) \| ([\d ]+) \| ([\d ]*) ?\|$", re.MULTILINE)
    return {
        name: (_number(limit), _number(found))
        for name, limit, found in row.findall(page.partition("\n## ")[0])
    }


def _number(text: str) -> int:
    return int(text.replace(" ", "") or 0)
