"""Another configuration while the gateway runs: read and checked by a thread of its own, so that no frame waits for it.

What may touch what: ``begin``, ``take`` and ``close`` belong to the loop's thread; the thread runs ``read`` and leaves its result, which
is taken when the descriptor says that it is there.
"""

import contextlib
import logging
import os
import threading
from collections.abc import Callable

from kontronik_can_gw.errors import UserError
from kontronik_can_gw.runtime.threads import start_beside_the_loop

log = logging.getLogger("kontronik_can_gw")


class Reloader:
    """``read`` reads the configuration: what is new, None if nothing is; UserError for a faulty one."""

    def __init__(self, read: Callable[[], object | None]) -> None:
        self.new: object | None = None
        """The configuration that has taken the old one's place."""
        self._read = read
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._thread: threading.Thread | None = None
        self._result: object | None = None
        self._problems: list[str] | None = None

    def fileno(self) -> int:
        """Give a descriptor that is readable when the reading is done."""
        return self._event

    def begin(self) -> bool:
        """Start reading. False: it is being read already, or the system gives no thread."""
        if self._thread is not None:
            return False
        log.info("reading the configuration again")
        thread = threading.Thread(target=self._work, name="reload", daemon=True)
        if not start_beside_the_loop(thread):
            return False
        self._thread = thread
        return True

    def take(self, say: Callable[[int, str], None]) -> bool:
        """What came of it, said by ``say(level, text)``. True: ``new`` is to take the old configuration's place."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._event)
        if self._thread is not None:
            self._thread.join()
        self._thread = None
        problems, self._problems = self._problems, None
        self.new, self._result = self._result, None
        if problems is not None:
            for problem in problems:
                say(logging.ERROR, problem)
            say(logging.ERROR, "the new configuration is refused: the old one stays")
            return False
        if self.new is None:
            say(logging.INFO, "the configuration is unchanged")
            return False
        say(logging.INFO, "the configuration is another one: starting anew with it")
        return True

    def close(self) -> None:
        """Give the descriptor back; a reading that still goes on is left to itself."""
        event, self._event = self._event, -1
        os.close(event)

    def _work(self) -> None:
        try:
            self._result = self._read()
        except UserError as error:
            self._problems = list(error.problems)
        except Exception as error:  # a mistake of ours must not end the gateway that runs
            self._problems = [f"the configuration cannot be read: {error!r}"]
        with contextlib.suppress(OSError, ValueError):  # closed meanwhile
            os.eventfd_write(self._event, 1)
