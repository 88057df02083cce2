"""The transmit side of the CAN interface: what waits to be sent, an interface that takes nothing for now, a bus that stands still."""

import time
from collections.abc import Callable, Sequence

from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.gateway.transmit_queue import Sent, TransmitQueue
from kontronik_can_gw.runtime.can.can_port import CanPort
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.times import MS, NEVER, SECOND

BUSY_RETRY_NS = 2 * MS
LASTING_BUSY_NS = SECOND
MAX_LATE_NS = 250 * MS
"""Measurements that are handed over later than this, or the shortest telemetry time-out, are old."""
_OK = Sent.OK  # an enumeration's members are slow to look up


class Transmitter:
    """Hands frames to an open port. ``due``: when to try again what the port did not take; NEVER where there is nothing to try again."""

    def __init__(
        self,
        channel: str,
        gateway: Gateway,
        conditions: FaultLog,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.queue = TransmitQueue()
        self.due = NEVER
        self.is_stalled = False
        """The bus has not taken a frame for long."""
        self.condition = f"CAN {channel}: sending"
        self._channel = channel
        self._gateway = gateway
        self._status = gateway.status
        self._conditions = conditions
        self._clock = clock
        self._busy_since: int | None = None

    def max_turn_ns(self) -> int:
        """A frame that is to go out this long after its turn began is old by then."""
        limit = self._gateway.core.shortest_timeout_ns
        return min(MAX_LATE_NS, limit)

    @property
    def is_idle(self) -> bool:
        """True while nothing waits, and nothing was refused lately."""
        return not (len(self.queue) or self.is_stalled) and self._busy_since is None

    def put(self, frames: Sequence[CanFrame]) -> None:
        """Let frames wait to be sent."""
        if self.queue.put_all(frames):
            self._count_losses()

    def put_refused(self, frames: Sequence[CanFrame], since: int) -> None:
        """The same for frames that a turn in C could not send; the port has taken nothing ``since`` then."""
        self._busy_since = since
        self.put(frames)

    def transmit(self, port: CanPort, now: int) -> Sent | None:
        """Hand over what waits, as far as the port takes it, and return its answer: GONE also where it was busy for too long.

        None where nothing waits or is to be tried, and where frames became late meanwhile: the next turn drops those.
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
            self._go_on(now)
        return answer

    def forget_failures(self) -> None:
        """The port is another one, or none."""
        self.due, self._busy_since = NEVER, None

    def drop_measurements(self) -> bool:
        """Throw away the measurements that wait to be sent; True where there were any. Answers stay, in their order."""
        dropped = self.queue.drop_measurements()
        self._count_losses()
        return dropped

    def clear(self) -> None:
        """Throw away what waits to be sent."""
        self.queue.clear()
        self._count_losses()

    def _busy(self, port: CanPort, answer: Sent, now: int) -> Sent:
        """The port takes no more for now; GONE if it has not for so long that it must be."""
        self._busy_since = self._busy_since or now
        waits = LASTING_BUSY_NS - (now - self._busy_since)
        if waits <= 0:
            if not port.is_socket:
                return Sent.GONE
            self._stall(now)
        # a full one becomes writable when there is room
        lasting = waits if waits > 0 else LASTING_BUSY_NS
        self.due = now + (lasting if answer is Sent.FULL else BUSY_RETRY_NS)
        return answer

    def _stall(self, now: int) -> None:
        """The bus has not taken a frame for long: what waits is too old to be of use."""
        self.clear()
        self.is_stalled = True
        text = f"CAN {self._channel}: no frame can be sent: nobody acknowledges, or the bus is full. Trying again."
        self._conditions.begin(self.condition, text, now)

    def _go_on(self, now: int) -> None:
        self.is_stalled = False
        self._conditions.end(self.condition, f"CAN {self._channel}: frames are sent again", now)
        self._gateway.can_returned(now)

    def _count_losses(self) -> None:
        status, queue = self._status, self.queue
        status.replaced_frames += queue.replaced
        status.dropped_frames += queue.dropped
        queue.replaced = queue.dropped = 0
