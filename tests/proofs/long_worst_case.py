"""The core never needs more instructions on a Thumb-2 processor than docs/firmware.md states.

A step of `make release`: python -m pytest -s tests/proofs/long_worst_case.py
"""

import re
from pathlib import Path

from built import there
from every_value import DBC
from worst_case import COMPILER, Limits, build_image, plan_of, search

CALLS = 10_000_000
FIRMWARE = Path(__file__).parents[2] / "docs" / "firmware.md"


def test_no_call_needs_more_instructions_than_the_stated_worst_case(tmp_path: Path) -> None:
    """The limit follows from the machine code and the limits of loops. The search stays below it.

    The limits in docs/firmware.md must not be lower.
    """
    there(COMPILER)
    limits = Limits(build_image(tmp_path), plan_of(DBC))
    page = FIRMWARE.read_text(encoding="utf-8")
    for name, limit in limits.stated().items():
        row = re.search(rf"^\| {re.escape(name)} \| ([\d ]+) \|", page, re.MULTILINE)
        assert row, f"{name} is missing in {FIRMWARE.name}"
        assert limit <= int(row[1].replace(" ", "")), f"{name}: {limit}"
    print(search(tmp_path, limits, CALLS))
