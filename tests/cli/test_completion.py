"""The completion scripts, which are generated from the parser of the command line."""

import shutil
import subprocess
from pathlib import Path

import pytest
from command_line import run

from kontronik_can_gw.cli import COMMANDS

pytestmark = pytest.mark.promise("help")


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the script for bash into a folder with some files."""
    done = run("completion", "bash")
    assert done.code == 0
    assert done.err == ""
    folder = tmp_path_factory.mktemp("completion")
    for name in ("car.toml", "car.dbc", "car.bin"):
        (folder / name).touch()
    (folder / "script.bash").write_bytes(done.data)
    return folder / "script.bash"


ASKED = r"""
    source "$0"
    function=$(complete -p kontronik-can-gw | sed 's/.*-F \([^ ]*\).*/\1/')
    COMP_WORDS=(kontronik-can-gw $1); COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
    COMP_LINE="kontronik-can-gw $1"; COMP_POINT=${#COMP_LINE}
    "$function" kontronik-can-gw "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD-1]}"
    printf '%s\n' "${COMPREPLY[@]}"
"""


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("des", {"describe"}),
        ("service install --r", {"--root"}),
        ("describe --dbc car", {"car.dbc"}),
        ("run -c car", {"car.toml"}),
        ("decode car", {"car.toml", "car.dbc", "car.bin"}),
    ],
)
def test_bash_completes_commands_options_choices_and_files_of_the_right_kind(
    script: Path,
    typed: str,
    offered: set[str],
) -> None:
    command = ["bash", "--norc", "-c", ASKED, str(script), typed]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
        cwd=script.parent,
    )
    assert set(done.stdout.split()) == offered


@pytest.mark.parametrize("shell", ["bash", "zsh", "tcsh"])
def test_each_shell_has_a_completion_script(shell: str) -> None:
    done = run("completion", shell)
    assert done.code == 0
    assert done.err == ""
    assert all(command in done.out for command in COMMANDS)
    if interpreter := shutil.which(shell):
        subprocess.run([interpreter, "-n"], input=done.data, check=True, timeout=60)
