"""A command whose reader has ended (`| head -1`) ends silently.

Its exit code is the one that a shell shows for SIGPIPE.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.promise("closed-ends")

PROGRAM = [sys.executable, "-m", "kontronik_can_gw"]
CLOSED = 141
NOTES = (
    b"kontronik-can-gw: using gateway.toml",
    (
        b"kontronik-can-gw: the ESC and its faults are simulated; "
        b"the gateway and the monitor are the real ones"
    ),
)
"""Lines that commands write to standard error before their data."""
ADDRESS_NOTE = b" shows the same in a browser"
"""End of the line with the address of the live page, whose port is any free one."""
COMMANDS = (
    "demo --seconds 20",
    "check -c gateway.toml",
    "check -v -c gateway.toml",
    "check --json -c gateway.toml",
    "doctor -c gateway.toml",
    "doctor --json -c gateway.toml",
    "init -",
    "dbc --esc 1",
    "eds",
    "describe",
    "describe --format json",
    "monitor x.bin",
    "monitor --once x.bin",
    "convert x.bin - --to csv",
    "convert x.bin - --to candump",
    "decode x.bin",
    "report x.bin -o -",
    "replay x.bin --on pty",
    "simulate --seconds 20",
    "simulate --seconds 20 -o -",
    "schema",
    "completion bash",
    "--help",
    "--version",
    "run --help",
    "service install --help",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("pipes")
    (made / "gateway.toml").write_text('[can]\ninterface = "virtual"\n[[esc]]\nport = "x"\n')
    command = [*PROGRAM, "simulate", "--seconds", "3", "-o", str(made / "x.bin")]
    subprocess.run(command, check=True, capture_output=True)
    return made


def closed(
    words: str,
    folder: Path,
    *,
    has_closed_stderr: bool,
) -> "subprocess.CompletedProcess[bytes]":
    """Run a command with a closed pipe as its standard output, which is buffered as usual."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"}
    reader, writer = os.pipe()
    os.close(reader)
    try:
        return subprocess.run(
            [*PROGRAM, *words.split()],
            stdin=subprocess.DEVNULL,
            stdout=writer,
            stderr=writer if has_closed_stderr else subprocess.PIPE,
            cwd=folder,
            env={**environment, "COLUMNS": "80"},
            timeout=120,
        )
    finally:
        os.close(writer)


@pytest.mark.parametrize("words", COMMANDS)
def test_command_without_a_reader_ends_silently(words: str, folder: Path) -> None:
    done = closed(words, folder, has_closed_stderr=False)
    lines = [line for line in done.stderr.splitlines() if not line.endswith(ADDRESS_NOTE)]
    assert [line for line in lines if line not in NOTES] == []
    assert done.returncode == CLOSED


@pytest.mark.parametrize("words", ["eds", "check none.toml", "statsu", "run --help"])
def test_unread_messages_do_not_change_the_result(words: str, folder: Path) -> None:
    assert closed(words, folder, has_closed_stderr=True).returncode == CLOSED
