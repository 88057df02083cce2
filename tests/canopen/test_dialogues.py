"""Dialogues from files with CANopen nodes, the SDO server alone and LSS slaves. The format: dialogues/README.md."""

from pathlib import Path

import pytest
from dialogue import bench_of
from lss_bench import Talk
from script import Dialogue, play_lines, read_dialogues
from sdo_bench import sdo_bench_of

FILES = sorted(Path(__file__).parent.glob("*dialogues/*.txt"))
MAKERS = {"sdo": sdo_bench_of, "lss": Talk}


@pytest.mark.parametrize(
    "dialogue",
    [each for path in FILES for each in read_dialogues(path)],
    ids=lambda dialogue: dialogue.name,
)
def test_dialogue(dialogue: Dialogue) -> None:
    make = MAKERS.get(dialogue.name.partition(":")[0], bench_of)
    play_lines(make(dialogue.options), dialogue.lines)
