"""Hands frames to the CAN interface, and keeps them while it is busy.

If no frame leaves the interface, nothing is handed over except a first frame without measurements.
"""

import time
from collections.abc import Callable, Sequence

from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.departures import CHECKS, Departures
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.gateway.transmit_queue import Sent, TransmitQueue
from kontronik_can_gw.runtime.can.can_port import CanPort
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.times import MS, NEVER, SECOND

BUSY_RETRY_NS = 2 * MS
"""Time until the next attempt after the port was busy."""
LASTING_BUSY_NS = SECOND
"""A port that has been busy for this time has failed, or its bus is stalled."""
SOON_NS = 50 * MS
"""A first frame is expected to leave within this time. It is looked for more often until then."""
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
        """True if no frame has left the interface for LASTING_BUSY_NS."""
        self.condition = f"CAN {channel}: sending"
        self._channel = channel
        self._gateway = gateway
        self._status = gateway.status
        self._conditions = conditions
        self._clock = clock
        self._busy_since: int | None = None
        """Time since which the port has accepted no frame. None if it accepted the last one."""
        self.departures = Departures()
        self._held_since: int | None = None
        """Begin of the outage because of which frames are held. None if the port is not open."""
        self._first_frame_at: int | None = None
        """Time at which the port has accepted the first frame of an outage. None before."""
        self._left_when_sent = 0
        """The interface's number of sent frames as soon as the first frame has left it."""
        self._moves_since: int | None = None
        """Time since which frames leave the interface after the first one was accepted."""
        self._repeat_due = NEVER
        """Time at which another first frame is handed over, in case the driver has lost it."""
        self._discard_due = NEVER
        """Time at which the frames that outputs have made during an outage are discarded."""

    def max_turn_ns(self) -> int:
        """Return the age at which a frame is too old to be sent, counted from its turn's start."""
        limit = self._gateway.core.shortest_timeout_ns
        return min(MAX_LATE_NS, limit)

    @property
    def is_idle(self) -> bool:
        """True if no frame waits, and the port refused none since it last accepted one."""
        return not len(self.queue) and self._busy_since is None

    @property
    def outage_since(self) -> int | None:
        """A time since which no frame has left the open interface. None without an outage."""
        return self._held_since

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
        """Take the gateway's due frames, and hand them to the port until it refuses one.

        1. Returns the last result of the port, or None if it was given no frame or the next
           attempt is not due yet.
        2. GONE is also returned if a port without a socket was busy for LASTING_BUSY_NS.
        3. None is also returned if frames became too late meanwhile. The next turn drops them.
        4. While frames are held, only the first frame is handed over.
        """
        departures = self.departures
        gateway = self._gateway
        if now >= departures.check_due and not gateway.is_held:
            departures.check(port.frames_left(), now, self.check_period_ns)
            if departures.is_blocked(now, self.check_period_ns):
                self._hold_since(departures.waits_since, now)
        if gateway.is_held:
            # Frames that are released now are sent in the next turn, at once, as in a replay.
            return self._try_first_frame(port, now)
        frames = gateway.take_frames(now)
        if frames:
            self.put(frames)
        return self._transmit_waiting(port, now)

    def _transmit_waiting(self, port: CanPort, now: int) -> Sent | None:
        if self.due != NEVER:
            if now < self.due:
                return None
            self.due = NEVER
        frames = self.queue.in_order()
        if not frames:
            self._busy_since = None
            return None
        count, answer = port.send_all(frames, self._clock, now + self.max_turn_ns())
        self.queue.remove(frames, count)
        if count:
            self._status.sent_frames += count
            self._busy_since = None
            self.departures.note_handed_over(count, now, self.check_period_ns)
        if answer is not _OK:
            if answer is Sent.LATE:
                return None
            self._status.send_failures += 1
            if answer is Sent.BUSY or answer is Sent.FULL:
                answer = self._busy(port, answer, now)
        return answer

    @property
    def check_period_ns(self) -> int:
        """Time between two checks whether frames leave the interface."""
        return self._gateway.core.shortest_timeout_ns // (CHECKS + 1)

    # --- outages

    def hold(self, now: int) -> None:
        """Send everything as after an outage: first a frame without measurements.

        The other frames are held until that frame has left the interface. Then the gateway
        repeats everything that has no cycle (``Gateway.can_returned``). Waiting frames are
        discarded. Further calls only discard the outputs' new frames.
        """
        self._hold_since(now, now)

    def _hold_since(self, since: int, now: int) -> None:
        """Hold frames because of an outage that began at ``since``."""
        gateway = self._gateway
        if gateway.is_held and not gateway.output_frames:
            return
        was_held = gateway.is_held
        if was_held:
            frames = gateway.output_frames
        else:
            # The frames that are due now are discarded, too: a replay has already taken them.
            frames = gateway.take_frames(now)
            if frames:
                gateway.not_sent(now)
        self.put(frames)  # counts them as lost
        self.clear()
        gateway.hold(now)
        if not was_held:
            self.begin_outage(since, now)

    def begin_outage(self, since: int, now: int) -> None:
        """Follow a gateway that has begun to hold its frames. The cause began at ``since``."""
        self._held_since = since
        self._discard_due = now + LASTING_BUSY_NS
        self._first_frame_at = None
        self.due = NEVER

    def _try_first_frame(self, port: CanPort, now: int) -> Sent | None:
        """Hand over the first frame, and release the others when it has left the interface."""
        departures = self.departures
        period_ns = self.check_period_ns
        has_left = departures.check(port.frames_left(), now, period_ns)
        if self._has_first_frame_left(has_left, now):
            self.release(now)
            return None
        if self._held_since is None:
            self._held_since = now
        if now - self._held_since >= LASTING_BUSY_NS and not self.is_stalled:
            self._report_stall(now)
        if now >= self._discard_due:
            self._discard_due = now + LASTING_BUSY_NS
            self.hold(now)
        if self._first_frame_at is not None:
            is_soon = now - self._first_frame_at < SOON_NS or self._moves_since is not None
            if is_soon or now < self._repeat_due:
                self.due = now + (BUSY_RETRY_NS if is_soon else period_ns)
                return None
        if self.due != NEVER and now < self.due and not has_left:
            return None
        return self._send_first_frame(port, now)

    def _send_first_frame(self, port: CanPort, now: int) -> Sent | None:
        frame = self._gateway.first_frame(now)
        if frame is None:
            self.release(now)
            return None
        count, answer = port.send_all((frame,), self._clock, now + self.max_turn_ns())
        if not count:
            self._gateway.not_sent(now)
            self._status.send_failures += answer is not Sent.LATE
            if answer is Sent.BUSY or answer is Sent.FULL:
                answer = self._busy(port, answer, now)
                self.due = now + self.check_period_ns
            return answer
        self._status.sent_frames += 1
        self._busy_since = None
        departures = self.departures
        departures.note_handed_over(1, now, self.check_period_ns)
        self._first_frame_at = now
        self._left_when_sent = departures.count + departures.waiting
        self._moves_since = None
        self._repeat_due = now + LASTING_BUSY_NS
        self.due = now + BUSY_RETRY_NS
        has_left = departures.check(port.frames_left(), now, self.check_period_ns)
        if not departures.count or self._has_first_frame_left(has_left, now):
            self.release(now)
        return answer

    def _has_first_frame_left(self, has_left: bool, now: int) -> bool:
        """Return True if the first frame has left the interface.

        Frames that were accepted before it leave first. If the driver has lost some of them, the
        number of sent frames stays too low. Then the first frame has left SOON_NS after another
        one. ``has_left`` is True if a frame has left since the last check.
        """
        if self._first_frame_at is None:
            return False
        if has_left and self._moves_since is None:
            self._moves_since = now
        if self.departures.count >= self._left_when_sent:
            return True
        return self._moves_since is not None and now - self._moves_since >= SOON_NS

    def release(self, now: int) -> None:
        """Send everything again."""
        self.due = NEVER
        self._held_since = None
        self._first_frame_at = None
        self.departures.forget()
        if self.is_stalled:
            self.is_stalled = False
            text = f"CAN {self._channel}: frames are sent again"
            self._conditions.end(self.condition, text, now)
        self._gateway.release(now)

    def use(self, port: CanPort) -> None:
        """Hand frames to a port that was just opened."""
        self.forget_failures()
        self.departures.count = port.frames_left()

    def forget_failures(self) -> None:
        """Forget refused and waiting frames, because the port was lost or is in bus-off."""
        self.due = NEVER
        self._busy_since = None
        self.departures.forget()
        self._held_since = None
        self._first_frame_at = None

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
            self._hold_since(self._busy_since, now)
            remaining_ns = LASTING_BUSY_NS
        if answer is Sent.FULL:
            self.due = now + remaining_ns  # the socket becomes writable as soon as there is room
        else:
            self.due = now + BUSY_RETRY_NS
        return answer

    def _report_stall(self, now: int) -> None:
        self.is_stalled = True
        text = (
            f"CAN {self._channel}: no frame can be sent. No other node acknowledges, "
            "or the bus is full. Trying again."
        )
        self._conditions.begin(self.condition, text, now)

    def _count_losses(self) -> None:
        status = self._status
        queue = self.queue
        status.replaced_frames += queue.replaced
        status.dropped_frames += queue.dropped
        queue.replaced = 0
        queue.dropped = 0
