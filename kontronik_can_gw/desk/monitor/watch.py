"""Watches a source: a live screen with keys, lines without a terminal, or JSON documents."""

import contextlib
import os
import select
import sys
import termios
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.text import Text

from kontronik_can_gw.desk.monitor.lines import wrapped
from kontronik_can_gw.desk.monitor.model import SILENCE_NS, Monitor
from kontronik_can_gw.desk.monitor.notices import notices
from kontronik_can_gw.desk.monitor.screen import alarms, screen, table_of
from kontronik_can_gw.desk.monitor.status import is_quiet_on
from kontronik_can_gw.desk.sources import Source
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.times import SECOND

REFRESH_S = 0.15
_LINES_S = 1.0
"""Time between two tables without a terminal."""
_QUIT = ("q", "\x03", "\x04")

Stopped = Callable[[], bool]


def watch(source: Source, monitor: Monitor, stopped: Stopped) -> None:
    """Show the source until a key is pressed or ``stopped`` returns True.

    Without a terminal, the end of a file ends it, too.
    """
    console = Console(highlight=False)
    monitor.advance(source.now())
    if console.is_terminal and not console.is_dumb_terminal:
        _live(console, source, monitor, stopped)
    else:
        _lines(source, monitor, stopped)


def _look_for_quiet(source: Source, monitor: Monitor, silence_ns: int = SILENCE_NS) -> None:
    """Ask the gateways of this machine whether one is quiet, if the bus is silent for so long."""
    if not source.is_file and monitor.silent_ns >= silence_ns and not monitor.is_quiet:
        monitor.is_quiet = is_quiet_on(source.name, source.now())


def _live(console: Console, source: Source, monitor: Monitor, stopped: Stopped) -> None:
    """Draw the screen at a fixed rate, and after each key."""
    page = 0
    due = time.monotonic()
    look_due = due
    with _keys() as fd, Live(console=console, screen=True, auto_refresh=False) as live:
        while not stopped():
            now = time.monotonic()
            if now >= look_due:
                _look_for_quiet(source, monitor)
                look_due = now + _LINES_S
            if now >= due:
                lines = screen(
                    monitor,
                    source,
                    console.size,
                    page,
                    fd is not None,
                )
                live.update(Text("\n").join(lines), refresh=True)
                due = max(due + REFRESH_S, now + REFRESH_S / 2)
            source.pump(monitor.take, min(due, now + 0.1))
            monitor.advance(source.now())
            key = None if fd is None else _typed(fd)
            if key is None:
                continue
            if key in _QUIT:
                return
            page = obey(key, source, monitor, page)
            due = now


def _typed(fd: int) -> str | None:
    """Return the typed keys, or a key that quits if the terminal is closed. None without a key."""
    readable, _, _ = select.select([fd], [], [], 0)
    if not readable:
        return None
    typed = b""
    with contextlib.suppress(OSError):
        typed = os.read(fd, 64)
    if not typed:
        return _QUIT[0]
    return typed.decode("ascii", "ignore").lower()


def obey(key: str, source: Source, monitor: Monitor, page: int) -> int:
    """Execute the command of a key. Return the number of the page to show.

    This is the number of an ESC, or 0 for the table of all ESCs.
    """
    count = len(monitor.escs)
    match key:
        case "r":
            monitor.reset()
        case "n":
            return (page + 1) % (count + 1)
        case "p":
            return (page - 1) % (count + 1)
        case "a" | "\x1b":
            return 0
        case " " if source.is_file:
            source.is_paused = not source.is_paused
        case digit if digit.isdecimal() and int(digit) <= count:
            return int(digit)
    return page


