"""Opens the CAN interface of the configuration: SocketCAN by a raw socket, others by python-can.

The drivers of python-can have no descriptor to wait on. A thread receives from them and hands the
frames over through a bounded queue with a descriptor. ``_read`` and ``_fail`` run in that thread,
everything else in the loop's thread. The threads share ``_ids``, ``_failed`` and ``_dropped`` (each
written by one side only), the queue, and ``_own_frames``, which has a lock.
"""

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.errors import RunError, UserError, did_you_mean
from kontronik_can_gw.frames import EXTENDED, MAX_EXTENDED_ID, CanFrame, id_and_mask
from kontronik_can_gw.gateway.transmit_queue import Sent
from kontronik_can_gw.light_imports import without_asammdf
from kontronik_can_gw.runtime.can.can_port import (
    MAX_STANDARD_ID,
    RECEIVE_LIMIT,
    CanPort,
    Received,
)
from kontronik_can_gw.runtime.can.socketcan_port import open_socketcan
from kontronik_can_gw.runtime.system.worker import Handover, Worker
from kontronik_can_gw.status import CanState
from kontronik_can_gw.times import SECOND

if TYPE_CHECKING:
    import can

log = logging.getLogger("kontronik_can_gw")

QUEUE_LENGTH = 1024
_POLL_S = 0.1
_MAX_END_S = 1.0
_RETURNING_OWN_FRAMES = ("udp_multicast",)
"""Interfaces that return each sent frame as if another device had sent it."""
_RETURN_LIMIT_NS = 10 * SECOND
"""A sent frame that has not been returned within this time was lost."""


def check_interface(config: CanConfig) -> None:
    """Raise UserError if python-can does not have the interface."""
    if config.interface == "socketcan":
        if config.options:
            log.warning("can.options: ignored, because SocketCAN has no options. Remove them.")
        return
    with without_asammdf():
        import can
    if config.interface not in can.VALID_INTERFACES:
        hint = did_you_mean(config.interface, sorted(can.VALID_INTERFACES), or_known=True)
        raise UserError(
            f"can.interface: {config.interface!r} is not an interface of python-can.{hint}"
        )


def open_can(config: CanConfig) -> CanPort:
    """Open an interface. Raises RunError with the remedy if it is down or cannot be opened."""
    if config.interface == "socketcan":
        return open_socketcan(config)
    check_interface(config)
    with without_asammdf():
        import can
    options: dict[str, Any] = {"bitrate": config.bitrate}
    if config.fd:
        options |= {"fd": True, "data_bitrate": config.data_bitrate}
    options.update(config.options)
    own_frames = OwnFrames() if config.interface in _RETURNING_OWN_FRAMES else None
    try:
        bus = can.Bus(interface=config.interface, channel=config.channel, **options)
        return DriverPort(bus, own_frames)
    except Exception as error:
        # The drivers raise exceptions of any kind, for example NameError if a library is missing.
        raise RunError(
            f"CAN {config.interface} {config.channel}: cannot be opened: {error}"
        ) from None


