"""Receives from a python-can interface that has no descriptor to wait on: a thread of its own, a bounded queue, a descriptor.

What may touch what: ``_run`` belongs to the thread, everything else to the loop's thread. They share ``ids``, ``failed`` and ``dropped``
(each written by one side only), the queue, and the descriptor, which the lock guards against a write behind its closing.
"""

import logging
import os
import threading
import time
from collections import deque
from typing import TYPE_CHECKING

from kontronik_can_gw.frames import EXTENDED, CanFrame
from kontronik_can_gw.runtime.threads import start_beside_the_loop

if TYPE_CHECKING:
    import can

log = logging.getLogger("kontronik_can_gw")

QUEUE_LENGTH = 1024
_POLL_S = 0.1
_LONGEST_END_S = 1.0


class BusReader:
    """A running thread. It ends by ``close``, or when the interface fails: then ``failed`` is True and the descriptor readable."""

    def __init__(self, bus: "can.BusABC", ids: frozenset[int]) -> None:
        self.ids = ids
        self.failed = False
        self.dropped = 0
        """Frames that came while the queue was full."""
        self._bus = bus
        self._frames: deque[tuple[CanFrame, int]] = deque()
        self._stopping = False
        self._lock = threading.Lock()
        self._fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._thread = threading.Thread(target=self._run, name="can-reader", daemon=True)
        if not start_beside_the_loop(self._thread):
            self.failed = True  # so that it is tried again with another one

    def fileno(self) -> int:
        return self._fd

    def take(self, limit: int) -> list[tuple[CanFrame, int]]:
        """The oldest frames that wait, at most ``limit``, with the times at which they were read.

        The descriptor stays readable while more wait.
        """
        try:
            os.eventfd_read(self._fd)
        except BlockingIOError:
            return []
        frames = [self._frames.popleft() for _ in range(min(limit, len(self._frames)))]
        if self._frames:
            self._wake()
        return frames

    def close(self) -> None:
        """End the thread; it takes as long as one wait of the driver. A thread that a driver holds is left behind, without effect."""
        self._stopping = True
        if self._thread.ident is not None:
            self._thread.join(_LONGEST_END_S)
        with self._lock:
            if self._fd >= 0:
                os.close(self._fd)
            self._fd = -1

    def _wake(self) -> None:
        with self._lock:
            if self._fd >= 0:
                os.eventfd_write(self._fd, 1)

    def _run(self) -> None:
        try:
            while not self._stopping:
                message = self._bus.recv(_POLL_S)
                if message is None or not self._wanted(message):
                    continue
                if len(self._frames) >= QUEUE_LENGTH:
                    self.dropped += 1
                else:
                    data, extended = bytes(message.data), message.is_extended_id
                    frame = CanFrame(message.arbitration_id, data, extended, message.is_fd)
                    # what drivers put into ``timestamp`` counts from anything
                    self._frames.append((frame, time.monotonic_ns()))
                    self._wake()
        except Exception as error:  # what a driver lets out when its adapter has gone: CanError, OSError, TypeError ...
            if not self._stopping:
                log.debug("CAN: receiving failed: %r", error)
                self.failed = True
                self._wake()

    def _wanted(self, message: "can.Message") -> bool:
        """A data frame with one of our ids, not sent by ourselves."""
        return (
            message.arbitration_id | (EXTENDED if message.is_extended_id else 0) in self.ids
            and not message.is_remote_frame
            and not message.is_error_frame
            and message.is_rx
        )
