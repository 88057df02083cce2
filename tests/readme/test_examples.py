"""examples/: configurations that can be used without a warning, DBCs of what they send, a bus file that dcfgen takes."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import run

from kontronik_can_gw.config.keys import shipped

EXAMPLES = Path(__file__).parents[2] / "examples"
CONFIGURATIONS = sorted(EXAMPLES.glob("*/gateway.toml"))


@pytest.mark.parametrize("file", CONFIGURATIONS, ids=lambda file: file.parent.name)
def test_check_accepts_it_without_a_warning(file: Path) -> None:
    done = run("check", file)
    assert (done.code, done.err) == (0, "")


@pytest.mark.parametrize(
    ("file", "words"),
    [("bus.dbc", []), ("canopen.dbc", ["--canopen"])],
)
def test_a_dbc_beside_it_is_what_the_command_writes(file: str, words: list[str]) -> None:
    for dbc in EXAMPLES.glob(f"*/{file}"):
        assert run("dbc", *words, "-c", dbc.with_name("gateway.toml")).data == dbc.read_bytes(), dbc


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
