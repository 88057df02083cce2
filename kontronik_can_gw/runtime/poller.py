"""Waiting for many descriptors at once, with a handler for each: epoll waits, at a cost that does not grow with them, poll is asked.

What is ready, and what was not at a known time, is asked for once more after each wait: a process that was stopped while it waited is
answered that nothing has come once the wait's time is over (PEP 475). And by poll, not epoll, which does not ask a terminal whether
bytes are still on their way to it inside the kernel.
"""

import contextlib
import select
import time
from collections.abc import Callable

from kontronik_can_gw.runtime.port_input import PortInput
from kontronik_can_gw.times import MS, SECOND

Handler = Callable[[int, int], None]
"""Called with the time and what has happened (select.POLLIN, POLLOUT)."""


MIN_HELD_UP_NS = 20 * MS
"""A turn that is later than this, and than ``Transmitter.max_turn_ns``, was held up."""
_IN = select.POLLIN


class Poller:
    """Descriptors that are watched. One that hung up counts as readable, and as writable where that is watched.

    ``now``: when was last asked what is ready, ``before``: the time before that. What was not ready then has come since.
    ``late``: by how much more than its pause the last turn and the wait took. ``changes`` grows with each change of what is watched.
    ``is_native``: it is a ``NativePoller``, which has turns. ``is_over``: it has left nothing to do, but for what is ready.
    """

    is_native = False

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._clock = clock
        self.now = self.before = clock()
        self.late = 0
        self.is_over = False
        self.changes = 0
        self._poll = select.poll()
        self._epoll = select.epoll()
        self._watched: dict[int, tuple[Handler, int, int | None]] = {}
        self._closed: set[int] = set()
        """Watched, but closed by a driver: they would stay readable."""

    def register(
        self, fd: int, handler: Handler, events: int = _IN, esc: int | None = None
    ) -> None:
        """Watch a descriptor; one that is watched, for something else from now on. ``esc``: it is this one's port."""
        self._poll.register(fd, events)
        try:
            self._epoll.register(fd, events)
        except FileExistsError:
            self._epoll.modify(fd, events)
        self._watched[fd] = (handler, events, esc)
        self._closed.discard(fd)
        self.changes += 1

    def unregister(self, fd: int) -> None:
        """Watch it no longer. KeyError if it was not watched."""
        del self._watched[fd]
        self.changes += 1
        with contextlib.suppress(KeyError):
            self._poll.unregister(fd)
        with contextlib.suppress(OSError):  # it is closed already
            self._epoll.unregister(fd)

    def wait(self, last: int, due: int) -> list[tuple[Handler, int]]:
        """Wait until something happens, ``due`` has come (rounded up to a millisecond), or a signal comes; then ask what is ready.

        ``last``: time of the last turn. Returns handlers of what there is, with what.
        """
        pause = due - self._clock()
        if pause > 0:
            self._epoll.poll(pause / SECOND, 1)
        else:
            pause = 0
        self.before, self.now = self.now, self._clock()
        self.late = self.now - last - pause
        return self.handlers(self._poll.poll(0))

    def handlers(self, happened: list[tuple[int, int]]) -> list[tuple[Handler, int]]:
        """Of descriptors and what poll says of them."""
        watched = self._watched
        return [
            (watched[fd][0], bits if bits == _IN else self._events(fd, bits))
            for fd, bits in happened
        ]

    def noted(self, _esc: int) -> PortInput:
        """What is noted while an ESC's port is read."""
        return PortInput()

    def begin(self) -> None:
        """The loop begins."""

    def watched(self) -> list[tuple[int, int, int | None]]:
        """The descriptors that are watched, for what, and whose port each is."""
        return [
            (fd, events, esc)
            for fd, (_, events, esc) in self._watched.items()
            if fd not in self._closed
        ]

    def _events(self, fd: int, bits: int) -> int:
        if bits & select.POLLNVAL:
            self._poll.unregister(fd)
            self._closed.add(fd)
            self.changes += 1
        readable = select.POLLIN if bits & ~select.POLLOUT else 0
        writable = select.POLLOUT if bits & ~select.POLLIN else 0
        return self._watched[fd][1] & (readable | writable)

    def close(self) -> None:
        self._watched.clear()
        self._epoll.close()
