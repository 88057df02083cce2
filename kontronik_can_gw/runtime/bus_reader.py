"""Receives from a python-can interface that has no descriptor to wait on: a thread of its own, a bounded queue, a descriptor.

What may touch what: ``_receive`` and ``_fail`` run in the worker's thread, everything else in the loop's. They share ``ids``, ``failed``
and ``dropped`` (each written by one side only) and the queue.
"""

import logging
import time
from typing import TYPE_CHECKING

from kontronik_can_gw.frames import EXTENDED, CanFrame
from kontronik_can_gw.runtime.worker import Handover, Worker

if TYPE_CHECKING:
    import can

log = logging.getLogger("kontronik_can_gw")

QUEUE_LENGTH = 1024
_POLL_S = 0.1
_MAX_END_S = 1.0


class BusReader:
    """A running thread. It ends by ``close``, or when the interface fails: then ``failed`` is True and the descriptor readable."""

    def __init__(self, bus: "can.BusABC", ids: frozenset[int]) -> None:
        self.ids = ids
        self.failed = False
        self.dropped = 0
        """Frames that came while the queue was full."""
        self._bus = bus
        self._frames: Handover[tuple[CanFrame, int]] = Handover(QUEUE_LENGTH)
        self._worker: Worker[None] = Worker(
            "can-reader", self._receive, failed=self._fail, wait=lambda: None
        )
        if not self._worker.start():
            self.failed = True  # so that it is tried again with another one

    def fileno(self) -> int:
        return self._frames.fileno()

    def take(self, limit: int) -> list[tuple[CanFrame, int]]:
        """The oldest frames that wait, at most ``limit``, with the times at which they were read."""
        return self._frames.take(limit)

    def close(self) -> None:
        """End the thread; it takes as long as one wait of the driver. A thread that a driver holds is left running, without effect."""
        self._worker.stop(_MAX_END_S)
        self._frames.close()

    def _receive(self, _items: list[None]) -> None:
        if self._worker.is_ending:
            return
        message = self._bus.recv(_POLL_S)
        if message is None or not self._wanted(message):
            return
        data, extended = bytes(message.data), message.is_extended_id
        frame = CanFrame(message.arbitration_id, data, extended, message.is_fd)
        # what drivers put into ``timestamp`` counts from anything
        if not self._frames.put((frame, time.monotonic_ns())):
            self.dropped += 1

    def _fail(self, error: Exception) -> None:
        """What a driver lets out when its adapter has gone: CanError, OSError, TypeError ..."""
        if not self._worker.is_ending:
            log.debug("CAN: receiving failed: %r", error)
            self.failed = True
            self._frames.wake()
        self._worker.end()

    def _wanted(self, message: "can.Message") -> bool:
        """A data frame with one of our ids, not sent by ourselves."""
        return (
            message.arbitration_id | (EXTENDED if message.is_extended_id else 0) in self.ids
            and not message.is_remote_frame
            and not message.is_error_frame
            and message.is_rx
        )
