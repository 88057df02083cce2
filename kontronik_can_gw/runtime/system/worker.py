"""Threads beside the loop: what waits for a disk, a driver or a reader waits there.

What may touch what: ``Handover`` and ``Faults`` may be used by any thread. Of a ``Worker`` only ``work``, ``wait`` and ``failed``, as they
were given to it, run in its thread; everything else belongs to its owner, ``put`` to any thread.
"""

import contextlib
import logging
import os
import select
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

from kontronik_can_gw.runtime.system import realtime

log = logging.getLogger("kontronik_can_gw")

Item = TypeVar("Item")

FAILURE_PAUSE_S = 1.0
"""After a failure: what fails at once must not take the processor."""


def start_beside_the_loop(thread: threading.Thread) -> bool:
    """Start a thread that no signal is delivered to: they are to wake the loop. False: the system gives no thread now."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
    try:
        thread.start()  # it inherits the mask
    except RuntimeError:
        return False
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    realtime.follow(thread)
    return True


class Handover(Generic[Item]):
    """What one thread hands to another: a queue with a limit, and a descriptor that is readable while it holds something.

    Nothing here waits. A closed one still takes and gives items, but wakes nobody.
    """

    def __init__(self, capacity: int = sys.maxsize) -> None:
        self._capacity = capacity
        self._items: deque[Item] = deque()
        self._lock = threading.RLock()  # what is collected inside may log
        """Held for an instant only: nobody writes to the descriptor's number once it is closed, for it may be another's then."""
        self._fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def __len__(self) -> int:
        return len(self._items)

    def fileno(self) -> int:
        """The descriptor; -1 after ``close``."""
        return self._fd

    def put(self, item: Item) -> bool:
        """Add an item. False: there is no room."""
        with self._lock:
            if len(self._items) >= self._capacity:
                return False
            self._items.append(item)
            self.wake()
        return True

    def wake(self) -> None:
        """Let the descriptor be readable until the next ``take``."""
        with self._lock:
            if self._fd >= 0:
                os.eventfd_write(self._fd, 1)

    def take(self, limit: int = sys.maxsize) -> list[Item]:
        """The oldest items, at most ``limit``."""
        with self._lock:
            if self._fd >= 0:
                with contextlib.suppress(BlockingIOError):
                    os.eventfd_read(self._fd)
            items = self._items
            taken = [items.popleft() for _ in range(min(limit, len(items)))]
            if items:
                self.wake()
        return taken

    def close(self) -> None:
        """Close the descriptor; may be called again."""
        with self._lock:
            fd, self._fd = self._fd, -1
            if fd >= 0:
                os.close(fd)


class Report(NamedTuple):
    """A fault that begins, or is over. ``name`` is that of the condition in the fault log."""

    name: str
    begins: bool
    text: str


class Faults:
    """Faults of a worker on their way to the fault log: one report as each begins, one when it is over."""

    def __init__(self) -> None:
        self._on: set[str] = set()
        self._reports: deque[Report] = deque()

    def note(self, name: str, is_on: bool, text: str) -> None:
        """How it is now; nothing is reported where it was so before. A name belongs to one thread."""
        if is_on != (name in self._on):
            (self._on.add if is_on else self._on.discard)(name)
            self._reports.append(Report(name, is_on, text))

    def take(self) -> list[Report]:
        """The reports since the last call."""
        return [self._reports.popleft() for _ in range(len(self._reports))]


class Worker(Generic[Item]):
    """A thread that does what it is handed, oldest first.

    ``work`` is called after each ``wait`` with the items that have come, and a last time at the end, then ``ended``. What they raise is
    given to ``failed`` and does not end the thread. ``wait`` returns when there is something to do; without it the worker waits for items.
    ``faults``: what the work reports. ``busy_since``: when the work began that goes on, by ``clock``; None: there is none.
    """

    def __init__(
        self,
        name: str,
        work: Callable[[list[Item]], None],
        *,
        failed: Callable[[Exception], None] | None = None,
        wait: Callable[[], None] | None = None,
        ended: Callable[[], None] = lambda: None,
        capacity: int = sys.maxsize,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.faults = Faults()
        self.busy_since: int | None = None
        self._clock = clock
        self._name = name
        self._work = work
        self._failed = failed or self._log_failure
        self._wait = wait or self._wait_for_items
        self._ended = ended
        self._items: Handover[Item] = Handover(capacity)
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> bool:
        """Start the thread if it does not run yet. False: the system gives no thread now."""
        if self._thread is None:
            thread = threading.Thread(target=self._run, name=self._name, daemon=True)
            if not start_beside_the_loop(thread):
                return False
            self._thread = thread
        return True

    def put(self, item: Item) -> bool:
        """Hand an item over; never waits. False: too many wait, or the worker is to end."""
        return not self._ending.is_set() and self._items.put(item)

    @property
    def is_ending(self) -> bool:
        """True from ``end`` on."""
        return self._ending.is_set()

    def reports(self, what: str, slow_ns: int, now: int) -> list[Report]:
        """Faults that have begun, or are over, since the last call.

        One is that a disk does not answer: the work, on the file or folder ``what``, takes longer than ``slow_ns``.
        """
        since = self.busy_since
        is_slow = since is not None and now - since > slow_ns
        if is_slow or since is None:
            text = "does not answer; the gateway is not held up." if is_slow else "answers again"
            self.faults.note(f"{what}: disk", is_slow, f"{what}: the disk {text}")
        return self.faults.take()

    def end(self) -> None:
        """Let the thread end when it has done what waits; may be called by the thread itself."""
        self._ending.set()
        self._items.wake()

    def stop(self, limit_s: float) -> bool:
        """End, and wait for it at most so long. False: that was not enough; the thread is left, and ends when it can."""
        self.end()
        if self._thread is not None:
            self._thread.join(limit_s)
            if self._thread.is_alive():
                return False
        self._items.close()
        return True

    def pause(self, seconds: float) -> None:
        """Wait, in the thread: so long, or until the worker is to end."""
        self._ending.wait(seconds)

    def _run(self) -> None:
        is_last = False
        while not is_last:
            try:
                if not self._ending.is_set():  # whose wake may be read already, with the last items
                    self._wait()
                is_last = self._ending.is_set()  # asked first: what was put before the end is done
                items, self.busy_since = self._items.take(), self._clock()
                self._work(items)
            except Exception as error:  # whatever it is: the next item has its turn
                self._failed(error)
                self.pause(FAILURE_PAUSE_S)
            self.busy_since = None
        try:
            self._ended()
        except Exception as error:
            self._failed(error)

    def _wait_for_items(self) -> None:
        poll = select.poll()
        poll.register(self._items.fileno(), select.POLLIN)
        poll.poll()

    def _log_failure(self, error: Exception) -> None:
        log.error("%s: %r", self._name, error)
