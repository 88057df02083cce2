"""Watching a source: a live screen with keys, lines without a terminal, or one document."""

import time
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

from rich.console import Console
from rich.text import Text

from kontronik_can_gw.desk.monitor import terminal
from kontronik_can_gw.desk.monitor.lines import ASCII, UNICODE
from kontronik_can_gw.desk.monitor.model import Monitor
from kontronik_can_gw.desk.monitor.screen import Choice, file_of, notices, plain_lines, screen
from kontronik_can_gw.desk.sources import Source
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.telemetry import SECOND

REFRESH_S = 0.15
PLAIN_LINE_S = 1.0

Stopped = Callable[[], bool]
Say = Callable[[str], None]


def watch(
    source: Source, monitor: Monitor, interval: float | None, stopped: Stopped, say: Say
) -> None:
    """Show the source until a key, ``stopped``, or without a terminal the end of a file. ``say`` takes notices."""
    console = Console(highlight=False)
    monitor.advance(source.now())
    if terminal.is_screen(console):
        _live(console, source, monitor, interval or REFRESH_S, stopped)
    else:
        _lines(source, monitor, interval or PLAIN_LINE_S, stopped, say)


def _live(
    console: Console, source: Source, monitor: Monitor, interval: float, stopped: Stopped
) -> None:
    choice = Choice()
    glyphs = ASCII if console.options.ascii_only else UNICODE

    def draw(size: tuple[int, int], keys: bool) -> list[Text]:
        return screen(monitor, source, size, choice, glyphs, keys)

    def step(until_s: float) -> bool:
        source.pump(monitor.take, until_s)
        monitor.advance(source.now())
        return not stopped()

    terminal.show(console, draw, step, interval, lambda key: obey(key, source, monitor, choice))


def obey(key: str, source: Source, monitor: Monitor, choice: Choice) -> None:
    """Do what a key asks for."""
    count = len(monitor.escs)
    match key:
        case "r":
            monitor.reset()
        case "n" | "p":
            start = -1 if key == "n" else 0
            step = 1 if key == "n" else -1
            choice.esc = ((start if choice.esc is None else choice.esc) + step) % count
        case "a" | "0" | "\x1b":
            choice.esc = None
        case " " if source.is_file:
            source.paused = not source.paused
        case digit if digit.isdecimal() and int(digit) <= count:
            choice.esc = int(digit) - 1


def _lines(source: Source, monitor: Monitor, interval: float, stopped: Stopped, say: Say) -> None:
    """Print plain lines, without terminal control."""
    due = time.monotonic() + interval
    before: list[str] = []
    while not stopped():
        source.pump(monitor.take, due)
        monitor.advance(source.now())
        if time.monotonic() < due and not source.ended:
            continue
        due = max(due + interval, time.monotonic())  # missed lines are not made up for
        texts = [text for text, _ in notices(monitor, source)]
        # a notice without its duration, which changes all the time
        news = [
            text.rpartition(" for ")[0] if text.startswith("no frames") else text for text in texts
        ]
        for text, new in zip(texts, news, strict=True):
            if new not in before:
                say(text)
        if before and not texts:
            say(f"{source.name}: frames come")
        before = news
        for each in plain_lines(monitor):
            print(each, flush=True)
        if source.ended:
            return


def once(source: Source, monitor: Monitor, timeout: float, stopped: Stopped) -> dict[str, Any]:
    """The document after each cyclic message has come, or ``timeout`` (s); of a file that at its end. RunError without a frame."""
    deadline = time.monotonic() + timeout
    while not stopped() and not source.ended and (source.is_file or not monitor.is_complete):
        now = time.monotonic()
        if not source.is_file and now >= deadline:
            break
        source.pump(monitor.take, min(deadline, now + REFRESH_S))
    monitor.advance(source.now())
    file = file_of(monitor)
    if not monitor.frames and not stopped():
        if source.is_file:
            raise RunError(f"{source.name}: holds no frame of {file}. Give its DBC (--dbc).")
        silence = f"no frame of {file} on {source.name} for {timeout:g} s."
        raise RunError(source.problem or " ".join([silence, *source.hints]))
    wall = source.wall_ns()
    head = {
        "time": None if wall is None else _iso(wall),
        "file" if source.is_file else "interface": source.name,
        "dbc": file,
    }
    return head | monitor.document()


def _iso(wall_ns: int) -> str:
    """Date and time with the offset of this machine's zone."""
    moment = datetime.fromtimestamp(wall_ns / SECOND, UTC).astimezone()
    return moment.isoformat(timespec="milliseconds")
