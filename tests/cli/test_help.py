"""The text of --help, messages about mistyped command lines, and descriptions of the program."""

import argparse
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import run

from kontronik_can_gw.cli import COMMANDS, FIRST_COMMANDS, make_parser

pytestmark = pytest.mark.promise("help")

ROOT = Path(__file__).resolve().parents[2]


def parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Yield a parser and the parsers of all its commands and actions."""
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                yield from parsers(sub)


@pytest.fixture(autouse=True)
def columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")


EVERY = list(parsers(make_parser()))


@pytest.mark.parametrize("parser", EVERY, ids=lambda parser: parser.prog)
def test_help_fits_80_columns_and_has_a_description(parser: argparse.ArgumentParser) -> None:
    text = parser.format_help()
    assert [line for line in text.splitlines() if len(line) > 80] == []
    assert parser.description
    assert parser.description.endswith(".")
    assert not re.search(r"  the same$|^The same as", text, re.MULTILINE), "before its referent"


def test_every_command_is_tested() -> None:
    programs = {each.prog for each in EVERY}
    assert {f"kontronik-can-gw {name}" for name in COMMANDS} <= programs
    assert "kontronik-can-gw service install" in programs


def test_dronecan_is_named_in_every_description_of_the_program() -> None:
    control = (ROOT / "deb" / "control").read_text()
    make_deb = (ROOT / "deb" / "make_deb.py").read_text()
    project = (ROOT / "pyproject.toml").read_text()
    texts = {
        "help": make_parser().description or "",
        "run": COMMANDS["run"],
        "package": control.partition("Description:")[2],
        "manual page": make_deb.partition('"--description", ')[2][:99],
        "project": re.findall("(?m)^description = .*", project)[0],
    }
    assert [name for name, text in texts.items() if "DroneCAN" not in text] == []


def test_call_without_arguments_shows_the_short_help() -> None:
    done = run()
    assert done.code == 2
    assert done.out == ""
    lines = done.err.splitlines()
    assert lines[0] == "usage: kontronik-can-gw COMMAND ..."
    assert [line.split()[0] for line in lines if re.match("  [a-z]", line)] == list(FIRST_COMMANDS)
    assert set(FIRST_COMMANDS) <= set(COMMANDS)
    assert [line for line in lines if len(line) > 80] == []
    assert "kontronik-can-gw --help lists all commands." in lines


@pytest.mark.parametrize(
    ("words", "place", "said"),
    [
        ("statsu", "", "'statsu' is unknown. Did you mean status?"),
        ("mointor vcan0", "", "'mointor' is unknown. Did you mean monitor?"),
        ("frobnicate", "", "'frobnicate' is unknown. Known: demo, run, "),
        ("run --wiat", " run", "unrecognized arguments: --wiat. Did you mean --wait?"),
        ("eds --nodeid=3", " eds", "--nodeid=3. Did you mean --node-id?"),
        ("convert a b c", " convert", "unrecognized arguments: c"),
        ("service instal", " service", "'instal' is unknown. Did you mean install?"),
        ("service install --now --rot x", " service install", "Did you mean --root?"),
        ("describe --format jsn", " describe", "'jsn' is unknown. Did you mean json?"),
        ("--nope", "", "unrecognized arguments: --nope. Help: "),
        ("--versoin", "", "unrecognized arguments: --versoin. Did you mean --version? Help: "),
        ("--nope run", "", "unrecognized arguments: --nope. Help: "),
        ("service --nope", " service", "unrecognized arguments: --nope. Help: "),
        ("convert --nope", " convert", "unrecognized arguments: --nope. Help: "),
        ("convert a b --nope=1", " convert", "unrecognized arguments: --nope=1. Help: "),
        ("check --forse", " check", "unrecognized arguments: --forse. Help: "),
        ("convert a b --forse", " convert", "--forse. Did you mean --force? Help: "),
    ],
)
def test_mistyped_command_line_is_one_line_with_a_suggestion(
    words: str,
    place: str,
    said: str,
) -> None:
    done = run(*words.split())
    assert done.code == 2
    assert done.out == ""
    (line,) = done.err.splitlines()
    assert line.startswith(f"kontronik-can-gw{place}: ")
    assert line.endswith(f" Help: kontronik-can-gw{place} --help")
    assert said in line


@pytest.mark.parametrize("name", COMMANDS)
def test_unknown_option_names_the_help_of_the_command(name: str) -> None:
    required = {
        "service": ["install"],
        "completion": ["bash"],
        "export": ["c"],
        "report": ["x", "-o", "-"],
        "replay": ["x", "--on", "can"],
        "convert": ["x"],
        "decode": ["x"],
    }
    done = run(name, *required.get(name, []), "--no-such-option")
    place = f"{name} install" if name == "service" else name
    assert done.code == 2
    assert done.out == ""
    assert done.err == (
        f"kontronik-can-gw {place}: unrecognized arguments: --no-such-option. "
        f"Help: kontronik-can-gw {place} --help\n"
    )
