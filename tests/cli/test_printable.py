"""Text from files, logs and buses does not control a terminal or a log.

Escape sequences, control characters and characters that change the direction are replaced.
"""

import io
import json
import logging
import re
import sys
from contextlib import redirect_stdout
from pathlib import Path

import pytest
from command_line import run

from kontronik_can_gw.cli import main, say, show
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.printable import printable, printable_json
from kontronik_can_gw.runtime.system.fault_log import BackgroundHandler

pytestmark = pytest.mark.promise("printable")

EVIL = "a\x1b]0;x\x07\x9b31m\u202eb\u2066\x7f\r\nINFO fake"
SHOWN = "a?]0;x??31m?b????INFO fake"
DBC = shipped("dbc/kontronik_esc.dbc").read_text("utf-8")
EDS = shipped("eds/kontronik_esc.eds").read_text("ascii")


def is_clean(text: str) -> bool:
    return all(c.isprintable() or c in "\n\t" for c in text)


def test_control_characters_are_shown_as_question_marks() -> None:
    assert printable(EVIL) == SHOWN
    assert printable("Größe 5 µΩ ‰ 温度 €") == "Größe 5 µΩ ‰ 温度 €"
    assert printable("a\tb\n\x1b", keep="\n\t") == "a\tb\n?"
    text = printable_json({EVIL: [EVIL, "µ", "\U000e0001"]}, indent=1)
    assert is_clean(text)
    assert "µ" in text
    assert json.loads(text) == {EVIL: [EVIL, "µ", "\U000e0001"]}


# --- the functions that write text


def test_printed_lines_and_errors_are_cleaned(capsys: pytest.CaptureFixture[str]) -> None:
    say(EVIL)
    show(EVIL)
    assert capsys.readouterr() == (f"{SHOWN}\n", f"kontronik-can-gw: {SHOWN}\n")
    assert UserError(EVIL, "b").problems == (SHOWN, "b")


def test_log_message_stays_one_line() -> None:
    stream = io.StringIO()
    handler = BackgroundHandler(stream, longest_end_s=60)
    try:
        raise ValueError(EVIL)
    except ValueError:
        info = sys.exc_info()
    handler.emit(logging.LogRecord("x", logging.ERROR, "", 0, "said %s", (EVIL,), info))
    handler.close()
    assert stream.getvalue().startswith(f"said {SHOWN}\nTraceback")
    assert is_clean(stream.getvalue())


# --- from end to end


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Write a configuration whose DBC and EDS have such characters in all texts."""
    evil = "a\x1bEVIL\x07\x9b\u202eb"
    dbc = re.sub(
        r'(CM_ (?:SG_|BO_)?[^"]*"|NotAvailable" 0x|VAL_ 1664 OperatingState 1 ")',
        rf"\1{evil}",
        DBC,
    )
    (tmp_path / "my.dbc").write_text(dbc)
    eds = re.sub(r"ParameterName=([^\n]*)", "ParameterName=\\1 a\x1bEVIL\x07\x7fb", EDS)
    (tmp_path / "my.eds").write_text(eds, "ascii")
    (tmp_path / "gateway.toml").write_text(
        '[can]\ninterface = "virtual"\n[dbc]\nfile = "my.dbc"\n'
        '[canopen]\nenabled = true\nnode_id = 5\neds = "my.eds"\nstore = "."\n[[esc]]\nport = "p"\n'
    )
    return tmp_path


@pytest.mark.parametrize(
    "words",
    [
        ["describe"],
        ["describe", "--format", "json"],
    ],
)
def test_descriptions_of_hostile_files_are_cleaned(words: list[str], folder: Path) -> None:
    done = run(*words, "-c", folder / "gateway.toml")
    assert done.code == 0, done.err
    assert "?EVIL?" in done.out or "\\u001bEVIL\\u0007" in done.out
    assert is_clean(done.out + done.err)


def test_file_shown_on_a_terminal_is_cleaned(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for is_terminal in (False, True):  # text in a pipe is not changed
        out = io.TextIOWrapper(io.BytesIO(), "utf-8")
        monkeypatch.setattr(out, "isatty", lambda is_terminal=is_terminal: is_terminal)
        with redirect_stdout(out):
            assert main(["dbc", "-c", str(folder / "gateway.toml")]) == 0
        out.seek(0)
        assert is_clean(text := out.read()) == is_terminal
        assert "EVIL" in text


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("my.dbc", f'BO_ 1 X: 8 "{EVIL}"', "dbc --from"),
        ("x.toml", '"\\u001b]0;x" = 1\n', "check -c"),
        ("x.kcap", EVIL, "replay --on pty"),
        ("\x1b]0;x\x07.bin", "", "decode"),
    ],
)
def test_error_messages_about_hostile_files_are_cleaned(
    name: str,
    content: str,
    words: str,
    tmp_path: Path,
) -> None:
    path = tmp_path / name
    path.write_text(content)
    done = run(*words.split(), path)
    assert done.code
    assert "usage:" not in done.err
    assert is_clean(done.out + done.err)
