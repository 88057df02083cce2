"""The interface of an open CAN port, as the loop uses it.

It is implemented by a raw socket (socketcan_port.py) and for python-can's drivers (open_can.py).

1. ``send`` never raises, and never blocks on SocketCAN. It returns the result for the frame.
2. ``receive`` never blocks and never raises. It returns only data frames with the requested ids,
   so that other traffic does not wake the process.
3. Ids are written as in SocketCAN: bit 31 marks a 29-bit id.
"""

import select
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Sequence

from kontronik_can_gw.frames import CanFrame, block_of
from kontronik_can_gw.gateway.transmit_queue import Sent
from kontronik_can_gw.gateway.under_way import UNCOUNTED
from kontronik_can_gw.status import CanState

RECEIVE_LIMIT = 64
"""Maximum number of frames, including error frames, that one call of ``receive`` reads."""
_DISCARD_LIMIT = 4096
"""The same limit of ``discard``."""
MAX_STANDARD_ID = 0x7FF

Received = list[tuple[CanFrame, int | None]]
"""Frames with their times of reception on the monotonic clock. A time is None if unknown."""


class CanPort(ABC):
    """An open interface that is up."""

    is_socket = False
    """True if ``fileno`` is a socket that accepts struct can_frame and canfd_frame.

    Without a socket, a full queue cannot be distinguished from a dead adapter.
    """

    def __init__(self) -> None:
        self.state = CanState.UNKNOWN
        self.is_gone = False
        """True if the interface was removed or its driver failed. It must be opened again."""
        self.bus_off_count = 0
        """Number of times that the controller entered bus-off. The reader may set it back to 0."""
        self.overruns = 0
        """Number of times that received frames were lost. The reader may set it back to 0.

        They are lost in the controller, or because they were not read in time.
        """
        self.is_drained = True
        """True if the last ``receive`` left no frame, including frames that it does not return."""
        self.count_fd = -1
        """Descriptor of the file with the number of ``frames_left``, or -1 if there is none."""
        self.frame_size = 0
        """Memory of a frame in the kernel's queue in bytes, as far as known. 0 if unknown."""
        self._ids: frozenset[int] = frozenset()
        self._blocks: tuple[int, ...] = ()
        self._known_drops = 0

    @abstractmethod
    def fileno(self) -> int | None:
        """Return a descriptor that is readable when there are frames for ``receive``.

        None if no frame can be received. ``set_receive_ids`` may change the descriptor.
        """

    @property
    def waits_to_be_read(self) -> bool:
        """True if ``receive`` would read a frame."""
        fd = self.fileno()
        if fd is None:
            return False
        poll = select.poll()
        poll.register(fd, select.POLLIN)
        return bool(poll.poll(0))

    def note_state(self, state: CanState) -> None:
        """Store a state of the controller that another source (rtnetlink) reported."""
        self.bus_off_count += state is CanState.BUS_OFF and self.state is not CanState.BUS_OFF
        self.state = state

    def set_receive_ids(self, ids: Collection[int]) -> None:
        """Receive only data frames with these ids. A member may also be a block of ids."""
        self._ids = frozenset(ids)
        self._blocks = tuple(can_id for can_id in ids if can_id >> 32)
        self._filter()

    def _is_wanted(self, key: int) -> bool:
        return key in self._ids or block_of(key, self._blocks) is not None

    @abstractmethod
    def receive(self, limit: int = RECEIVE_LIMIT) -> Received:
        """Return the received data frames, oldest first, at most ``limit``.

        Error frames are not returned. They update the state of the controller.
        """

    def frames_left(self) -> int:
        """Return how many frames have left the interface, including those of other programs.

        ``UNCOUNTED`` if the number is not known.
        """
        return UNCOUNTED

    def frames_queued(self) -> int:
        """Return how many own frames wait in the kernel's queue. 0 if that is not known."""
        return 0

    def discard(self) -> None:
        """Discard the data frames that have not been received yet.

        Error frames still update the state. Data frames that were lost earlier are not counted.
        """
        self.receive(_DISCARD_LIMIT)
        self._known_drops = self._drops()

    def send(self, frame: CanFrame) -> Sent:
        """Hand one frame to the interface."""
        return self.send_all((frame,))[1]

    def send_all(
        self,
        frames: Sequence[CanFrame],
        clock: Callable[[], int] = time.monotonic_ns,
        latest: int = sys.maxsize,
    ) -> tuple[int, Sent]:
        """Hand frames to the interface until it refuses one.

        Also ends if ``clock`` returns a time after ``latest``, because the process was suspended
        meanwhile. Returns the number of accepted frames and the last result.
        """
        if self.is_gone:
            self.state = CanState.DOWN
            return 0, Sent.GONE
        count, answer = self._send_each(frames, clock, latest)
        if count and self.state in (CanState.DOWN, CanState.UNKNOWN):
            self.state = CanState.ERROR_ACTIVE
        if answer in (Sent.DOWN, Sent.GONE):
            self.state = CanState.DOWN
        return count, answer

    @abstractmethod
    def close(self) -> None:
        """Close the interface."""

    @abstractmethod
    def _filter(self) -> None:
        """Set the receive filter to ``_ids``."""

    @abstractmethod
    def _send_each(
        self,
        frames: Sequence[CanFrame],
        clock: Callable[[], int],
        latest: int,
    ) -> tuple[int, Sent]: ...

    @abstractmethod
    def _drops(self) -> int:
        """Return the number of frames that were dropped since opening because of a full queue."""

    def _note_drops(self) -> None:
        drops = self._drops()
        self.overruns += drops != self._known_drops
        self._known_drops = drops
