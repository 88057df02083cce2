"""What waits to be sent: a slot for each CAN id (and multiplexer page), where the newest value wins, and a queue that keeps its order."""

from collections import deque
from collections.abc import Sequence
from enum import Enum
from operator import itemgetter

from kontronik_can_gw.frames import FIRST_PART, PARTS, CanFrame

QUEUE_LENGTH = 2048
_place = CanFrame._fields.index
_slot_of = itemgetter(_place("can_id"), _place("extended"), _place("page"))
_is_queued = itemgetter(_place("queued"))


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


class TransmitQueue:
    """Frames that wait to be sent: slots in the order in which their ids began to wait, ``queued`` frames in the order of ``put``.

    While both wait they take turns, so that neither a long SDO block nor fast PDOs keep the other from the bus.
    """

    def __init__(self) -> None:
        self._slots: dict[tuple[int, bool, int], CanFrame] = {}
        self._queue: deque[CanFrame] = deque()
        self._queue_has_turn = True
        self.replaced = 0
        """Frames of slots that gave way to a newer one of their id or to an older transfer, or cleared; its owner may set it back to 0."""
        self.dropped = 0
        """Queued frames that were lost: the queue was full, or cleared; likewise."""

    def __len__(self) -> int:
        return len(self._slots) + len(self._queue)

    def put_all(self, frames: Sequence[CanFrame]) -> int:
        """Let frames wait: after the queued ones, or in place of an older one of the id. Returns how many were lost by it."""
        dropped = 0
        if any(map(_is_queued, frames)):
            room = QUEUE_LENGTH - len(self._queue)
            queued = [frame for frame in frames if frame.queued]
            self._queue += queued[:room]
            dropped = len(queued[room:])
            self.dropped += dropped
            frames = [frame for frame in frames if not frame.queued]
        slots = self._slots
        count = len(slots) + len(frames)
        if slots:
            frames = [frame for frame in frames if not self._has_begun(frame)]
        slots.update(zip(map(_slot_of, frames), frames, strict=True))
        replaced = count - len(slots)
        self.replaced += replaced
        return replaced + dropped

    def _has_begun(self, frame: CanFrame) -> bool:
        """True for a part of a transfer while an older one is on its way: its first frame is gone, others wait. It ends as it began."""
        can_id, _, extended, _, page, _, _ = frame
        if page < FIRST_PART:
            return False
        first = page - (page - FIRST_PART) % PARTS
        waiting = [(can_id, extended, first + part) in self._slots for part in range(PARTS)]
        return any(waiting) and not waiting[0]

    def in_order(self) -> list[CanFrame]:
        """All that wait, in the order in which they are to be sent."""
        slots = list(self._slots.values())
        if not self._queue:
            return slots
        first, second = (
            (list(self._queue), slots) if self._queue_has_turn else (slots, list(self._queue))
        )
        by_turns = [frame for pair in zip(first, second, strict=False) for frame in pair]
        both = len(by_turns) // 2
        return by_turns + first[both:] + second[both:]

    def remove(self, frames: Sequence[CanFrame], count: int) -> None:
        """Forget the first ``count`` of ``frames``, which ``in_order`` gave: they were sent. The next one stays first of its kind."""
        if self._queue and count and len(frames) > 1:
            self._queue_has_turn = not frames[count - 1].queued
        if count == len(frames):
            self._slots.clear()
            self._queue.clear()
            return
        for frame in frames[:count]:
            if frame.queued:
                self._queue.popleft()
            else:
                del self._slots[_slot_of(frame)]

    def take_all(self) -> list[CanFrame]:
        """All that wait, in order; nothing waits any more."""
        frames = self.in_order()
        self.remove(frames, len(frames))
        return frames

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
