"""The command: exit codes, what is printed, the JSON document, and that nothing reaches an ESC."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from kontronik_can_gw import __version__
from kontronik_can_gw.cli.doctor import _lines
from kontronik_can_gw.offline.pty import PtyEsc
from kontronik_can_gw.runtime.doctor.findings import Finding, Severity

SCHEMA = {
    "type": "object",
    "additionalProperties": False,
    "required": ["format", "version", "config", "exit_code", "errors", "warnings", "findings"],
    "properties": {
        "format": {"const": 1},
        "version": {"const": __version__},
        "config": {"type": "string"},
        "exit_code": {"enum": [0, 1, 2]},
        "errors": {"type": "integer"},
        "warnings": {"type": "integer"},
        "findings": {
            "type": "array",
            "minItems": 1,
            "items": {
                "type": "object",
                "additionalProperties": False,
                "required": ["group", "check", "severity", "text", "remedy", "command"],
                "properties": {
                    "group": {"type": "string", "minLength": 1},
                    "check": {"type": "string", "pattern": "^(config|port|can|machine)(\\.[a-z_]+)?$"},
                    "severity": {"enum": ["ok", "note", "warning", "error"]},
                    "text": {"type": "string", "minLength": 1},
                    "remedy": {"type": "string"},
                    "command": {"type": "string"},
                },
            },
        },
    },
}


@pytest.fixture
def esc() -> Iterator[PtyEsc]:
    with PtyEsc() as terminal:
        yield terminal
        terminal.check()
        assert terminal.received == 0, "something was transmitted to an ESC"


def configuration(folder: Path, port: str, more: str = "") -> Path:
    file = folder / "gateway.toml"
    file.write_text(f'[can]\ninterface = "virtual"\nchannel = "doctor"\n{more}\n[[esc]]\nport = "{port}"\n')
    return file


def doctor(file: Path, *options: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "kontronik_can_gw", "doctor", "-c", str(file), *options]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)


def document(file: Path) -> tuple[dict[str, Any], int]:
    """The JSON document, checked, and the exit code."""
    done = doctor(file, "--json")
    assert done.stderr == ""
    found: dict[str, Any] = json.loads(done.stdout)
    jsonschema.validate(found, SCHEMA)
    assert found["exit_code"] == done.returncode
    for severity in ("error", "warning"):
        assert found[f"{severity}s"] == sum(f["severity"] == severity for f in found["findings"])
    return found, done.returncode


def test_a_usable_set_up_has_exit_code_0_and_plain_text_in_a_pipe(tmp_path: Path, esc: PtyEsc) -> None:
    done = doctor(configuration(tmp_path, esc.path))
    assert (done.returncode, done.stderr) == (0, "")
    for group in ("Configuration", "Serial port of esc1", "CAN doctor", "Machine"):
        assert f"{group}\n" in done.stdout
    assert "\x1b" not in done.stdout
    assert done.stdout.splitlines()[-1].startswith("no errors, ")
    assert max(map(len, done.stdout.splitlines())) <= 80


def test_a_missing_port_has_exit_code_1(tmp_path: Path) -> None:
    found, code = document(configuration(tmp_path, "/dev/ttyUSB99"))
    assert code == 1
    errors = [f for f in found["findings"] if f["severity"] == "error"]
    assert [f["check"] for f in errors] == ["port.exists"]
    assert errors[0]["group"] == "Serial port of esc1"


def test_a_configuration_that_cannot_be_read_has_exit_code_2_and_the_machine_is_looked_at_all_the_same(
    tmp_path: Path,
) -> None:
    file = tmp_path / "gateway.toml"
    file.write_text("[cann]\nbitrat = 1\n")
    found, code = document(file)
    assert code == 2
    told = [f["text"] for f in found["findings"] if f["severity"] == "error"]
    assert len(told) == 2
    assert "Did you mean can?" in told[0]
    assert "Machine" in {f["group"] for f in found["findings"]}
    assert document(tmp_path / "none.toml")[1] == 2


def test_a_faulty_dbc_has_exit_code_2_and_the_port_is_looked_at_all_the_same(tmp_path: Path, esc: PtyEsc) -> None:
    found, code = document(configuration(tmp_path, esc.path, '[dbc]\nfile = "none.dbc"'))
    assert code == 2
    assert [f["check"] for f in found["findings"] if f["severity"] == "error"] == ["config"]
    assert "Serial port of esc1" in {f["group"] for f in found["findings"]}


def test_stored_parameters_that_are_damaged_are_told_and_left_where_they_are(tmp_path: Path, esc: PtyEsc) -> None:
    more = '[canopen]\nenabled = true\nstore = "store"'
    file = configuration(tmp_path, esc.path, more)
    (tmp_path / "store").mkdir()
    damaged = tmp_path / "store" / "esc1.params"
    damaged.write_bytes(b"nonsense")
    found, code = document(file)
    assert code == 0
    assert "esc1.params" in " ".join(f["text"] for f in found["findings"] if f["severity"] == "warning")
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["esc1.params", "gateway.toml", "store"]
    assert damaged.read_bytes() == b"nonsense"


def test_nothing_is_made_or_changed(tmp_path: Path, esc: PtyEsc) -> None:
    more = '[canopen]\nenabled = true\nstore = "not/yet/there"'
    found, code = document(configuration(tmp_path, esc.path, more))
    assert code == 0
    assert any(f["text"].endswith("there, will be made") for f in found["findings"])
    assert [p.name for p in tmp_path.iterdir()] == ["gateway.toml"]


def test_a_folder_of_statistics_that_cannot_be_made_is_an_error(tmp_path: Path, esc: PtyEsc) -> None:
    found, code = document(configuration(tmp_path, esc.path, '[statistics]\nfile = "/proc/none/status.json"'))
    assert code == 1
    assert [f["check"] for f in found["findings"] if f["severity"] == "error"] == ["config.statistics"]


def test_a_port_that_the_running_gateway_has_is_a_note(tmp_path: Path, esc: PtyEsc) -> None:
    file = configuration(tmp_path, esc.path)
    command = [sys.executable, "-m", "kontronik_can_gw", "run", "-c", str(file)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as gateway:
        try:
            assert gateway.stderr is not None
            for line in gateway.stderr:
                if esc.path in line:
                    break
            begin = time.monotonic()
            found, code = document(file)
            assert time.monotonic() - begin < 30
            assert code == 0
            users = [f for f in found["findings"] if f["check"] == "port.users"]
            assert [(f["severity"], f["text"]) for f in users] == [
                ("note", f"in use by kontronik-can-gw (pid {gateway.pid})")
            ]
            assert gateway.poll() is None
        finally:
            gateway.terminate()
            gateway.communicate(timeout=10)
    assert gateway.returncode == 0


def test_every_remedy_stands_below_its_finding_and_commands_stay_whole() -> None:
    command = "sudo ip link set can0 down; " * 5
    remedy = "Do this and that, and then the other thing, because it says so in the manual:"
    found = [
        Finding("First", "a", Severity.ERROR, "word " * 30, remedy, command),
        Finding("First", "b", Severity.NOTE, "text", "", "ls"),
        Finding("Second", "c", Severity.OK, "fine"),
    ]
    lines = [piece.word + piece.text for piece in _lines(found, 80)]
    assert lines[0] == "First"
    assert lines[1].startswith("  error    word word")
    assert " " * 14 + command in lines
    assert lines[lines.index("  note     text") + 1] == " " * 11 + "-> ls"
    assert "Second" in lines
    assert lines[-1] == "1 error, no warnings, 1 note"
    assert all(len(line) <= 80 for line in lines if command not in line)


def test_colours_are_only_for_a_terminal(tmp_path: Path, esc: PtyEsc) -> None:
    file = configuration(tmp_path, esc.path)
    command = [sys.executable, "-m", "kontronik_can_gw", "doctor", "-c", str(file)]
    reader, writer = os.openpty()
    environment = {k: v for k, v in os.environ.items() if k != "NO_COLOR"} | {"TERM": "xterm", "COLUMNS": "80"}
    with subprocess.Popen(command, stdout=writer, env=environment) as process:
        os.close(writer)
        text = b""
        while True:
            try:
                text += os.read(reader, 4096)
            except OSError:  # the other end has closed
                break
        assert process.wait(30) == 0
    os.close(reader)
    assert b"\x1b[" in text
    assert b"Serial port of esc1" in text


@pytest.mark.parametrize(
    ("record", "said"),
    [
        ('directory = "afile/x"', "is a file, not a folder"),
        ('directory = "captures"\nmin_free_mb = 10000000', "nothing is written with less than 10000000 MB"),
    ],
)
def test_a_folder_of_captures_that_cannot_be_used_is_an_error(
    record: str, said: str, tmp_path: Path, esc: PtyEsc
) -> None:
    (tmp_path / "afile").write_text("")
    found, code = document(configuration(tmp_path, esc.path, f"[record]\n{record}"))
    assert code == 1
    [error] = [f for f in found["findings"] if f["severity"] == "error"]
    assert error["check"] == "config.record"
    assert said in error["text"]


def test_a_good_folder_of_captures_is_told(tmp_path: Path, esc: PtyEsc) -> None:
    found, code = document(configuration(tmp_path, esc.path, '[record]\ndirectory = "captures"\nmin_free_mb = 0'))
    assert code == 0
    assert [f["text"] for f in found["findings"] if f["check"] == "config.record"] == [
        f"captures: {tmp_path}/captures, will be made"
    ]
