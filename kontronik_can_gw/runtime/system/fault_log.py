"""The log: a line when a condition begins and one when it ends, no flood of one that comes and goes; written by a thread of its own.

A slow disk or a journal that stands still must not hold a frame up. What may touch what: any thread may log; only the writer's thread
writes (``BackgroundHandler._write``). What finds no room in the queue is counted, and the count is written when there is room again.
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
"""Beginnings within a minute from which nothing is said of a condition until it has not begun for a minute."""
MINUTE = 60 * SECOND
REMEMBERED = 20
CAPACITY = 1000
"""Lines that may wait to be written."""


class _Condition:
    def __init__(self) -> None:
        self.begun: int | None = None
        self.reason = ""
        self.begins: deque[int] = deque(maxlen=FLAPPING)
        self.count = 0
        """Beginnings of which nothing was said."""
        self.flaps = False


class FaultLog:
    """The conditions of a gateway by name. ``recent``: the last lines, for the statistics."""

    def __init__(self) -> None:
        self.recent: deque[str] = deque(maxlen=REMEMBERED)
        self._held: list[tuple[int, str]] | None = None
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
        """Something is wrong from now on. Said once, and once more when ``text`` becomes another one; ``quiet``: only its end is.

        ``since``: when it really began, where that is noticed later.
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
        if condition.flaps:
            condition.count += 1
            return
        if len(condition.begins) == FLAPPING and now - condition.begins[0] < MINUTE:
            condition.flaps = True
            text = f"{text.removesuffix('.')}. This comes and goes: the next line is when it has not begun for a minute."
        self.say(level, text)

    def event(self, name: str, text: str, now: int, level: int = logging.WARNING) -> None:
        """Something happened and is over already."""
        self.begin(name, text, now, level=level)
        self.forget(name)

    def end(self, name: str, text: str, now: int, counts: str = "") -> None:
        """It is over: ``text`` says what holds now; how long it lasted is added, and ``counts``. Nothing where it had not begun."""
        condition = self._known.get(name)
        if condition is None or condition.begun is None:
            return
        lasted, condition.begun = now - condition.begun, None
        if not condition.flaps:
            self.say(logging.INFO, f"{text}, after {duration(lasted)}{counts}")

    def forget(self, name: str) -> None:
        """It is over, and something else says so."""
        if (condition := self._known.get(name)) is not None and condition.begun is not None:
            condition.begun = None

    def is_on(self, name: str) -> bool:
        """True while the condition lasts."""
        condition = self._known.get(name)
        return condition is not None and condition.begun is not None

    def reason(self, name: str) -> str:
        """What was said at its beginning; empty while it is off."""
        return self._known[name].reason if self.is_on(name) else ""

    def advance(self, now: int) -> None:
        """Say what no longer comes and goes."""
        for name, condition in self._known.items():
            if condition.flaps and now - condition.begins[-1] >= MINUTE:
                lasts = condition.begun is not None
                state = f"it lasts: {condition.reason}" if lasts else "it is over"
                text = f"{name}: no longer comes and goes, {condition.count} more times; {state}"
                self.say(logging.INFO, text)
                condition.flaps, condition.count = False, 0
                condition.begins.clear()

    def say(self, level: int, text: str) -> None:
        """A line, remembered too."""
        if self._held is not None:
            self._held.append((level, text))
            return
        log.log(level, "%s", text)
        self.recent.append(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {text}")

    def hold(self) -> None:
        """Keep lines back until ``release``."""
        self._held = []

    def release(self) -> None:
        """Say what was kept back."""
        held, self._held = self._held, None
        for level, text in held or ():
            self.say(level, text)


def duration(ns: int) -> str:
    """A time span as people read it."""
    seconds = ns / SECOND
    if seconds < 100:
        return f"{seconds:.1f} s"
    if seconds < 6000:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


class BackgroundHandler(logging.Handler):
    """Writes to a stream from a thread. ``close`` waits for what is queued, but not for ever."""

    def __init__(self, stream: TextIO, longest_end_s: float = 0.1) -> None:
        super().__init__()
        self._stream = stream
        self._longest_end_s = longest_end_s
        self._worker: Worker[str] = Worker("log-writer", self._write, capacity=CAPACITY)
        self._lost = 0
        """Lines that found no room: counted by those that log, one at a time (logging.Handler)."""
        self._reported_lost = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Let the line be written; never waits for the stream."""
        try:
            # what it quotes makes no line of its own
            record.msg, record.args = (
                printable(record.getMessage()),
                (),
            )
            line = printable(self.format(record), keep="\n\t") + "\n"
        except Exception:  # a faulty message is no reason to end
            line = f"{record.msg!r} cannot be formatted\n"
        if self._worker.put(line):
            self._worker.start()  # without a thread now: with the next line
        else:
            self._lost += 1

    def close(self) -> None:
        """Write what is queued, for ``longest_end_s`` at most."""
        self._worker.stop(self._longest_end_s)
        super().close()

    def _write(self, lines: list[str]) -> None:
        if not lines:
            return
        text = "".join(lines)
        lost = self._lost
        if lost > self._reported_lost:
            text += f"{lost - self._reported_lost} log lines were lost: they could not be written in time\n"
            self._reported_lost = lost
        with contextlib.suppress(OSError, ValueError):
            # nobody reads any more: there is no one to report it to
            self._stream.write(text)
            self._stream.flush()
