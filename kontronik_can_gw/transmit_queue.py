"""What waits to be sent: a slot for each CAN id (and multiplexer page), where the newest value wins, and a queue that keeps its order."""

from collections import deque
from collections.abc import Callable, Sequence
from enum import Enum
from operator import attrgetter

from kontronik_can_gw.frames import CanFrame

QUEUE_LENGTH = 2048
_slot_of = attrgetter("can_id", "extended", "page")
_is_queued = attrgetter("queued")


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
        """Frames of slots that were overtaken by a newer one of their id, or cleared."""
        self.dropped = 0
        """Queued frames that were lost: the queue was full, or cleared."""

    def __bool__(self) -> bool:
        return bool(self._slots or self._queue)

    def __len__(self) -> int:
        return len(self._slots) + len(self._queue)

    def put_all(self, frames: Sequence[CanFrame]) -> None:
        """Let frames wait: behind the queued ones, or in place of an older one of the id."""
        if any(map(_is_queued, frames)):
            room = QUEUE_LENGTH - len(self._queue)
            queued = [frame for frame in frames if frame.queued]
            self._queue += queued[:room]
            self.dropped += len(queued[room:])
            frames = [frame for frame in frames if not frame.queued]
        slots = self._slots
        count = len(slots) + len(frames)
        slots.update(zip(map(_slot_of, frames), frames, strict=True))
        self.replaced += count - len(slots)

    def put(self, frame: CanFrame) -> None:
        """Let one frame wait."""
        self.put_all((frame,))

    def flush(self, send: Callable[[Sequence[CanFrame]], tuple[int, Sent]]) -> tuple[int, Sent]:
        """Let ``send`` have what waits; it says how many frames went, and why not more. Returns its answer.

        A frame that was not taken stays the first of its line.
        """
        frames = self._in_order()
        count, answer = send(frames)
        if count and self._queue and len(frames) > 1:
            self._queue_has_turn = not frames[count - 1].queued
        if count == len(frames):
            self._slots.clear()
            self._queue.clear()
            return count, answer
        for frame in frames[:count]:
            if frame.queued:
                self._queue.popleft()
            else:
                del self._slots[_slot_of(frame)]
        return count, answer

    def _in_order(self) -> list[CanFrame]:
        slots = list(self._slots.values())
        if not self._queue:
            return slots
        first, second = (
            (list(self._queue), slots) if self._queue_has_turn else (slots, list(self._queue))
        )
        by_turns = [frame for pair in zip(first, second, strict=False) for frame in pair]
        both = len(by_turns) // 2
        return by_turns + first[both:] + second[both:]

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
