"""The screen in a real terminal (tmux): drawn, redrawn after a resize, obeying keys, and leaving the terminal as it was."""

import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from simulated_bus import flight, layout_of, with_errors, write_log

from kontronik_can_gw.protocol.states import OperatingError

pytestmark = [
    pytest.mark.extended,
    pytest.mark.skipif(shutil.which("tmux") is None, reason="tmux is not installed: apt-get install tmux"),
]


class Terminal:
    """A shell in a tmux server of its own."""

    def __init__(self, folder: Path, size: tuple[int, int], term: str = "screen-256color", **environment: str) -> None:
        self._socket = str(folder / "tmux")
        given = {"PATH": os.environ["PATH"], "HOME": str(folder), "LANG": "C.UTF-8", "PS1": "> ", "SHELL": "/bin/sh"}
        given |= {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))} | environment
        (folder / "tmux.conf").write_text(f'set -g default-terminal "{term}"\nset -g status off\n')
        self._environment = given
        width, height = size
        self._tmux("-f", str(folder / "tmux.conf"), "new-session", "-d", "-x", str(width), "-y", str(height), "/bin/sh")

    def _tmux(self, *words: str) -> str:
        done = subprocess.run(
            ["tmux", "-u", "-S", self._socket, *words], capture_output=True, text=True, env=self._environment, timeout=60
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout

    def type(self, text: str) -> None:
        self._tmux("send-keys", "-l", text)

    def press(self, key: str) -> None:
        self._tmux("send-keys", key)

    def resize(self, width: int, height: int) -> None:
        self._tmux("resize-window", "-x", str(width), "-y", str(height))

    def lines(self) -> list[str]:
        return [line.rstrip() for line in self._tmux("capture-pane", "-p").split("\n")[:-1]]

    def until(self, wanted: Callable[[list[str]], object], what: str, seconds: float = 60) -> list[str]:
        end = time.monotonic() + seconds
        while not wanted(lines := self.lines()):
            assert time.monotonic() < end, f"{what}: not within {seconds} s:\n" + "\n".join(lines)
            time.sleep(0.05)
        return lines

    def monitor(self, *words: object) -> None:
        command = shlex.join([sys.executable, "-m", "kontronik_can_gw", "monitor", *map(str, words)])
        self.type(f"{command}; echo code $?\n")

    def close(self) -> None:
        self._tmux("kill-server")


Open = Callable[..., Terminal]


@pytest.fixture
def terminal(tmp_path: Path) -> Iterator[Open]:
    opened: list[Terminal] = []

    def start(size: tuple[int, int] = (80, 24), **more: str) -> Terminal:
        folder = tmp_path / f"t{len(opened)}"
        folder.mkdir()
        opened.append(Terminal(folder, size, **more))
        return opened[-1]

    yield start
    for each in opened:
        each.close()


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    for count in (1, 8):
        names = [f"esc{index + 1}" for index in range(count)]
        write_log(
            folder / f"{count}.log",
            flight(layout_of(names), 60 if count == 1 else 30, [with_errors(OperatingError.UNDERVOLTAGE)]),
        )
        escs = "".join(f'[[esc]]\nname = "{name}"\nport = "/dev/ttyX{name}"\npole_pairs = 7\n' for name in names)
        (folder / f"{count}.toml").write_text(f"[can]\nbitrate = 1000000\n{escs}")
    return folder


def is_drawn(lines: list[str]) -> bool:
    return "frames/s" in lines[0] and "quit" in lines[-1] and " - frames/s" not in lines[0]


def test_values_move_and_keys_are_obeyed(terminal: Open, logs: Path) -> None:
    screen = terminal()
    screen.monitor(logs / "8.log", "-c", logs / "8.toml")
    lines = screen.until(lambda lines: sum(line.startswith("ok 100 Hz") for line in lines) == 8, "a table")
    assert is_drawn(lines)
    assert lines[1].startswith("ESC")
    before = screen.lines()[3]
    screen.until(lambda lines: lines[3] != before, "another speed")
    screen.press("3")
    screen.until(lambda lines: "esc3" in lines[1] and "esc4" not in "".join(lines), "one ESC")
    screen.press("a")
    screen.until(lambda lines: lines[1].startswith("ESC"), "all")
    screen.press("Space")
    screen.until(lambda lines: "PAUSED" in lines[0], "a pause")
    screen.press("r")
    screen.until(lambda lines: lines[-1].endswith("min/max of 0 s"), "a reset")
    screen.press("q")
    lines = screen.until(lambda lines: any(line == "code 0" for line in lines), "the end")
    assert any("seen on 8.log, none sent" in line for line in lines)
    screen.type("echo still he''re\n")
    screen.until(lambda lines: "still here" in lines and any("echo still" in line for line in lines), "an echo")


def test_ctrl_c_ends_it_and_ctrl_z_is_borne(terminal: Open, logs: Path) -> None:
    screen = terminal()
    screen.monitor(logs / "1.log")
    screen.until(is_drawn, "a screen")
    screen.press("C-z")
    screen.until(lambda lines: any("Stopped" in line for line in lines), "a shell")
    screen.type("fg\n")
    screen.until(is_drawn, "the screen again")
    screen.press("r")
    screen.until(lambda lines: lines[-1].endswith("min/max of 0 s"), "a key")
    screen.press("C-c")
    screen.until(lambda lines: any("none sent" in line for line in lines), "the end")
