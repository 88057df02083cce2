"""An EDS that asks for too much: refused in one line or a few, without counting it out."""

from pathlib import Path

import pytest

from kontronik_can_gw.canopen import eds as reader
from kontronik_can_gw.errors import UserError

SHIPPED = (Path(__file__).parents[2] / "eds" / "kontronik_esc.eds").read_text("ascii")
VARIABLE = "ParameterName=x\nDataType=0x0005\nAccessType=rw\n"
COMPACT = (
    "[{index:04X}]\nParameterName=x\nObjectType=8\nDataType=5\nAccessType=rw\nCompactSubObj=254\n"
)
HUGE = "9" * 5_000


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (SHIPPED + "\n" + ";" * reader.MAX_BYTES, "is larger than 2 MB"),
        (SHIPPED + "\n" * 100_001, "is larger than 2 MB or 100000 lines"),
        (
            SHIPPED + "".join(COMPACT.format(index=index) for index in range(0x2800, 0x2900)),
            "more than 10000 objects",
        ),
        (
            SHIPPED + f"\n[2800]\n{VARIABLE}ObjectType=8\nCompactSubObj={HUGE}\n",
            "[2800] CompactSubObj=999",
        ),
        (
            SHIPPED + COMPACT.format(index=0x2800) + f"[2800Name]\nNrOfEntries=1\n{HUGE}=x\n",
            "not a sub-index from 1 to",
        ),
        (SHIPPED + f"\n[2800]\n{VARIABLE}DefaultValue={HUGE}\n", "[2800] DefaultValue=999"),
        (SHIPPED + f"\n[2800]\n{VARIABLE}LowLimit=-{HUGE}\n", "[2800] LowLimit=-999"),
        (SHIPPED + f"\n[2800]\nParameterName={HUGE}\n", "longer than 241"),
        (SHIPPED + f"\n[{HUGE}]\n{HUGE}\n", "is neither a section"),
        (
            SHIPPED
            + "\n[1A3F]\nParameterName=x\nObjectType=9\nSubNumber=1\n"
            + "[1A3Fsub0]\nParameterName=x\nDataType=7\nAccessType=rw\nDefaultValue=0xFFFFFFFF\n",
            "sub-index 0 is an UNSIGNED8",
        ),
    ],
)
def test_what_is_out_of_bounds_is_said_shortly(text: str, said: str) -> None:
    with pytest.raises(UserError) as caught:
        reader.load(text.encode("ascii"), "mine.eds")
    assert any(said in line for line in caught.value.problems), caught.value.problems
    assert len(caught.value.problems) <= 21
    assert all(len(line) < 900 for line in caught.value.problems)
