"""README.md, docs/ and examples/ are right.

Tables match the sources, commands exist, and examples are valid. Shell blocks can be typed as they
are written, on any machine. Those that need a CAN interface are in tests/vcan. test_references.py
tests links.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from command_line import run
from pictures import SHOWN, VIEWS, main
from reference import FOLDER, pages
from report_browser import MISSING, PROGRAM
from shell_blocks import PAGES as BY_HAND
from shell_blocks import WORDS, Block, blocks, make_files, run_block

from kontronik_can_gw.cli import COMMANDS
from kontronik_can_gw.cli.schema import schema
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.config.parse import parse

pytestmark = pytest.mark.promise("docs")

PROJECT = FOLDER.parents[1]
PATHS = (*BY_HAND, *FOLDER.glob("*.md"))
PAGES = {path: path.read_text(encoding="utf-8") for path in PATHS}
README = PAGES[PROJECT / "README.md"]
ALL = "\n".join(PAGES[path] for path in BY_HAND)
EXAMPLES = PROJECT / "examples"
CONFIGURATIONS = sorted(EXAMPLES.glob("*/gateway.toml"))
NEEDS = {"jq": "jq"}


def test_reference_matches_the_sources() -> None:
    made = {FOLDER / name: text for name, text in pages()}
    found = {path: text for path, text in PAGES.items() if path.parent == FOLDER}
    found.pop(FOLDER / "conformance.md")  # make conformance writes it
    assert made == found, "run: make docs"


def test_reference_has_every_key_of_every_table() -> None:
    rows = set(re.findall(r"^\| (\w+) \|", PAGES[FOLDER / "configuration.md"], re.MULTILINE))
    tables = schema()["properties"].values()
    keys = set()
    for table in tables:
        entries = table.get("items", table)["properties"]
        keys |= {key for key, entry in entries.items() if "deprecated" not in entry}
    assert rows - {"key"} == keys


def link_targets(pattern: str) -> set[Path]:
    """Return the files to which all pages link. The pattern's group is the link."""
    found = set()
    for path, text in PAGES.items():
        for link in re.findall(pattern, text):
            found.add((path.parent / link).resolve())
    return found


def test_every_page_can_be_reached_from_the_front_page() -> None:
    linked = link_targets(r"\]\(([^):#]+\.md)")
    assert set(PAGES) - {PROJECT / "README.md"} <= linked


def test_configurations_are_valid() -> None:
    for block in re.findall(r"```toml\n(.*?)```", ALL, re.DOTALL):
        least = {"esc": [{"port": "/dev/ttyUSB0"}]}  # some blocks are a single table
        parse(least | tomllib.loads(block), "README.md")


def test_json_blocks_are_valid() -> None:
    found = blocks(language="json")
    assert found
    for block in found:
        json.loads(block.text)


def test_each_fault_has_the_place_that_reports_it() -> None:
    text = PAGES[PROJECT / "docs/faults.md"].partition("\n## Proof")[0]
    sections = re.split(r"^### ", text, flags=re.MULTILINE)[1:]
    assert len(sections) > 20
    for section in sections:
        title, _, rest = section.partition("\n")
        assert "*Reported as:*" in rest, title


def test_every_command_is_documented() -> None:
    reference = (PROJECT / "docs/reference/commands.md").read_text(encoding="utf-8")
    assert all(f"\n## {command}\n" in reference for command in COMMANDS)
    assert "(docs/reference/commands.md)" in README


def test_every_documented_command_exists() -> None:
    for command in re.findall(r"(?<!-u )kontronik-can-gw ([a-z]+)\b(?! gateway)", ALL):
        assert command in COMMANDS, command


def test_every_documented_make_target_exists() -> None:
    makefile = (PROJECT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"`?make ([a-z-]+)", ALL):
        if target not in ("an", "no", "or", "sure"):
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_pictures_are_in_use_and_small_and_load_nothing() -> None:
    shown = link_targets(r"!\[[^]]+\]\(([^)]+)\)")
    assert shown == set((PROJECT / "docs/pictures").iterdir())
    assert shown == {PROJECT / "docs/pictures" / name for name in SHOWN}
    for path in shown:
        assert path.stat().st_size < 150_000, path.name
        assert path.suffix == ".png" or "url(http" not in path.read_text(encoding="utf-8")


