"""The screen in a real terminal (tmux): it is drawn, reacts to keys, and restores the terminal."""

import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from command_line import written
from simulated_bus import flight, layout_of, with_errors, write_log

from kontronik_can_gw.esc.kontronik.states import OperatingError

pytestmark = [
    pytest.mark.promise("monitor"),
    pytest.mark.extended,
    pytest.mark.skipif(shutil.which("tmux") is None, reason="apt-get install tmux"),
]
SLOWLY = ("--speed", "0.25")
"""Plays so slowly that the recording does not end before the last key."""


class Terminal:
    """A shell of 80 x 24 characters in a separate tmux server."""

    def __init__(self, folder: Path) -> None:
        self._socket = str(folder / "tmux")
        self._environment = {
            "PATH": os.environ["PATH"],
            "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
            "HOME": str(folder),
            "LANG": "C.UTF-8",
            "SHELL": "/bin/sh",
        }
        self.tmux("-f", "/dev/null", "new-session", "-d", "-x", "80", "-y", "24", "/bin/sh")
        self.tmux("set", "-g", "status", "off")

    def tmux(self, *words: str) -> str:
        command = ["tmux", "-u", "-S", self._socket, *words]
        env = self._environment
        return subprocess.check_output(command, text=True, env=env, timeout=60)

    def lines(self) -> list[str]:
        return [line.rstrip() for line in self.tmux("capture-pane", "-p").split("\n")[:-1]]

    def until(self, wanted: Callable[[list[str]], object], what: str) -> None:
        """Wait until the lines are as wanted, for at most a minute."""
        end = time.monotonic() + 60
        while not wanted(lines := self.lines()):
            assert time.monotonic() < end, f"{what}: not within a minute:\n" + "\n".join(lines)
            time.sleep(0.05)

    def type(
        self,
        key: str,
        wanted: Callable[[list[str]], object],
        what: str,
    ) -> None:
        self.tmux("send-keys", key)
        self.until(wanted, what)


@pytest.fixture
def terminal(tmp_path: Path) -> Iterator[Terminal]:
    made = Terminal(tmp_path)
    yield made
    made.tmux("kill-server")


def test_values_change_and_keys_work_in_a_terminal(terminal: Terminal, tmp_path: Path) -> None:
    names = [f"esc{number}" for number in range(1, 9)]
    frames = flight(layout_of(names), 30, [with_errors(OperatingError.UNDERVOLTAGE)])
    log = write_log(tmp_path / "8.log", frames)
    text = "[can]\nbitrate = 1000000\n"
    for name in names:
        text += f'[[esc]]\nname = "{name}"\nport = "/dev/tty{name}"\npole_pairs = 7\n'
    toml = written(tmp_path / "8.toml", text)
    words = ["monitor", str(log), "-c", str(toml), *SLOWLY]
    command = shlex.join([sys.executable, "-m", "kontronik_can_gw", *words])
    terminal.tmux("send-keys", "-l", f"{command}; echo code $?\n")

    def is_table(lines: list[str]) -> bool:
        rows = [line for line in lines if " ok 100 Hz " in line]
        return len(rows) == 8

    terminal.until(is_table, "a table")
    before = terminal.lines()[3]
    terminal.until(lambda lines: lines[3] != before, "another speed")

    def is_third_esc(lines: list[str]) -> bool:
        return "esc3" in lines[1] and "esc4" not in "".join(lines)

    terminal.type("3", is_third_esc, "one ESC")
    terminal.type("n", lambda lines: "esc4" in lines[1], "the next ESC")
    terminal.type("0", lambda lines: lines[1].startswith("ESC"), "all")
    terminal.type("Space", lambda lines: "PAUSED" in lines[0], "a pause")
    terminal.type("q", lambda lines: "code 0" in lines, "the end")
    terminal.tmux("send-keys", "-l", "echo still he''re\n")

    def is_echo(lines: list[str]) -> bool:
        typed = [line for line in lines if "echo still" in line]
        return "still here" in lines and bool(typed)

    terminal.until(is_echo, "an echo")
