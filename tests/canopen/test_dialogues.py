"""Plays the dialogues of files with CANopen nodes, or with the SDO server alone.

dialogues/README.md has the format.
"""

from pathlib import Path

import pytest
from dialogue import bench_of
from script import Dialogue, play_lines, read_dialogues
from sdo_bench import sdo_bench_of

pytestmark = pytest.mark.promise(
    "sdo", "pdo", "sync", "nmt", "heartbeats", "emergencies", "lss", "parameters"
)

FILES = sorted(Path(__file__).parent.glob("dialogues/*.txt"))


@pytest.mark.parametrize(
    "dialogue",
    [each for path in FILES for each in read_dialogues(path)],
    ids=lambda dialogue: dialogue.name,
)
def test_dialogue(dialogue: Dialogue) -> None:
    make = sdo_bench_of if dialogue.name.startswith("sdo:") else bench_of
    play_lines(make(dialogue.options), dialogue.lines)
