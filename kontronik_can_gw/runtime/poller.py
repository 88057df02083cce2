"""Waiting for many descriptors at once: epoll with a handler for each, as selectors has it, at a third of its cost a turn."""

import contextlib
import select
import selectors
from collections.abc import Callable
from typing import Protocol

from kontronik_can_gw.telemetry import SECOND

Handler = Callable[[int, int], None]
"""Called with the time and what has happened (selectors.EVENT_READ, EVENT_WRITE)."""


_READ, _IN = selectors.EVENT_READ, select.EPOLLIN


class Registry(Protocol):
    """Where descriptors are watched: a Poller, or one of ``selectors``."""

    def register(self, fileobj: int, events: int, data: Handler) -> object:
        """Watch a descriptor."""

    def modify(self, fileobj: int, events: int, data: Handler) -> object:
        """Watch it for something else."""

    def unregister(self, fileobj: int) -> object:
        """Watch it no longer. KeyError if it was not watched."""


class Poller:
    """An epoll object. A descriptor that hung up counts as readable, and as writable where that is watched."""

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self._watched: dict[int, tuple[Handler, int]] = {}

    def register(self, fileobj: int, events: int, data: Handler) -> None:
        self._epoll.register(fileobj, _mask(events))
        self._watched[fileobj] = (data, events)

    def modify(self, fileobj: int, events: int, data: Handler) -> None:
        self._epoll.modify(fileobj, _mask(events))
        self._watched[fileobj] = (data, events)

    def unregister(self, fileobj: int) -> None:
        del self._watched[fileobj]
        with contextlib.suppress(OSError):  # it is closed already
            self._epoll.unregister(fileobj)

    def wait(self, pause_ns: int) -> list[tuple[Handler, int]]:
        """Handlers of what has happened, with what; empty when ``pause_ns`` is over (rounded up to a millisecond), or by a signal."""
        happened = self._epoll.poll(pause_ns / SECOND)
        watched = self._watched
        return [
            (watched[fd][0], _READ if bits == _IN else self._events(fd, bits)) for fd, bits in happened if fd in watched
        ]

    def _events(self, fd: int, bits: int) -> int:
        readable = selectors.EVENT_READ if bits & ~select.EPOLLOUT else 0
        writable = selectors.EVENT_WRITE if bits & ~select.EPOLLIN else 0
        return self._watched[fd][1] & (readable | writable)

    def close(self) -> None:
        self._epoll.close()


def _mask(events: int) -> int:
    reading = select.EPOLLIN if events & selectors.EVENT_READ else 0
    return reading | (select.EPOLLOUT if events & selectors.EVENT_WRITE else 0)