@contextlib.contextmanager
def _keys() -> Iterator[int | None]:
    """Set the terminal so that single keys can be read without echo, also Ctrl-C and Ctrl-Z.

    Yields the file descriptor, or None if standard input is not this process's terminal.
    """
    try:
        fd = sys.stdin.fileno()
        is_ours = os.isatty(fd) and os.tcgetpgrp(fd) == os.getpgrp()
    except OSError:
        is_ours = False
    if not is_ours:
        yield None
        return
    before = termios.tcgetattr(fd)
    mode = list(before)
    mode[3] &= ~(termios.ECHO | termios.ICANON | termios.ISIG)
    termios.tcsetattr(fd, termios.TCSADRAIN, mode)
    try:
        yield fd
    finally:
        with contextlib.suppress(OSError, termios.error):  # the terminal is closed
            termios.tcsetattr(fd, termios.TCSADRAIN, before)


def _lines(source: Source, monitor: Monitor, stopped: Stopped) -> None:
    """Print notices and the table at a fixed rate, without terminal control."""
    while not stopped() and not source.has_ended:
        due = time.monotonic() + _LINES_S
        while time.monotonic() < due and not source.has_ended and not stopped():
            source.pump(monitor.take, due)
        monitor.advance(source.now())
        _look_for_quiet(source, monitor)
        lines: list[Text] = []
        for text, _ in notices(monitor, source):
            lines += wrapped(text, "", 80)
        lines += table_of(monitor.escs, 80)
        lines += alarms(monitor.escs, 80)
        for line in lines:
            print(line.plain.rstrip(), flush=True)


def once(source: Source, monitor: Monitor, timeout: float, stopped: Stopped) -> dict[str, Any]:
    """Return the document after all cyclic messages were received, or after ``timeout`` (s).

    The document of a file shows its end. Raises RunError if no frame was received, unless a gateway
    of this machine is quiet on this interface.
    """
    end = time.monotonic() + timeout
    while not stopped() and not source.has_ended:
        now = time.monotonic()
        if not source.is_file and (monitor.is_complete or now >= end):
            break
        source.pump(monitor.take, now + REFRESH_S)
    monitor.advance(source.now())
    if not monitor.view.frames:
        _look_for_quiet(source, monitor, 0)
    if not monitor.view.frames and not monitor.is_quiet and not stopped():
        file = monitor.file
        name = source.name
        if source.is_file:
            raise RunError(f"{name}: contains no frame of {file}. Give its DBC (--dbc).")
        silence = f"no frame of {file} on {name} for {timeout:g} s."
        reason = " ".join([silence, *source.hints])
        raise RunError(source.problem or reason)
    return _document(source, monitor, source.now())


def stream(
    source: Source,
    monitor: Monitor,
    write: Callable[[dict[str, Any]], None],
    stopped: Stopped,
) -> None:
    """Write a document for each second of the source's clock, and one at the end of a file.

    Seconds of a bus are left out if this process missed them, for example because of a slow reader.
    """
    monitor.advance(source.now())
    due = source.now() + SECOND

    def write_until(now: int) -> None:
        nonlocal due
        if not source.is_file and now > due:
            missed = (now - due) // SECOND
            due += missed * SECOND
        while due <= now:
            monitor.advance(due)
            document = _document(source, monitor, due)
            document["problem"] = source.problem or None
            write(document)
            due += SECOND

    def take(frame: CanFrame, now: int) -> None:
        write_until(now)
        monitor.take(frame, now)

    while not stopped() and not source.has_ended:
        source.pump(take, time.monotonic() + REFRESH_S)
        write_until(source.now())
    if source.has_ended:
        write_until(source.now() + SECOND)


def _document(source: Source, monitor: Monitor, now: int) -> dict[str, Any]:
    """Return the monitor's document with its time, for ``now`` on the source's clock."""
    wall = source.wall_ns()
    moment = None
    if wall is not None:
        wall -= source.now() - now
        moment = datetime.fromtimestamp(wall / SECOND, UTC).astimezone()
    document: dict[str, Any] = {"time": None}
    if moment is not None:
        document["time"] = moment.isoformat(timespec="milliseconds")
    kind = "file" if source.is_file else "interface"
    document[kind] = source.name
    document["dbc"] = monitor.file
    return document | monitor.document()
