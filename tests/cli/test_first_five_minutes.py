"""Everything that a newcomer types in the first five minutes works, or names the next step."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command_line import run

pytestmark = pytest.mark.promise("docs")

PROGRAM = [sys.executable, "-m", "kontronik_can_gw"]
NO_CONFIGURATION = "write an example with kontronik-can-gw init"
IN_THIS_ORDER = (
    ("", 2, "kontronik-can-gw --help lists all commands"),
    ("--help", 0, "kontronik-can-gw COMMAND --help describes a command"),
    ("--version", 0, "kontronik-can-gw 0."),
    ("help", 2, "'help' is unknown. Known: demo, run, "),
    ("demo --seconds 1", 0, "CAN frames of a simulated ESC decoded"),
    ("status", 3, "Start one: kontronik-can-gw run -c FILE"),
    ("run", 2, NO_CONFIGURATION),
    ("check", 2, NO_CONFIGURATION),
    ("doctor", 2, NO_CONFIGURATION),
    ("init", 0, "Edit it, then: kontronik-can-gw check -c gateway.toml"),
    ("init", 2, "gateway.toml: exists"),
    ("check", 0, "is only an example"),
    ("run", 1, "Is the adapter plugged in?"),
    ("doctor", 1, "Plug in the adapter"),
    ("monitor nocan7", 1, "CAN interface nocan7: "),
    ("simulate --seconds 2 -o flight.bin", 0, "bytes to flight.bin"),
    ("monitor --once flight.bin", 0, '"link": "Ok"'),
    ("convert", 2, "required: IN"),
    ("convert flight.bin flight.csv", 0, "flight.csv: 200 rows"),
    ("convert flight.bin flight.csv", 2, "flight.csv: exists"),
    ("report flight.bin", 2, "required: -o/--output"),
    ("report flight.bin -o flight.html", 0, "flight.html written"),
    ("dbc -o esc.dbc", 0, "esc.dbc written"),
    ("eds -o esc.eds", 0, "esc.eds written"),
)


def type_line(line: str, code: int, said: str) -> None:
    done = run(*line.split())
    assert done.code == code, (line, done)
    assert said in done.out + done.err, (line, done)
    assert "Traceback" not in done.err, (line, done)


def test_first_five_minutes_from_an_empty_folder(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
    for line, code, said in IN_THIS_ORDER:
        type_line(line, code, said)

    example = Path("gateway.toml").read_text().splitlines()
    lines = ['port = "esc1"' if line.startswith("port = ") else line for line in example]
    own = "\n".join(lines).replace('"socketcan"', '"virtual"')
    Path("gateway.toml").write_text(own)
    started = []
    try:
        for words in (["simulate", "--link", "esc1"], ["run", "--wait", "--record", "captures"]):
            started.append(subprocess.Popen([*PROGRAM, *words], stderr=subprocess.PIPE, text=True))
        while run("status").code != 0:
            assert [each.poll() for each in started] == [None, None]
            time.sleep(0.05)
        type_line("status", 0, "esc1")
        while not list(Path("captures").rglob("*.kcap")):
            time.sleep(0.05)
        messages = []
        for each in reversed(started):
            each.send_signal(signal.SIGTERM)
            messages.append(each.communicate(timeout=60)[1])
        assert [each.returncode for each in started] == [0, 0]
        assert "stopped by SIGTERM" in messages[0]
        assert "Traceback" not in "".join(messages)
    finally:
        for each in started:
            each.kill()
    type_line("status", 3, "Start it: kontronik-can-gw run -c gateway.toml")
    type_line("convert captures values.csv", 0, "values.csv: ")