class OwnFrames:
    """Recognizes our own frames when the interface returns them. Two threads may use it.

    Each sent frame is expected back once. Another device that sends an identical frame is still
    noticed, because that frame arrives a second time.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._expected: deque[tuple[int, CanFrame]] = deque()
        """Times of sending and frames, oldest first."""

    def add(self, frame: CanFrame, now: int) -> None:
        """Expect a frame back. Call it before sending, because the other thread may be faster."""
        with self._lock:
            while self._expected and now - self._expected[0][0] > _RETURN_LIMIT_NS:
                self._expected.popleft()
            self._expected.append((now, _as_received(frame)))

    def take(self, frame: CanFrame) -> bool:
        """Expect a frame no longer. Return True if it was expected, that is, if it is our own."""
        received = _as_received(frame)
        with self._lock:
            for index, (_, expected) in enumerate(self._expected):
                if expected == received:
                    del self._expected[index]
                    return True
        return False


def _as_received(frame: CanFrame) -> CanFrame:
    """Return the frame without the fields that are not on the bus."""
    return CanFrame(frame.can_id, frame.data, frame.extended, frame.fd)


class DriverPort(CanPort):
    """A bus of python-can, read by a thread.

    The thread runs from the first call with an id to receive until ``close`` or a failure.
    ``own_frames`` is given for an interface that returns the frames sent through it.
    """

    def __init__(self, bus: "can.BusABC", own_frames: OwnFrames | None = None) -> None:
        super().__init__()
        self._bus = bus
        self._own_frames = own_frames
        self._worker: Worker[None] | None = None
        self._frames: Handover[tuple[CanFrame, int | None]] = Handover(QUEUE_LENGTH)
        self._dropped = 0
        """Number of frames received while the queue was full."""
        self._failed = False
        """True if the thread has ended after a failure. The descriptor became readable."""

    def fileno(self) -> int | None:
        return None if self._worker is None else self._frames.fileno()

    def close(self) -> None:
        """Close the port. It takes as long as one wait of the driver.

        A thread whose driver does not return keeps running, without effect.
        """
        if self._worker is not None:
            # The thread must end first: few drivers can be read and shut down at the same time.
            self._worker.stop(_MAX_END_S)
        self._frames.close()
        with contextlib.suppress(Exception):  # a removed interface may raise any exception
            self._bus.shutdown()

    def receive(self, limit: int = RECEIVE_LIMIT) -> Received:
        frames = self._frames.take(limit)
        self.is_drained = len(frames) < limit
        if self._has_failed():
            self.state = CanState.DOWN
        self._note_drops()
        return frames

    def _filter(self) -> None:
        if self._worker is None and not self._ids:
            return
        self._filter_bus()
        if self._worker is None:
            self._worker = Worker("can-reader", self._read, failed=self._fail, wait=lambda: None)
            # If there is no thread now, the port counts as failed, and is opened again later.
            self._failed = not self._worker.start()

    def _filter_bus(self) -> None:
        """Set the driver's filter to our ids. If it cannot filter, the thread does."""
        filters: list[can.typechecking.CanFilter] = []
        for key, mask in map(id_and_mask, sorted(self._ids)):
            is_extended = bool(key & EXTENDED)
            id_bits = MAX_EXTENDED_ID if is_extended else MAX_STANDARD_ID
            filters.append(
                {
                    "can_id": key & MAX_EXTENDED_ID,
                    "can_mask": mask & id_bits,
                    "extended": is_extended,
                }
            )
        for wanted in (filters, None):
            with contextlib.suppress(Exception):  # drivers raise exceptions of any kind
                self._bus.set_filters(wanted)
                return
        self.is_gone = True

    def _has_failed(self) -> bool:
        self.is_gone = self.is_gone or self._failed
        return self.is_gone

    def _drops(self) -> int:
        return self._dropped

    def _send_each(
        self,
        frames: Sequence[CanFrame],
        clock: Callable[[], int],
        latest: int,
    ) -> tuple[int, Sent]:
        if self._has_failed():
            return 0, Sent.GONE
        for count, frame in enumerate(frames):
            if clock() > latest:
                return count, Sent.LATE
            if self._own_frames is not None and self._is_wanted(frame.key):
                self._own_frames.add(frame, clock())
            answer = self._send_message(frame)
            if self._own_frames is not None and answer is not Sent.OK:
                self._own_frames.take(frame)
            if answer is not Sent.OK:
                return count, answer
        return len(frames), Sent.OK

    def _send_message(self, frame: CanFrame) -> Sent:
        import can

        message = can.Message(
            arbitration_id=frame.can_id,
            data=frame.data,
            is_extended_id=frame.extended,
            is_remote_frame=frame.remote,
            is_fd=frame.fd,
            bitrate_switch=frame.fd,
        )
        try:
            self._bus.send(message, timeout=0)
        except can.CanError:
            return Sent.BUSY
        except Exception:
            # Drivers raise for example OSError or termios.error if the adapter was removed.
            return Sent.GONE
        return Sent.OK

    # --- in the thread

    def _read(self, _items: list[None]) -> None:
        assert self._worker is not None
        if self._worker.is_ending:
            return
        message = self._bus.recv(_POLL_S)
        if message is None or not self._wanted(message):
            return
        data = bytes(message.data)
        frame = CanFrame(message.arbitration_id, data, message.is_extended_id, message.is_fd)
        if self._own_frames is not None and self._own_frames.take(frame):
            return
        # The origin of ``message.timestamp`` depends on the driver, so it is not used.
        if not self._frames.put((frame, time.monotonic_ns())):
            self._dropped += 1

    def _fail(self, error: Exception) -> None:
        """End the thread after an exception of the driver, for example of a removed adapter."""
        assert self._worker is not None
        if not self._worker.is_ending:
            log.debug("CAN: receiving failed: %r", error)
            self._failed = True
            self._frames.wake()
        self._worker.end()

    def _wanted(self, message: "can.Message") -> bool:
        """Return True for a data frame with one of our ids that we did not send."""
        if message.is_remote_frame or message.is_error_frame or not message.is_rx:
            return False
        flag = EXTENDED if message.is_extended_id else 0
        return self._is_wanted(message.arbitration_id | flag)
