"""Waiting for many descriptors at once, with a handler for each: epoll waits, at a cost that does not grow with them, poll is asked.

What is ready, and what was not at a known time, is asked for once more after each wait: a process that was stopped while it waited is
answered that nothing has come once the wait's time is over (PEP 475). And by poll, not epoll, which does not ask a terminal whether
bytes are still on their way to it inside the kernel.
"""

import contextlib
import select
import time
from collections.abc import Callable
from typing import Protocol

from kontronik_can_gw.esc.telemetry import SECOND

Handler = Callable[[int, int], None]
"""Called with the time and what has happened (select.POLLIN, POLLOUT)."""


_IN = select.POLLIN


class Waiting(Protocol):
    """A port that is read."""

    @property
    def waits_to_be_read(self) -> bool:
        """True while a read would find something."""


class StuckCheck:
    """Whether a port is served: ``served`` is set by who reads it."""

    def __init__(self) -> None:
        self.served = True
        self._seen_waiting = False

    def is_stuck(self, port: Waiting | None) -> bool:
        """True if something has waited since the last call but one and nothing was read."""
        waiting = port is not None and not self.served and port.waits_to_be_read
        stuck = waiting and self._seen_waiting
        self.served, self._seen_waiting = False, waiting
        return stuck


class Poller:
    """Descriptors that are watched. One that hung up counts as readable, and as writable where that is watched.

    ``now``: when was last asked what is ready, ``before``: the time before that. What was not ready then has come since.
    """

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._clock = clock
        self.now = self.before = clock()
        self._poll = select.poll()
        self._epoll = select.epoll()
        self._watched: dict[int, tuple[Handler, int]] = {}

    def register(self, fd: int, handler: Handler, events: int = select.POLLIN) -> None:
        """Watch a descriptor; one that is watched, for something else from now on."""
        self._poll.register(fd, events)
        try:
            self._epoll.register(fd, events)
        except FileExistsError:
            self._epoll.modify(fd, events)
        self._watched[fd] = (handler, events)

    def unregister(self, fd: int) -> None:
        """Watch it no longer. KeyError if it was not watched."""
        del self._watched[fd]
        with contextlib.suppress(KeyError):
            self._poll.unregister(fd)
        with contextlib.suppress(OSError):  # it is closed already
            self._epoll.unregister(fd)

    def wait(self, pause_ns: int) -> list[tuple[Handler, int]]:
        """Wait until something happens, ``pause_ns`` is over (rounded up to a millisecond), or a signal comes; then ask what is ready.

        Returns handlers of what there is, with what.
        """
        if pause_ns > 0:
            self._epoll.poll(pause_ns / SECOND, 1)
        self.before, self.now = self.now, self._clock()
        happened = self._poll.poll(0)
        watched = self._watched
        return [
            (watched[fd][0], bits if bits == _IN else self._events(fd, bits))
            for fd, bits in happened
        ]

    def _events(self, fd: int, bits: int) -> int:
        if bits & select.POLLNVAL:  # a driver has closed it: it would stay readable
            self._poll.unregister(fd)
        readable = select.POLLIN if bits & ~select.POLLOUT else 0
        writable = select.POLLOUT if bits & ~select.POLLIN else 0
        return self._watched[fd][1] & (readable | writable)

    def close(self) -> None:
        self._watched.clear()
        self._epoll.close()
