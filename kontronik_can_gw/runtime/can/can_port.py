"""A CAN interface as the loop uses it: what a raw socket (socketcan_port.py) and python-can's drivers (open_can.py) have in common.

``send`` never blocks on SocketCAN and never raises: it says what became of the frame. ``receive`` never blocks and never raises. Data
frames come only with ids that were asked for, so that foreign traffic does not wake the process. Ids here are as SocketCAN has them:
bit 31 marks a 29-bit one.
"""

import select
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Sequence

from kontronik_can_gw.frames import CanFrame, block_of
from kontronik_can_gw.gateway.transmit_queue import Sent
from kontronik_can_gw.status import CanState

RECEIVE_LIMIT, _DISCARD_LIMIT = 64, 4096
"""Frames, error frames among them, that one call of ``receive`` or ``discard`` takes at most."""
MAX_STANDARD_ID = 0x7FF
# An enumeration's members are slow to look up.
_DOWN, _UNKNOWN = CanState.DOWN, CanState.UNKNOWN
_OK = Sent.OK

Received = list[tuple[CanFrame, int | None]]
"""Frames, each with the time at which it came, on the monotonic clock; None where that is not known."""


class CanPort(ABC):
    """An open interface that is up."""

    is_socket = False
    """True where ``fileno`` is a socket that takes struct can_frame and canfd_frame.

    Elsewhere a send that fails for want of room and one on a dead adapter look the same.
    """

    def __init__(self) -> None:
        self.state = CanState.UNKNOWN
        self.gone = False
        """The interface was removed or its driver failed: close it and open it anew."""
        self.bus_off_count = 0
        """How often the controller went to bus-off; its reader may set it back to 0."""
        self.overruns = 0
        """How often received frames were lost, in the controller or because we were late; its reader may set it back to 0."""
        self.drained = True
        """Whether the last ``receive`` left nothing: what it did not return may have been taken, as error frames are."""
        self._ids: frozenset[int] = frozenset()
        self._blocks: tuple[int, ...] = ()
        self._known_drops = 0

    @abstractmethod
    def fileno(self) -> int | None:
        """Readable when ``receive`` has something to do; None where nothing can come. ``set_receive_ids`` may change it."""

    @property
    def waits_to_be_read(self) -> bool:
        """True while ``receive`` would find something."""
        fd = self.fileno()
        if fd is None:
            return False
        poll = select.poll()
        poll.register(fd, select.POLLIN)
        return bool(poll.poll(0))

    def note_state(self, state: CanState) -> None:
        """Take over what else is known of the controller (rtnetlink)."""
        self.bus_off_count += state is CanState.BUS_OFF and self.state is not CanState.BUS_OFF
        self.state = state

    def set_receive_ids(self, ids: Collection[int]) -> None:
        """From now on receive data frames with these ids, in these blocks, and no others."""
        self._ids = frozenset(ids)
        self._blocks = tuple(can_id for can_id in ids if can_id >> 32)
        self._filter()

    def _is_wanted(self, key: int) -> bool:
        return key in self._ids or block_of(key, self._blocks) is not None

    @abstractmethod
    def receive(self, limit: int = RECEIVE_LIMIT) -> Received:
        """The data frames that have come, oldest first, at most ``limit``; follow the controller's state from error frames."""

    def discard(self) -> None:
        """Throw away the data frames that wait to be received. What error frames say still counts; data frames lost before do not."""
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
        """Hand frames to the interface until it does not take one, or ``clock`` is beyond ``latest``: the process was stopped meanwhile.

        Returns how many went and the last answer.
        """
        count, answer = (0, Sent.GONE) if self.gone else self._send_each(frames, clock, latest)
        if count and (self.state is _DOWN or self.state is _UNKNOWN):
            self.state = CanState.ERROR_ACTIVE
        if answer is not _OK and (answer is Sent.DOWN or answer is Sent.GONE):
            self.state = _DOWN
        return count, answer

    @abstractmethod
    def close(self) -> None:
        """Close the interface."""

    @abstractmethod
    def _filter(self) -> None:
        """Let only frames with ``_ids`` come."""

    @abstractmethod
    def _send_each(
        self, frames: Sequence[CanFrame], clock: Callable[[], int], latest: int
    ) -> tuple[int, Sent]: ...

    @abstractmethod
    def _drops(self) -> int:
        """Received frames that were dropped since opening because too many waited for us."""

    def _note_drops(self) -> None:
        drops = self._drops()
        self.overruns += drops != self._known_drops
        self._known_drops = drops
