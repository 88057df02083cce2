"""Frames that wait to be sent.

For each CAN id and multiplexer group the newest frame wins. A frame with the flag ``queued``, such
as an answer of a CANopen node, is never replaced.
"""

from collections.abc import Sequence
from enum import Enum
from itertools import pairwise
from operator import itemgetter

from kontronik_can_gw.frames import FIRST_PART, PARTS, CanFrame
from kontronik_can_gw.status import GatewayStatus

QUEUE_LENGTH = 2048
_place = CanFrame._fields.index
_key_of = itemgetter(_place("can_id"), _place("extended"), _place("page"))


class Sent(Enum):
    """The answer of a CAN interface to a frame."""

    OK = 1
    """The frame was accepted."""
    BUSY = 2
    """The queue of the interface is full. The frame must be sent later."""
    FULL = 3
    """Our own share of the queue is full. The port becomes writable when there is room."""
    DOWN = 4
    """The interface is down."""
    GONE = 5
    """The interface was removed."""
    LATE = 6
    """The frame became too old before it could be handed over, and was not sent."""


class TransmitQueue:
    """Frames that wait to be sent. Its twin is ``put`` and ``hand_over`` of native/linux.c.

    1. A frame that is not ``queued`` replaces the waiting frame of its id and group, and keeps that
       frame's place. Frames of further groups that wait behind it move up first, because the frames
       of a message share one alive counter, which must not run backward. If a frame belongs to a
       transfer and the older transfer of its id is half sent, it is discarded instead.
    2. Frames of a step are sent in the order of ``put_all``: outputs, then slots, then messages.
    3. If the interface did not take all of them, queued and other frames alternate until no frame
       waits. Neither a flood of answers nor fast measurements can then keep the other kind from the
       bus.
    """

    def __init__(self, counters: GatewayStatus | None = None) -> None:
        self.counters = counters or GatewayStatus()
        """Counts the measurements and other frames that were not sent.

        A measurement is replaced by a newer one or, as a part of a transfer, by an older one. Other
        frames are dropped if the queue is full. ``drop_measurements`` and ``clear`` count, too.
        """
        self._waiting: dict[tuple[int, ...], CanFrame] = {}
        """The frames in the order of ``put_all``. The key of a queued frame is a unique number.

        The key of any other frame is its id and group.
        """
        self._queued = 0
        """Number of queued frames in ``_waiting``."""
        self._next_number = 0
        self._has_leftovers = False
        """True if the interface took only some of the waiting frames."""
        self._queue_has_turn = True

    def __len__(self) -> int:
        return len(self._waiting)

    def put_all(self, frames: Sequence[CanFrame]) -> None:
        """Add frames.

        A frame is lost if it is replaced, if an older transfer is half sent, or if it is queued and
        ``QUEUE_LENGTH`` queued frames wait already.
        """
        count = len(self._waiting) + len(frames)
        dropped = 0
        self._has_leftovers = self._has_leftovers and bool(self._waiting)
        for frame in frames:
            if not frame.queued:
                key = _key_of(frame)
                if frame.page >= FIRST_PART and self._has_begun(frame):
                    continue
                if frame.page < FIRST_PART and key in self._waiting:
                    self._move_up_pages(key)
                self._waiting[key] = frame
            elif self._queued < QUEUE_LENGTH:
                self._waiting[(self._next_number,)] = frame
                self._next_number += 1
                self._queued += 1
            else:
                dropped += 1
        if count > len(self._waiting):
            self.counters.dropped_frames += dropped
            self.counters.replaced_frames += count - len(self._waiting) - dropped

    def _move_up_pages(self, own: tuple[int, ...]) -> None:
        """Give the waiting frame of an id and group the last place of the message's groups.

        The groups behind it move up. Nothing changes if it is the last one.
        """
        items = [*self._waiting.items()]
        places = [place for place, (key, _) in enumerate(items) if key[:2] == own[:2]]
        keys = [items[place][0] for place in places]
        start = keys.index(own)
        if start == len(keys) - 1:
            return
        replaced = items[places[start]]
        for place, behind in pairwise(places[start:]):
            items[place] = items[behind]
        items[places[-1]] = replaced
        self._waiting = dict(items)

    def _has_begun(self, frame: CanFrame) -> bool:
        """Return True if the predecessor of a frame's transfer is half sent.

        The first part of the predecessor is no longer in the queue, but later parts still wait. The
        parts of a transfer have ``PARTS`` consecutive groups.
        """
        first = frame.page - (frame.page - FIRST_PART) % PARTS
        waiting = []
        for page in range(first, first + PARTS):
            key = (frame.can_id, frame.extended, page)
            waiting.append(key in self._waiting)
        return any(waiting) and not waiting[0]

    def in_order(self) -> list[CanFrame]:
        """Return all waiting frames in the order in which they must be sent."""
        frames = list(self._waiting.values())
        if not (self._has_leftovers and self._queued):
            return frames
        queued = [frame for frame in frames if frame.queued]
        others = [frame for frame in frames if not frame.queued]
        first = queued if self._queue_has_turn else others
        second = others if self._queue_has_turn else queued
        alternating: list[CanFrame] = []
        for pair in zip(first, second, strict=False):
            alternating += pair
        count = len(alternating) // 2
        return alternating + first[count:] + second[count:]

    def share_of_measurements(self, room: int) -> int:
        """Return how many measurements must be added if only ``room`` frames are sent next.

        They alternate with the queued frames, and leave them half the room.
        """
        self._has_leftovers = True
        measurements = room
        if self._queued:
            half = room // 2 if self._queue_has_turn else (room + 1) // 2
            measurements = max(half, room - self._queued)
        return max(0, measurements - (len(self._waiting) - self._queued))

    def remove(self, frames: Sequence[CanFrame], count: int) -> None:
        """Remove the first ``count`` of ``frames``, which were sent. ``in_order`` returned them.

        The other kind than that of the last frame that was sent is next.
        """
        if self._queued and count and len(frames) > 1:
            self._queue_has_turn = not frames[count - 1].queued
        self._has_leftovers = count < len(frames)
        if not self._has_leftovers:
            self._waiting.clear()
            self._queued = 0
            return
        numbers = iter([key for key in self._waiting if len(key) == 1])
        for frame in frames[:count]:
            if frame.queued:
                del self._waiting[next(numbers)]
                self._queued -= 1
            else:
                del self._waiting[_key_of(frame)]

    def take_all(self) -> list[CanFrame]:
        """Remove and return all waiting frames, in order."""
        frames = self.in_order()
        self.remove(frames, len(frames))
        return frames

    def drop_measurements(self) -> bool:
        """Drop all frames that are not queued. Return True if there were any."""
        count = len(self._waiting) - self._queued
        self.counters.replaced_frames += count
        measurements = [key for key, frame in self._waiting.items() if not frame.queued]
        for key in measurements:
            del self._waiting[key]
        return bool(count)

    def clear(self) -> None:
        """Drop all frames, because they would be too old when they could be sent."""
        self.drop_measurements()
        self.counters.dropped_frames += self._queued
        self._waiting.clear()
        self._queued = 0
        self._has_leftovers = False
