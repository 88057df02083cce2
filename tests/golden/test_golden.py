"""The golden set: what 0.5.0 made of its inputs, and what is made of them now. `make golden` records it anew; see README.md."""

import re
from pathlib import Path

import judge
import pytest
import record

HERE = record.HERE


FRAMES = [
    file for file in record.files() if file.parent.name != "commands" or file.stem == "convert"
]
"""Those that a core makes."""


def named(file: Path) -> str:
    return str(file.relative_to(HERE))


@pytest.mark.parametrize("file", FRAMES, ids=named)
def test_no_frame_has_changed(file: Path) -> None:
    unchanged(file)


@pytest.mark.parametrize("file", [f for f in record.files() if f not in FRAMES], ids=named)
def test_no_word_has_changed(file: Path) -> None:
    unchanged(file)


def unchanged(file: Path) -> None:
    found = record.changes(file, record.made(file))
    assert not found, "\n".join(
        [*found, "If this is meant: make golden, and commit what it says with the change."]
    )


@pytest.mark.parametrize("file", judge.files(), ids=named)
def test_what_is_golden_is_right(file: Path) -> None:
    found = judge.judge(file)
    assert found.count.total() > 0
    assert found.wrong == []


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("flights/v4.txt", "-> 688#000000C0", "-> 688#000000BF"),  # a voltage of 10 mV less
        ("flights/v4.txt", "-> 688#", "-> 698#"),
        ("dialogues/sync_of_three.txt", "-> 382#581F", "-> 382#591F"),
    ],
)
def test_the_judge_sees_what_is_wrong(tmp_path: Path, name: str, old: str, new: str) -> None:
    file = tmp_path / name
    file.parent.mkdir()
    text = (HERE / name).read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new, 1), encoding="utf-8")
    assert judge.judge(file).wrong


def test_only_the_adapter_knows_the_product() -> None:
    knowing = re.compile(r"^\s*(from|import) kontronik_can_gw", re.MULTILINE)
    assert [
        file.name for file in HERE.glob("*.py") if knowing.search(file.read_text(encoding="utf-8"))
    ] == ["drive.py"]
