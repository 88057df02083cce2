"""Dialogues with CANopen nodes from files: NMT, heartbeat, SYNC, emergencies, PDOs, storage, SDO. The format: dialogues/README.md."""

from pathlib import Path

import pytest
from dialogue import bench_of
from script import Dialogue, play_lines, read_dialogues
from sdo_bench import sdo_bench_of

FOLDER = Path(__file__).with_name("dialogues")
ALL = [dialogue for path in sorted(FOLDER.glob("*.txt")) for dialogue in read_dialogues(path)]


@pytest.mark.parametrize("dialogue", ALL, ids=lambda dialogue: dialogue.name)
def test_dialogue(dialogue: Dialogue) -> None:
    make = sdo_bench_of if dialogue.name.startswith("sdo:") else bench_of
    play_lines(make(dialogue.options), dialogue.lines)
