"""A full screen on a terminal that is drawn again and again and obeys single keys; shared by all live screens."""

import contextlib
import io
import os
import select
import signal
import sys
import termios
import time
import tty
from collections.abc import Callable
from typing import Any, Self

from rich.console import Console
from rich.live import Live
from rich.text import Text

QUIT = ("q", "\x03", "\x04")
Draw = Callable[[tuple[int, int], bool], list[Text]]
"""Lines for a size in columns and lines; the flag: keys are read."""


def is_screen(console: Console) -> bool:
    """True where a full screen can be shown."""
    return console.is_terminal and not console.is_dumb_terminal


def show(
    console: Console,
    draw: Draw,
    step: Callable[[float], bool],
    interval: float,
    press: Callable[[str], None] = lambda _key: None,
) -> None:
    """Draw each ``interval`` seconds and after each key, until ``q``.

    ``step`` works until a time of ``time.monotonic``, may return sooner, and ends the screen by False; ``press`` is given the keys.
    """
    with Keys() as keys, Live(console=console, screen=True, auto_refresh=False) as live:
        keys.on_continued = lambda: console.set_alt_screen(True)
        due = time.monotonic()
        while True:
            now = time.monotonic()
            if now >= due:
                size = (console.size.width, console.size.height)
                live.update(Text("\n").join(draw(size, keys.work)), refresh=True)
                due = max(due + interval, now + interval / 2)
            if not step(min(due, now + 0.1)):
                return
            for key in keys.pressed():
                if key.lower() in QUIT:
                    return
                press(key.lower())
                due = now


class Keys:
    """Reads single keys without echo, as context manager. No keys where standard input is no terminal."""

    def __init__(self) -> None:
        self.work = False
        self.on_continued: Callable[[], object] = lambda: None
        self._fd = -1
        self._before: list[Any] | None = None

    def __enter__(self) -> Self:
        with contextlib.suppress(
            OSError, ValueError, AttributeError, io.UnsupportedOperation, termios.error
        ):
            fd = sys.stdin.fileno()
            if os.isatty(fd) and os.tcgetpgrp(fd) == os.getpgrp():
                self._fd, self._before = fd, termios.tcgetattr(fd)
                tty.setcbreak(fd)
                self.work = True
        self._old = signal.signal(signal.SIGCONT, self._continued)
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGCONT, self._old)
        if self._before is not None:
            with contextlib.suppress(OSError, termios.error):  # the terminal is closed
                termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)

    def pressed(self) -> str:
        """Keys pressed since the last call, without keys of several characters (arrows)."""
        if not self.work:
            return ""
        try:
            if not select.select([self._fd], [], [], 0)[0]:
                return ""
            data = os.read(self._fd, 64)
        except OSError:
            data = b""
        if not data:  # the terminal is closed
            self.work = False
        text = data.decode("ascii", "ignore")
        return text if len(text) == 1 or not text.startswith("\x1b") else ""

    def _continued(self, *_: object) -> None:
        """Set up the terminal again after Ctrl-Z and fg."""
        if self.work:
            tty.setcbreak(self._fd)
        self.on_continued()
