"""The golden set: the recorded behaviour of the gateway is compared with its current behaviour.

`make golden` records the set again. See README.md.
"""

import re
from pathlib import Path

import judge
import pytest
import record

pytestmark = pytest.mark.promise("golden")

HERE = record.HERE


def _is_made_by_a_core(file: Path) -> bool:
    return file.parent.name != "commands" or file.stem == "convert"


FRAMES = [file for file in record.files() if _is_made_by_a_core(file)]
"""The files whose content is computed by a core."""


def named(file: Path) -> str:
    return str(file.relative_to(HERE))


@pytest.mark.parametrize("file", FRAMES, ids=named)
def test_frames_have_not_changed(file: Path) -> None:
    unchanged(file)


@pytest.mark.parametrize("file", [f for f in record.files() if f not in FRAMES], ids=named)
def test_texts_have_not_changed(file: Path) -> None:
    unchanged(file)


def unchanged(file: Path) -> None:
    found = record.changes(file, record.made(file))
    advice = "If this is meant: make golden, and commit what it says with the change."
    assert not found, "\n".join([*found, advice])


@pytest.mark.promise("true")
@pytest.mark.parametrize("file", judge.files(), ids=named)
def test_recorded_values_are_right(file: Path) -> None:
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
def test_judge_finds_a_wrong_frame(tmp_path: Path, name: str, old: str, new: str) -> None:
    file = tmp_path / name
    file.parent.mkdir()
    text = (HERE / name).read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new, 1), encoding="utf-8")
    assert judge.judge(file).wrong


def test_only_the_adapter_imports_the_product() -> None:
    imports = re.compile(r"^\s*(from|import) kontronik_can_gw", re.MULTILINE)
    found = []
    for file in HERE.glob("*.py"):
        if imports.search(file.read_text(encoding="utf-8")):
            found.append(file.name)
    assert found == ["drive.py"]
