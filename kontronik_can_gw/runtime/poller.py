"""Waits for many descriptors, each with a handler.

epoll waits, because its cost does not grow with the number of descriptors. After each wait, poll
finds the descriptors that are ready, and proves that the others were not ready at a known time:

1. If the process is suspended during a wait that ends by time, epoll reports no descriptor, even if
   one has become ready meanwhile (PEP 475).
2. epoll does not check whether a terminal has bytes that are still on their way inside the kernel.
"""

import contextlib
import select
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from kontronik_can_gw.runtime.port_input import PortInput
from kontronik_can_gw.times import SECOND

Handler = Callable[[int, int], None]
"""Called with the time and the events (select.POLLIN, POLLOUT)."""


_IN = select.POLLIN


class Work(NamedTuple):
    """The work that ends a wait of the loop."""

    ready: list[tuple[Handler, int]]
    """The handlers of the ready descriptors, with their events."""
    is_due: bool
    """True if other work than that of the handlers is due."""


class LoopTimes:
    """Times of the loop in ns.

    The loop in C continues with the same times. It has a structure with the same attributes
    (``kcg_turn_times`` in native/linux.h).
    """

    def __init__(self, now: int) -> None:
        self.now = now
        """Time of the current iteration, or the last one."""
        self.polled = now
        """Time of the last poll of all descriptors."""
        self.before = now
        """Time of an earlier poll. Frames that are read from the bus now have arrived since."""
        self.settings_checked = 0
        """Time of the last check of the settings of the ports."""


class Poller:
    """Watched descriptors.

    A descriptor that hung up counts as readable, and as writable if that is watched.
    """

    is_native = False
    """True for a ``NativePoller``, which makes iterations of the loop in C."""

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._clock = clock
        self.times: Any = LoopTimes(clock())
        self.late = 0
        """By how many ns the last iteration and the wait took longer than planned."""
        self.changes = 0
        """Increases with each change of the watched descriptors."""
        self._poll = select.poll()
        self._epoll = select.epoll()
        self._watched: dict[int, tuple[Handler, int, int | None]] = {}
        self._closed: set[int] = set()
        """Watched descriptors that a driver has closed. They would always be readable."""

    def register(
        self,
        fd: int,
        handler: Handler,
        events: int = _IN,
        esc: int | None = None,
    ) -> None:
        """Watch a descriptor. If it is already watched, handler and events are replaced.

        ``esc`` is the number of the ESC if the descriptor is the port of an ESC.
        """
        self._poll.register(fd, events)
        try:
            self._epoll.register(fd, events)
        except FileExistsError:
            self._epoll.modify(fd, events)
        self._watched[fd] = (handler, events, esc)
        self._closed.discard(fd)
        self.changes += 1

    def unregister(self, fd: int) -> None:
        """Stop watching a descriptor. Raises KeyError if it is not watched."""
        del self._watched[fd]
        self.changes += 1
        with contextlib.suppress(KeyError):
            self._poll.unregister(fd)
        with contextlib.suppress(OSError):  # it is already closed
            self._epoll.unregister(fd)

    def wait(self, due: int) -> list[tuple[Handler, int]]:
        """Wait for an event, a signal, or the time ``due``, rounded up to a millisecond.

        Returns the handlers of the ready descriptors, with their events.
        """
        pause = due - self._clock()
        if pause > 0:
            self._epoll.poll(pause / SECOND, 1)
        else:
            pause = 0
        times = self.times
        times.before = times.polled
        times.polled = self._clock()
        self.late = times.polled - times.now - pause
        return self.handlers(self._poll.poll(0))

    def handlers(self, happened: list[tuple[int, int]]) -> list[tuple[Handler, int]]:
        """Return the handlers of ready descriptors, given with poll's events."""
        watched = self._watched
        return [
            (watched[fd][0], bits if bits == _IN else self._events(fd, bits))
            for fd, bits in happened
        ]

    def noted(self, _esc: int) -> PortInput:
        """Return the notes of an ESC's port."""
        return PortInput()

    def begin(self) -> None:
        """Prepare for the first iteration of the loop."""

    def watched(self) -> list[tuple[int, int, int | None]]:
        """Return the watched descriptors, with their events and the number of their ESC."""
        found = []
        for fd, (_, events, esc) in self._watched.items():
            if fd not in self._closed:
                found.append((fd, events, esc))
        return found

    def _events(self, fd: int, bits: int) -> int:
        if bits & select.POLLNVAL:
            self._poll.unregister(fd)
            self._closed.add(fd)
            self.changes += 1
        events = 0
        if bits & ~select.POLLOUT:
            events |= select.POLLIN
        if bits & ~select.POLLIN:
            events |= select.POLLOUT
        _, watched, _ = self._watched[fd]
        return events & watched

    def close(self) -> None:
        self._watched.clear()
        self._epoll.close()
