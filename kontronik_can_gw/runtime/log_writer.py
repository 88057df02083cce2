"""Log lines written by a thread of their own: a slow disk or a journal that stands still must not hold a frame up.

What may touch what: any thread may log; only the writer's thread writes (``_write``). What finds no room in the queue is counted, and the
count is written when there is room again.
"""

import contextlib
import logging
from typing import TextIO

from kontronik_can_gw.printable import printable
from kontronik_can_gw.runtime.worker import Worker

CAPACITY = 1000
"""Lines that may wait to be written."""


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
