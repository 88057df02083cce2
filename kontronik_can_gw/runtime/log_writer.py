"""Log lines written by a thread of their own: a slow disk or a journal that stands still must not hold a frame up.

What may touch what: any thread may log; only the writer's thread writes. They share a bounded queue; what finds no room is counted and
the count is written when there is room again.
"""

import contextlib
import logging
import threading
from collections import deque
from typing import TextIO

from kontronik_can_gw.printable import printable
from kontronik_can_gw.runtime.threads import start_beside_the_loop

CAPACITY = 1000
"""Lines that may wait to be written."""


class BackgroundHandler(logging.Handler):
    """Writes to a stream from a thread. ``close`` waits for what is queued, but not for ever."""

    def __init__(self, stream: TextIO, longest_end_s: float = 0.1) -> None:
        super().__init__()
        self._stream = stream
        self._longest_end_s = longest_end_s
        self._ready = threading.Condition()
        self._waiting: deque[str] = deque()
        self._lost = 0
        self._ending = False
        self._thread: threading.Thread | None = None

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
        with self._ready:
            if len(self._waiting) >= CAPACITY:
                self._lost += 1
                return
            self._waiting.append(line)
            if self._thread is None and not self._ending:
                thread = threading.Thread(target=self._work, name="log-writer", daemon=True)
                if start_beside_the_loop(thread):  # otherwise with the next line
                    self._thread = thread
            self._ready.notify()

    def close(self) -> None:
        """Write what is queued, for ``longest_end_s`` at most."""
        with self._ready:
            self._ending = True
            self._ready.notify()
        if self._thread is not None:
            self._thread.join(self._longest_end_s)
        super().close()

    def _work(self) -> None:
        while True:
            with self._ready:
                self._ready.wait_for(lambda: self._waiting or self._ending)
                if not self._waiting:
                    return
                text = "".join(self._waiting)
                self._waiting.clear()
                lost, self._lost = self._lost, 0
            if lost:
                text += f"{lost} log lines were lost: they could not be written in time\n"
            with contextlib.suppress(OSError, ValueError):
                # nobody reads any more: there is no one to tell
                self._stream.write(text)
                self._stream.flush()
