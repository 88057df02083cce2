"""Completion scripts, asked as the shell asks them."""

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import shtab
from described import program

from kontronik_can_gw.cli import COMMANDS, make_parser
from kontronik_can_gw.cli.completion import SHELLS

FORMATS = {"md", "html", "json", "man"}


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The script for bash, in a folder with some files."""
    done = program("completion", "bash")
    assert (done.code, done.talk) == (0, "")
    folder = tmp_path_factory.mktemp("completion")
    file = folder / "script.bash"
    file.write_text(done.out, encoding="utf-8")
    for name in ("car.toml", "car.dbc", "car.bin"):
        (folder / name).touch()
    (folder / "cars").mkdir()
    return file


def completed(script: Path, *words: str) -> set[str]:
    """What bash offers for the last of the words, by the function that is registered for the program."""
    asked = r"""
        source "$0"
        function=$(complete -p kontronik-can-gw | sed 's/.*-F \([^ ]*\).*/\1/')
        COMP_WORDS=(kontronik-can-gw "$@"); COMP_CWORD=$#; COMP_LINE="kontronik-can-gw $*"; COMP_POINT=${#COMP_LINE}
        "$function" kontronik-can-gw "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD-1]}"
        printf '%s\n' "${COMPREPLY[@]}"
    """
    done = subprocess.run(
        ["bash", "--norc", "-c", asked, str(script), *words],
        capture_output=True,
        text=True,
        timeout=20,
        check=True,
        cwd=script.parent,
    )
    return set(done.stdout.split())


def test_bash_reads_the_script_without_a_word(script: Path) -> None:
    done = subprocess.run(["bash", "--norc", "-n", str(script)], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")


def test_commands_are_completed(script: Path) -> None:
    assert completed(script, "") == set(COMMANDS)
    assert completed(script, "des") == {"describe"}
    assert completed(script, "--ver") == {"--version"}


@pytest.mark.parametrize("command", list(COMMANDS))
def test_each_option_of_each_command_is_completed(script: Path, command: str) -> None:
    (commands,) = (a for a in make_parser()._actions if isinstance(a, argparse._SubParsersAction))
    options = {option for action in commands.choices[command]._actions for option in action.option_strings}
    assert completed(script, command, "-") == options
    assert {"-h", "--help"} <= options


def test_commands_below_a_command_and_their_options_are_completed(script: Path) -> None:
    assert completed(script, "service", "") == {"install", "status", "uninstall"}
    assert {"--dry-run", "--network"} <= completed(script, "service", "install", "--")
    assert completed(script, "service", "status", "--l") == {"--lines"}


def test_choices_are_completed(script: Path) -> None:
    assert completed(script, "describe", "--format", "") == FORMATS
    assert completed(script, "describe", "--dbc", "car.dbc", "--format", "h") == {"html"}
    assert completed(script, "completion", "") == set(SHELLS)


def test_file_names_are_completed_those_of_the_right_kind_where_there_is_one(script: Path) -> None:
    assert completed(script, "decode", "car") == {"car.toml", "car.dbc", "car.bin", "cars"}
    assert completed(script, "describe", "-o", "car.b") == {"car.bin"}
    assert completed(script, "run", "-c", "car") == {"car.toml", "cars"}
    assert completed(script, "describe", "--dbc", "car") == {"car.dbc", "cars"}
    assert completed(script, "service", "install", "--root", "car") == {"cars"}


@pytest.mark.parametrize("shell", SHELLS)
def test_there_is_a_script_for_each_shell(shell: str) -> None:
    done = program("completion", shell)
    assert (done.code, done.talk) == (0, "")
    assert all(command in done.out for command in COMMANDS)
    assert all(name in done.out for name in ("dry-run", "html"))
    if interpreter := shutil.which(shell):
        subprocess.run([interpreter, "-n"], input=done.out, text=True, check=True, timeout=20)


@pytest.mark.skipif(shutil.which("zsh") is None, reason="no zsh")
def test_zsh_defines_its_function(tmp_path: Path) -> None:
    file = tmp_path / "_kontronik-can-gw"
    file.write_text(program("completion", "zsh").out, encoding="utf-8")
    asked = "autoload -Uz compinit; compinit -u -D; source $1; whence -w _shtab_kontronik_can_gw"
    done = subprocess.run(["zsh", "-f", "-c", asked, "zsh", str(file)], capture_output=True, text=True, check=True)
    assert "function" in done.stdout


def test_a_shell_that_shtab_does_not_know_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shtab, "SUPPORTED_SHELLS", ["bash"])
    done = program("completion", "fish")
    assert (done.code, done.out, done.talk.count("\n")) == (1, "", 1)
    assert "pip install --upgrade shtab" in done.talk


def test_an_unknown_shell_is_refused_with_those_there_are() -> None:
    done = program("completion", "cmd")
    assert (done.code, done.out) == (2, "")
    assert all(shell in done.talk for shell in SHELLS)


def test_a_run_of_one_command_imports_no_other() -> None:
    code = (
        "import sys; from kontronik_can_gw.cli import main; main(['schema']); "
        "print([m for m in sys.modules if m.startswith('kontronik_can_gw.cli.')], 'shtab' in sys.modules, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "['kontronik_can_gw.cli.schema'] False"
