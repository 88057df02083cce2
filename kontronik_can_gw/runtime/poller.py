"""Waiting for many descriptors at once: poll(2) with a handler for each.

What is ready, and what was not at a known time, is asked for once more after each wait: a process that was stopped while it waited is
answered that nothing has come once the wait's time is over (PEP 475). And by poll, not epoll, which does not ask a terminal whether
bytes are still on their way to it inside the kernel.
"""

import contextlib
import select
import selectors
import time
from collections.abc import Callable
from typing import Protocol

from kontronik_can_gw.esc.telemetry import MS

Handler = Callable[[int, int], None]
"""Called with the time and what has happened (selectors.EVENT_READ, EVENT_WRITE)."""


_READ, _IN = selectors.EVENT_READ, select.POLLIN


class Registry(Protocol):
    """Where descriptors are watched: a Poller."""

    before: int

    def register(self, fileobj: int, events: int, data: Handler) -> object:
        """Watch a descriptor."""

    def modify(self, fileobj: int, events: int, data: Handler) -> object:
        """Watch it for something else."""

    def unregister(self, fileobj: int) -> object:
        """Watch it no longer. KeyError if it was not watched."""


class Poller:
    """A poll object. A descriptor that hung up counts as readable, and as writable where that is watched.

    ``now``: when was last asked what is ready, ``before``: the time before that. What was not ready then has come since.
    """

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._clock = clock
        self.now = self.before = clock()
        self._poll = select.poll()
        self._watched: dict[int, tuple[Handler, int]] = {}

    def register(self, fileobj: int, events: int, data: Handler) -> None:
        self._poll.register(fileobj, _mask(events))
        self._watched[fileobj] = (data, events)

    def modify(self, fileobj: int, events: int, data: Handler) -> None:
        self.register(fileobj, events, data)

    def unregister(self, fileobj: int) -> None:
        del self._watched[fileobj]
        with contextlib.suppress(KeyError):
            self._poll.unregister(fileobj)

    def wait(self, pause_ns: int) -> list[tuple[Handler, int]]:
        """Wait until something happens, ``pause_ns`` is over (rounded up to a millisecond), or a signal comes; then ask what is ready.

        Returns handlers of what there is, with what.
        """
        if pause_ns > 0:
            self._poll.poll(-(-pause_ns // MS))
        self.before, self.now = self.now, self._clock()
        happened = self._poll.poll(0)
        watched = self._watched
        return [
            (watched[fd][0], _READ if bits == _IN else self._events(fd, bits))
            for fd, bits in happened
        ]

    def _events(self, fd: int, bits: int) -> int:
        if bits & select.POLLNVAL:  # a driver has closed it: it would stay readable
            self._poll.unregister(fd)
        readable = selectors.EVENT_READ if bits & ~select.POLLOUT else 0
        writable = selectors.EVENT_WRITE if bits & ~select.POLLIN else 0
        return self._watched[fd][1] & (readable | writable)

    def close(self) -> None:
        self._watched.clear()


def _mask(events: int) -> int:
    reading = select.POLLIN if events & selectors.EVENT_READ else 0
    return reading | (select.POLLOUT if events & selectors.EVENT_WRITE else 0)
