"""What waits to be sent: a slot for each CAN id (and multiplexer page), where the newest value wins, and a queue that keeps its order."""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from enum import Enum
from operator import attrgetter

from kontronik_can_gw.frames import CanFrame, frame_of

QUEUE_LENGTH = 2048
_slot_of = attrgetter("can_id", "extended", "page")
_is_queued = attrgetter("queued")


_IMAGES_ONLY = {bytes}


def are_images(frames: Sequence[CanFrame | bytes]) -> bool:
    """True where all of them are images."""
    return set(map(type, frames)) == _IMAGES_ONLY


def stand_alone(frames: Sequence[CanFrame | bytes]) -> bool:
    """True where no frame replaces another or goes in front of one: empty mailboxes would hand them out as they are."""
    if len(frames) < 2 or are_images(frames):
        return True
    frames = [frame for frame in frames if isinstance(frame, CanFrame)]
    return len(set(map(_slot_of, frames))) == len(frames) and not any(map(_is_queued, frames))


class Sent(Enum):
    """What became of a frame: accepted, not now (queue full), or the interface is down or gone."""

    OK = 1
    BUSY = 2
    FULL = 3
    """Not now: our own share of the queue is full. The port becomes writable when it is not."""
    DOWN = 4
    GONE = 5
    LATE = 6
    """Not sent: it has become old while it was to be handed over."""


class Mailboxes:
    """Frames that wait to be sent: slots in the order in which their ids began to wait, ``queued`` frames in the order of ``put``.

    While both wait they take turns, so that neither a long SDO block nor fast PDOs keep the other from the bus.
    """

    def __init__(self) -> None:
        self._slots: dict[tuple[int, bool, int], CanFrame] = {}
        self._queue: deque[CanFrame] = deque()
        self._queue_has_turn = True
        self.replaced = 0
        """Frames of slots that were overtaken by a newer one of their id, or cleared."""
        self.dropped = 0
        """Queued frames that were lost: the queue was full, or cleared."""

    def __bool__(self) -> bool:
        return bool(self._slots or self._queue)

    def __len__(self) -> int:
        return len(self._slots) + len(self._queue)

    def put(self, frame: CanFrame | bytes) -> None:
        """Let a frame wait: behind the queued ones, or in place of an older one of its id."""
        frame = frame_of(frame)
        if frame.queued:
            if len(self._queue) >= QUEUE_LENGTH:
                self.dropped += 1
            else:
                self._queue.append(frame)
            return
        key = (frame.can_id, frame.extended, frame.page)
        if key in self._slots:
            self.replaced += 1
        self._slots[key] = frame

    def put_all(self, frames: Iterable[CanFrame | bytes]) -> None:
        """Let frames wait, one behind the other."""
        for frame in frames:
            self.put(frame)

    def flush(self, send: Callable[[CanFrame], Sent]) -> tuple[int, Sent]:
        """Send until nothing waits or the interface does not take more. Returns how many went and the last answer.

        A frame that was not taken stays the first of its line.
        """
        count = 0
        while self._queue or self._slots:
            queued = bool(self._queue) and (self._queue_has_turn or not self._slots)
            key = None if queued else next(iter(self._slots))
            answer = send(self._queue[0] if key is None else self._slots[key])
            if answer is not Sent.OK:
                return count, answer
            if key is None:
                self._queue.popleft()
            else:
                del self._slots[key]
            self._queue_has_turn = not queued
            count += 1
        return count, Sent.OK

    def drop_measurements(self) -> bool:
        """Drop what waits in slots; True where something did."""
        count = len(self._slots)
        self.replaced += count
        self._slots.clear()
        return bool(count)

    def clear(self) -> None:
        """Drop what waits: it is old by the time it could go."""
        self.drop_measurements()
        self.dropped += len(self._queue)
        self._queue.clear()
