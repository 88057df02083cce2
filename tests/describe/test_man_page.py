"""The manual page: complete, and roff that groff and mandoc take without a word."""

import argparse
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from described import described

from kontronik_can_gw import __version__
from kontronik_can_gw.cli import COMMANDS, make_parser
from kontronik_can_gw.cli.man_page import _escaped

PACKAGE = Path(__file__).resolve().parents[2] / "kontronik_can_gw"
REQUESTS = {"TH", "SH", "SS", "TP", "PP", "B", "br", "nf", "fi"}
_SHOWN = {r"\e": "\\", r"\-": "-", r"\(aq": "'", r"\(ga": "`", r"\(ha": "^", r"\(ti": "~", r"\(dq": '"', r"\&": ""}


@pytest.fixture(scope="module")
def page() -> str:
    return described("--format", "man")


def shown(line: str) -> str:
    """A line as roff shows it; an escape that is not known fails."""

    def one(found: re.Match[str]) -> str:
        if found[0].startswith(r"\[u"):
            return chr(int(found[0][3:-1], 16))
        return "" if found[0].startswith(r"\f") else _SHOWN[found[0]]

    return re.sub(r"\\(?:\[u[0-9A-F]{4,6}\]|f[BIR]|\(..|.)", one, line)


def sections(page: str) -> dict[str, str]:
    """Title of each .SH and .SS to the text below it, without the requests."""
    found: dict[str, list[str]] = {}
    for line in page.splitlines():
        if heading := re.match(r'\.S[HS] "?(.*?)"?$', line):
            found[shown(heading[1])] = []
        elif found:
            found[list(found)[-1]].append(shown(re.sub(r"^\.[A-Za-z]+ ?", "", line)))
    return {title: " ".join(" ".join(lines).split()) for title, lines in found.items()}


def commands(parser: argparse.ArgumentParser, prefix: str = "") -> Iterator[tuple[str, argparse.ArgumentParser]]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, sub in action.choices.items():
                yield f"{prefix}{name}", sub
                yield from commands(sub, f"{prefix}{name} ")


def test_every_request_is_one_of_man_and_every_escape_is_known(page: str) -> None:
    for line in page.splitlines():
        if line.startswith((".", "'")):
            assert line[1:].split()[0] in REQUESTS, line
        assert line.isascii()
        shown(line)
        assert line.count(r"\fB") + line.count(r"\fI") == line.count(r"\fR"), line
    assert page.count(".nf\n") == page.count(".fi\n")


def test_it_has_the_sections_of_a_manual_page(page: str) -> None:
    assert page.startswith(f'.TH "KONTRONIK\\-CAN\\-GW" 1 "" "kontronik\\-can\\-gw {__version__}" "User Commands"\n')
    assert [title for title in sections(page) if title.isupper()] == [
        *("NAME", "SYNOPSIS", "DESCRIPTION", "COMMANDS", "OPTIONS OF THE COMMANDS", "EXIT STATUS", "FILES"),
        *("ENVIRONMENT", "SIGNALS", "EXAMPLES", "SEE ALSO"),
    ]
    assert sections(page)["NAME"].startswith("kontronik-can-gw - gateway")


def test_each_command_stands_there_with_its_line_options_and_epilog(page: str) -> None:
    found = sections(page)
    for name, line in COMMANDS.items():
        assert f"{name} {line}" in found["COMMANDS"]
    for name, parser in commands(make_parser()):
        text = found[name]
        for action in parser._actions:
            if "-h" in action.option_strings or isinstance(action, argparse._SubParsersAction):
                continue
            for option in action.option_strings:
                assert re.search(rf"(?<![\w-]){re.escape(option)}(?![\w-])", text), (name, option)
            told = argparse.HelpFormatter("x")._expand_help(action)
            assert " ".join(told.split()) in text, (name, told)
        for paragraph in re.split(r"\n\s*\n", parser.epilog or ""):
            assert " ".join(paragraph.replace("%(prog)s", parser.prog).split()) in text, name


def test_help_of_each_command_says_what_the_exit_codes_mean() -> None:
    for name, parser in commands(make_parser()):
        if " " not in name and name not in (
            "run",
            "mqtt",
        ):  # which run until they are ended, as EXIT STATUS says of all
            assert re.search(r"exit codes?\b", parser.epilog or "", re.IGNORECASE), name


def test_the_variables_that_the_program_reads_are_told(page: str) -> None:
    source = "\n".join(path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py"))
    read = set(re.findall(r"environ(?:ment)?(?:\)|\.get)?\(?\.?(?:get\()?\[?\"([A-Z_]+)\"", source)) - {"PATH"}
    assert {"NOTIFY_SOCKET", "STATE_DIRECTORY", "XDG_STATE_HOME", "RUNTIME_DIRECTORY"} <= read
    assert all(name in sections(page)["ENVIRONMENT"] for name in read), read


def test_files_are_those_of_the_service(page: str) -> None:
    told = sections(page)["FILES"]
    unit = (PACKAGE / "service" / "gateway.service").read_text(encoding="utf-8")
    assert "/etc/systemd/system/kontronik-can-gw.service" in told
    for directive, folder in (("StateDirectory", "/var/lib"), ("RuntimeDirectory", "/run")):
        assert re.search(rf"^{directive}=", unit, re.MULTILINE)
        assert f"{folder}/kontronik-can-gw" in told


@pytest.mark.parametrize("text", [".TH x", "'br", "a\n.so /etc/passwd", "\\fBx", "back\\slash", "-- µ °C …", '"q"'])
def test_any_text_is_shown_as_it_is(text: str) -> None:
    escaped = _escaped(text)
    assert not re.search(r"^[.']", escaped, re.MULTILINE)
    assert shown(escaped) == text
    if groff := shutil.which("groff"):
        page = f'.TH X 1 "" "" ""\n.SH A\n.nf\n{escaped}\n'
        done = subprocess.run(
            [groff, "-man", "-ww", "-Tutf8", "-P-cbou", "-k"], input=page, capture_output=True, text=True, check=True
        )
        assert done.stderr == ""
        assert text.splitlines()[0] in done.stdout


@pytest.mark.skipif(shutil.which("groff") is None, reason="no groff")
def test_groff_has_no_warning_and_shows_it(page: str) -> None:
    done = subprocess.run(
        ["groff", "-man", "-ww", "-Tutf8", "-P-cbou"], input=page, capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
    assert "--format {md,html,json,man}" in " ".join(done.stdout.split())


@pytest.mark.skipif(shutil.which("mandoc") is None, reason="no mandoc")
def test_mandoc_finds_nothing_but_the_missing_date(page: str) -> None:
    done = subprocess.run(["mandoc", "-Tlint"], input=page, capture_output=True, text=True, check=False)
    assert [line for line in done.stdout.splitlines() if "missing date" not in line] == []
