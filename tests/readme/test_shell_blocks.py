"""Shell blocks of README, docs and examples do what they say, on any machine; tests/vcan has those that need a CAN interface."""

import shutil
from pathlib import Path

import pytest
from shell_blocks import PAGES, WORDS, Block, blocks, make_files, run_block

NEEDS = {"jq": "jq", "cc": "gcc libc6-dev"}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    make_files(folder, "can0", 100)
    return folder


def given(block: Block) -> object:
    """A block as a parameter; libraries of tables take their time."""
    marks = [pytest.mark.extended] if "parquet" in block.text else []
    return pytest.param(block, id=block.place, marks=marks)


@pytest.mark.parametrize("block", [given(block) for block in blocks("")])
def test_a_block_can_be_typed_as_it_stands(block: Block, files: Path, tmp_path: Path) -> None:
    for program, package in NEEDS.items():
        if f"{program} -" in block.text and shutil.which(program) is None:
            pytest.skip(f"no {program}: sudo apt-get install {package}")
    folder = tmp_path / "f"
    shutil.copytree(files, folder, symlinks=True)
    run_block(block, folder)


def test_each_block_says_why_it_cannot_be_run() -> None:
    assert {block.word for block in blocks()} <= set(WORDS)
    pages = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert len(blocks()) == pages.count("\n```sh")
    assert "```bash" not in pages
