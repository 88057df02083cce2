"""Hands frames to the CAN interface, and keeps them while it is busy. Detects a stalled bus."""

import time
from collections.abc import Callable, Sequence

from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.gateway.transmit_queue import Sent, TransmitQueue
from kontronik_can_gw.runtime.can.can_port import CanPort
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.times import MS, NEVER, SECOND

BUSY_RETRY_NS = 2 * MS
"""Time until the next attempt after the port was busy."""
LASTING_BUSY_NS = SECOND
"""A port that has been busy for this time has failed, or its bus is stalled."""
MAX_LATE_NS = 250 * MS
"""Longest delay of a measurement. The shortest telemetry time-out may be a lower limit."""
_OK = Sent.OK  # an enumeration's members are slow to look up


class Transmitter:
    """Hands frames to an open port, and tries refused frames again."""

    def __init__(
        self,
        channel: str,
        gateway: Gateway,
        conditions: FaultLog,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.queue = TransmitQueue()
        self.due = NEVER
        """Time at which the refused frames are tried again. NEVER if there are none."""
        self.is_stalled = False
        """True if the bus has accepted no frame for LASTING_BUSY_NS."""
        self.condition = f"CAN {channel}: sending"
        self._channel = channel
        self._gateway = gateway
        self._status = gateway.status
        self._conditions = conditions
        self._clock = clock
        self._busy_since: int | None = None
        """Time since which the port has accepted no frame. None if it accepted the last one."""

    def max_turn_ns(self) -> int:
        """Return the age at which a frame is too old to be sent, counted from its turn's start."""
        limit = self._gateway.core.shortest_timeout_ns
        return min(MAX_LATE_NS, limit)

    @property
    def is_idle(self) -> bool:
        """True if no frame waits, and the port refused none since it last accepted one."""
        return not (len(self.queue) or self.is_stalled) and self._busy_since is None

    def put(self, frames: Sequence[CanFrame]) -> None:
        """Append frames to the transmit queue."""
        if self.queue.put_all(frames):
            self._count_losses()

    def put_refused(self, frames: Sequence[CanFrame], since: int) -> None:
        """Append frames that a turn in C could not send.

        ``since`` is the time since which the port has accepted no frame.
        """
        self._busy_since = since
        self.put(frames)

    def transmit(self, port: CanPort, now: int) -> Sent | None:
        """Hand the waiting frames to the port until it refuses one. Returns its last result.

        1. GONE is also returned if a port without a socket was busy for LASTING_BUSY_NS.
        2. None is returned if no frame waits, or if the next attempt is not due yet.
        3. None is also returned if frames became too late meanwhile. The next turn drops them.
        """
        if self.due != NEVER:
            if now < self.due:
                return None
            self.due = NEVER
        frames = self.queue.in_order()
        if not frames:
            if not self.is_stalled:
                self._busy_since = None
            return None
        count, answer = port.send_all(frames, self._clock, now + self.max_turn_ns())
        self.queue.remove(frames, count)
        if count:
            self._status.sent_frames += count
            self._busy_since = None
        if answer is not _OK:
            if answer is Sent.LATE:
                return None
            self._status.send_failures += 1
            if answer is Sent.BUSY or answer is Sent.FULL:
                answer = self._busy(port, answer, now)
            if answer is Sent.DOWN or answer is Sent.GONE:
                return answer
        if self.is_stalled and count:
            self._end_stall(now)
        return answer

    def forget_failures(self) -> None:
        """Forget refused frames, because the port was opened or closed."""
        self.due = NEVER
        self._busy_since = None

    def drop_measurements(self) -> bool:
        """Discard the waiting measurements. Returns True if there were any.

        Answers stay in the queue in their order.
        """
        dropped = self.queue.drop_measurements()
        self._count_losses()
        return dropped

    def clear(self) -> None:
        """Discard all waiting frames."""
        self.queue.clear()
        self._count_losses()

    def _busy(self, port: CanPort, answer: Sent, now: int) -> Sent:
        """Schedule the next attempt after the port was busy. Returns GONE if the port has failed.

        A bus that stays busy behind a socket is stalled.
        """
        self._busy_since = self._busy_since or now
        remaining_ns = LASTING_BUSY_NS - (now - self._busy_since)
        if remaining_ns <= 0:
            if not port.is_socket:
                return Sent.GONE
            self._stall(now)
            remaining_ns = LASTING_BUSY_NS
        if answer is Sent.FULL:
            self.due = now + remaining_ns  # the socket becomes writable as soon as there is room
        else:
            self.due = now + BUSY_RETRY_NS
        return answer

    def _stall(self, now: int) -> None:
        """Discard the waiting frames, which are too old to be useful, and log the stalled bus."""
        self.clear()
        self.is_stalled = True
        text = (
            f"CAN {self._channel}: no frame can be sent. No other node acknowledges, "
            "or the bus is full. Trying again."
        )
        self._conditions.begin(self.condition, text, now)

    def _end_stall(self, now: int) -> None:
        self.is_stalled = False
        self._conditions.end(self.condition, f"CAN {self._channel}: frames are sent again", now)
        self._gateway.can_returned(now)

    def _count_losses(self) -> None:
        status = self._status
        queue = self.queue
        status.replaced_frames += queue.replaced
        status.dropped_frames += queue.dropped
        queue.replaced = 0
        queue.dropped = 0
