"""Logs the begin and the end of each fault, without a flood of lines if a fault flaps.

BackgroundHandler writes the log in a thread, because a slow disk or a blocked journal must not
delay a frame. Any thread may log, but only this thread writes. Lines that do not fit into the
queue are counted, and their number is written as soon as there is room again.
"""

import contextlib
import logging
import time
from collections import deque
from typing import TextIO

from kontronik_can_gw.printable import printable
from kontronik_can_gw.runtime.system.worker import Worker
from kontronik_can_gw.times import SECOND

log = logging.getLogger("kontronik_can_gw")

FLAPPING = 6
"""A condition flaps if it begins this often within a minute.

It is then not logged until it has not begun for a minute.
"""
MINUTE = 60 * SECOND
REMEMBERED = 20
"""Number of log lines in the status document."""
CAPACITY = 1000
"""Maximum number of lines that wait to be written."""


class _Condition:
    def __init__(self) -> None:
        self.begun: int | None = None
        """Time at which the condition began. None while it does not exist."""
        self.reason = ""
        self.begins: deque[int] = deque(maxlen=FLAPPING)
        """Times of the last begins."""
        self.count = 0
        """Number of begins that were not logged."""
        self.is_flapping = False


class FaultLog:
    """Logs the conditions of a gateway, which are identified by their names."""

    def __init__(self) -> None:
        self.recent: deque[str] = deque(maxlen=REMEMBERED)
        """The last lines, for the status document."""
        self._held: list[tuple[int, str]] | None = None
        """Lines that are held back. None if lines are logged at once."""
        self._known: dict[str, _Condition] = {}

    def begin(
        self,
        name: str,
        text: str,
        now: int,
        quiet: bool = False,
        level: int = logging.WARNING,
        since: int | None = None,
    ) -> None:
        """Begin a condition and log it. A call with the same text does nothing.

        If the condition exists and ``text`` differs, the new text is logged. A ``quiet`` begin is
        not logged, but its end is. ``since`` is the begin of a fault that was noticed later.
        """
        condition = self._known.setdefault(name, _Condition())
        if condition.begun is not None and condition.reason == text:
            return
        if condition.begun is None:
            condition.begun = now if since is None else since
        condition.reason = text
        if quiet:
            return
        condition.begins.append(now)
        if condition.is_flapping:
            condition.count += 1
            return
        if len(condition.begins) == FLAPPING and now - condition.begins[0] < MINUTE:
            condition.is_flapping = True
            text = (
                f"{text.removesuffix('.')}. "
                "This happens often. The next line appears after a minute without it."
            )
        self.log(level, text)

    def event(self, name: str, text: str, now: int, level: int = logging.WARNING) -> None:
        """Log a condition that has already ended."""
        self.begin(name, text, now, level=level)
        self.forget(name)

    def end(self, name: str, text: str, now: int, counts: str = "") -> None:
        """End a condition and log its duration. Does nothing if the condition does not exist.

        ``text`` describes the present state. ``counts`` is appended after the duration.
        """
        condition = self._known.get(name)
        if condition is None or condition.begun is None:
            return
        lasted_ns = now - condition.begun
        condition.begun = None
        if not condition.is_flapping:
            self.log(logging.INFO, f"{text}, after {duration(lasted_ns)}{counts}")

    def forget(self, name: str) -> None:
        """End a condition without a line, because another line implies its end."""
        condition = self._known.get(name)
        if condition is not None:
            condition.begun = None

    def is_on(self, name: str) -> bool:
        """Return True while the condition exists."""
        condition = self._known.get(name)
        return condition is not None and condition.begun is not None

    def reason(self, name: str) -> str:
        """Return the text of the condition's begin. Empty if the condition does not exist."""
        return self._known[name].reason if self.is_on(name) else ""

    def advance(self, now: int) -> None:
        """Log the conditions that have stopped flapping."""
        for name, condition in self._known.items():
            if condition.is_flapping and now - condition.begins[-1] >= MINUTE:
                lasts = condition.begun is not None
                state = f"It still lasts: {condition.reason}" if lasts else "It has ended."
                text = (
                    f"{name}: happened {condition.count} more times, but no longer often. {state}"
                )
                self.log(logging.INFO, text)
                condition.is_flapping = False
                condition.count = 0
                condition.begins.clear()

    def log(self, level: int, text: str) -> None:
        """Log a line, and remember it for the status document."""
        if self._held is not None:
            self._held.append((level, text))
            return
        log.log(level, "%s", text)
        self.recent.append(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {text}")

    def keep_back(self) -> None:
        """Keep lines back until ``log_kept``."""
        self._held = []

    def log_kept(self) -> None:
        """Log the lines that were kept back."""
        held = self._held or []
        self._held = None
        for level, text in held:
            self.log(level, text)


def duration(ns: int) -> str:
    """Return a time span as text in seconds, minutes or hours."""
    seconds = ns / SECOND
    if seconds < 100:
        return f"{seconds:.1f} s"
    if seconds < 6000:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


class BackgroundHandler(logging.Handler):
    """Writes log lines to a stream in a thread.

    ``close`` waits for the queued lines, but at most for ``longest_end_s``.
    """

    def __init__(self, stream: TextIO, longest_end_s: float = 0.1) -> None:
        super().__init__()
        self._stream = stream
        self._longest_end_s = longest_end_s
        self._worker: Worker[str] = Worker("log-writer", self._write, capacity=CAPACITY)
        self._lost = 0
        """Number of lines that did not fit into the queue. logging.Handler locks each ``emit``."""
        self._reported_lost = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Queue the line for writing. Never waits for the stream."""
        try:
            # Line breaks in quoted texts must not start a new line of the log.
            record.msg = printable(record.getMessage())
            record.args = ()
            line = printable(self.format(record), keep="\n\t") + "\n"
        except Exception:  # a faulty message must not end the gateway
            line = f"{record.msg!r} cannot be formatted\n"
        if self._worker.put(line):
            self._worker.start()  # if there is no thread now, the next line tries again
        else:
            self._lost += 1

    def close(self) -> None:
        """Write the queued lines, for at most ``longest_end_s``."""
        self._worker.stop(self._longest_end_s)
        super().close()

    def _write(self, lines: list[str]) -> None:
        if not lines:
            return
        text = "".join(lines)
        lost = self._lost
        if lost > self._reported_lost:
            count = lost - self._reported_lost
            text += f"{count} log lines were lost: they could not be written in time\n"
            self._reported_lost = lost
        # A closed stream has no reader to whom the error could be reported.
        with contextlib.suppress(OSError, ValueError):
            self._stream.write(text)
            self._stream.flush()