@pytest.mark.extended
def test_pictures_can_be_made_again(tmp_path: Path) -> None:
    if PROGRAM is None:
        pytest.skip(MISSING)
    main(tmp_path)
    made = {path.name for path in tmp_path.iterdir()}
    assert made > set(SHOWN)
    assert len(made) == 8 + len(VIEWS)


# --- examples


@pytest.mark.parametrize("file", CONFIGURATIONS, ids=lambda file: file.parent.name)
def test_check_accepts_each_example_without_a_warning(file: Path) -> None:
    done = run("check", file)
    assert done.code == 0
    assert done.err == ""


@pytest.mark.parametrize(
    ("file", "words"),
    [("bus.dbc", []), ("canopen.dbc", ["--canopen"])],
)
def test_dbc_of_an_example_is_the_output_of_the_command(file: str, words: list[str]) -> None:
    for dbc in EXAMPLES.glob(f"*/{file}"):
        configuration = dbc.with_name("gateway.toml")
        done = run("dbc", *words, "-c", configuration)
        assert done.data == dbc.read_bytes(), dbc


def test_every_example_has_its_dbc() -> None:
    assert len(CONFIGURATIONS) == 4
    assert all(list(file.parent.glob("*.dbc")) for file in CONFIGURATIONS)


def test_dcfgen_takes_the_bus_file_of_ros2_canopen(tmp_path: Path) -> None:
    shutil.copy(EXAMPLES / "ros2/bus.yml", tmp_path)
    shutil.copy(shipped("eds/kontronik_esc.eds"), tmp_path)
    code = "from dcfgen.cli import main; main()"
    command = [sys.executable, "-W", "ignore", "-c", code, "-rS", "bus.yml"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    for name in ("master.dcf", "left.bin", "right.bin"):
        assert (tmp_path / name).stat().st_size > 100


# --- shell blocks


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    make_files(folder, "can0", 100)
    return folder


def given(block: Block) -> object:
    """Return a block as a parameter. Blocks with Parquet are slow because of their libraries."""
    marks = [pytest.mark.extended] if "parquet" in block.text else []
    return pytest.param(block, id=block.place, marks=marks)


@pytest.mark.parametrize("block", [given(block) for block in blocks("")])
def test_shell_block_can_be_typed_as_it_is_written(
    block: Block,
    files: Path,
    tmp_path: Path,
    request: pytest.FixtureRequest,
) -> None:
    if "cc -" in block.text:
        request.getfixturevalue("c_compiler")
    for program, package in NEEDS.items():
        if f"{program} -" in block.text and shutil.which(program) is None:
            pytest.skip(f"no {program}: sudo apt-get install {package}")
    folder = tmp_path / "f"
    shutil.copytree(files, folder, symlinks=True)
    run_block(block, folder)


def test_each_block_states_why_it_cannot_be_run() -> None:
    assert {block.word for block in blocks()} <= set(WORDS)
    assert len(blocks()) == ALL.count("\n```sh")
    assert "```bash" not in ALL


@pytest.mark.parametrize(
    ("gateways", "is_suspended"),
    [
        ([(0, "quiet")], True),
        ([(0, "quiet"), (0, "quiet")], True),
        ([], False),
        ([(0, "running")], False),
        ([(1, "quiet")], False),
        ([(0, "quiet"), (0, "running")], False),
        ([(0, "quiet"), (3, "quiet")], False),
    ],
)
def test_script_suspends_the_board_only_if_all_gateways_are_quiet(
    tmp_path: Path, gateways: list[tuple[int, str]], is_suspended: bool
) -> None:
    if shutil.which("jq") is None:
        pytest.skip(f"no jq: sudo apt-get install {NEEDS['jq']}")
    (script,) = [block.text for block in blocks("systemd") if "#!/bin/sh" in block.text]
    found = []
    for code, state in gateways:
        found.append({"exit_code": code, "document": {"gateway": {"state": state}}})
    (tmp_path / "status.json").write_text(json.dumps({"gateways": found}))
    programs = {
        "kontronik-can-gw": f"cat {tmp_path}/status.json",
        "systemctl": f'echo "$@" >{tmp_path}/done',
        "suspend": script,
    }
    for name, text in programs.items():
        program = tmp_path / name
        program.write_text(text if text is script else f"#!/bin/sh\n{text}\n")
        program.chmod(0o755)
    path = f"{tmp_path}:{os.environ['PATH']}"
    subprocess.run([tmp_path / "suspend"], env={"PATH": path}, check=True)
    done = tmp_path / "done"
    assert done.exists() is is_suspended
    assert not is_suspended or done.read_text() == "suspend\n"
