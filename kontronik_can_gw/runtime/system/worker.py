"""Runs work that may wait for a disk, a driver or a reader in threads beside the loop.

Any thread may use ``Handover`` and ``WorkerFaults``. The functions ``work``, ``wait``, ``failed``
and ``ended`` that are given to a ``Worker`` run in its thread. Its methods may only be called by
its owner, except ``put``, which any thread may call.
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
"""Pause after a failure, so that work that always fails does not use up the processor."""


def start_beside_the_loop(thread: threading.Thread) -> bool:
    """Start a thread that receives no signals, because signals must wake the loop.

    Returns False if the system provides no thread now.
    """
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
    """A queue between two threads, with a limit and a descriptor. No call waits.

    The descriptor is readable while the queue contains an item. After ``close`` the queue still
    accepts and returns items, but wakes no thread.
    """

    def __init__(self, capacity: int = sys.maxsize) -> None:
        self._capacity = capacity
        self._items: deque[Item] = deque()
        self._lock = threading.RLock()
        """Prevents a write to the descriptor after ``close``, when its number may have a new owner.

        It is held only briefly. It is reentrant because a garbage collection inside may log.
        """
        self._fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def __len__(self) -> int:
        return len(self._items)

    def fileno(self) -> int:
        """Return the descriptor. -1 after ``close``."""
        return self._fd

    def put(self, item: Item) -> bool:
        """Append an item. Returns False if the queue is full."""
        with self._lock:
            if len(self._items) >= self._capacity:
                return False
            self._items.append(item)
            self.wake()
        return True

    def wake(self) -> None:
        """Make the descriptor readable until the next ``take``."""
        with self._lock:
            if self._fd >= 0:
                os.eventfd_write(self._fd, 1)

    def take(self, limit: int = sys.maxsize) -> list[Item]:
        """Remove the oldest items, at most ``limit``, and return them."""
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
        """Close the descriptor. A second call changes nothing."""
        with self._lock:
            fd = self._fd
            self._fd = -1
            if fd >= 0:
                os.close(fd)


class Report(NamedTuple):
    """The begin or the end of a fault."""

    name: str
    """Name of the condition in the fault log."""
    begins: bool
    text: str


class WorkerFaults:
    """Collects reports of a worker's faults for the fault log: one at the begin, one at the end."""

    def __init__(self) -> None:
        self._on: set[str] = set()
        self._reports: deque[Report] = deque()

    def note(self, name: str, is_on: bool, text: str) -> None:
        """Set whether a fault exists now. Only a change is reported.

        All calls with one name must be made by one thread.
        """
        if is_on == (name in self._on):
            return
        if is_on:
            self._on.add(name)
        else:
            self._on.discard(name)
        self._reports.append(Report(name, is_on, text))

    def take(self) -> list[Report]:
        """Return the reports since the last call."""
        return [self._reports.popleft() for _ in range(len(self._reports))]


class Worker(Generic[Item]):
    """A thread that processes items, oldest first.

    1. ``wait`` must return when there is work. Without it, the worker waits for items.
    2. ``work`` is called after each ``wait`` with the waiting items, and a last time at the end.
    3. ``ended`` is called after the last ``work``.
    4. ``failed`` is called with an exception of these functions, which does not end the thread.
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
        self.faults = WorkerFaults()
        """The faults that the work reports."""
        self.busy_since: int | None = None
        """Start of the present call of ``work``, by ``clock``. None between calls."""
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
        """Start the thread if it does not run yet.

        Returns False if the system provides no thread now.
        """
        if self._thread is None:
            thread = threading.Thread(target=self._run, name=self._name, daemon=True)
            if not start_beside_the_loop(thread):
                return False
            self._thread = thread
        return True

    def put(self, item: Item) -> bool:
        """Hand an item over. Never waits.

        Returns False if the queue is full or if the worker is ending.
        """
        return not self._ending.is_set() and self._items.put(item)

    @property
    def is_ending(self) -> bool:
        """True after a call of ``end``."""
        return self._ending.is_set()

    def reports(self, target: str, slow_ns: int, now: int) -> list[Report]:
        """Return the begins and ends of faults since the last call.

        A call of ``work`` that takes longer than ``slow_ns`` is a fault, too: the disk of
        ``target``, a file or folder, does not answer.
        """
        since = self.busy_since
        is_slow = since is not None and now - since > slow_ns
        if is_slow or since is None:
            text = "does not answer. The gateway keeps running." if is_slow else "answers again"
            self.faults.note(f"{target}: disk", is_slow, f"{target}: the disk {text}")
        return self.faults.take()

    def end(self) -> None:
        """Let the thread end after the waiting items. The thread may call it, too."""
        self._ending.set()
        self._items.wake()

    def stop(self, limit_s: float) -> bool:
        """End the thread, and wait at most ``limit_s`` for its end.

        Returns False if it still runs. It then ends as soon as its work returns.
        """
        self.end()
        if self._thread is not None:
            self._thread.join(limit_s)
            if self._thread.is_alive():
                return False
        self._items.close()
        return True

    def pause(self, seconds: float) -> None:
        """Wait in the thread for this time, or until ``end`` is called."""
        self._ending.wait(seconds)

    def _run(self) -> None:
        is_last = False
        while not is_last:
            try:
                # The last ``take`` may already have consumed the wake of ``end``.
                if not self._ending.is_set():
                    self._wait()
                # This must be read before ``take``, so that no item put before the end is lost.
                is_last = self._ending.is_set()
                items = self._items.take()
                self.busy_since = self._clock()
                self._work(items)
            except Exception as error:
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
