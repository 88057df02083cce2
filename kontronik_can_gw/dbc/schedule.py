"""When each message is sent: cyclic with spread phases, by event, on change, never closer than its minimum distance.

Pure: ``may_go`` says whether a message may be sent now, ``defer`` puts it off until it may, ``due`` returns the messages to send, ``sent``
reports a sent one, and ``next_due`` is the time of the next call.
"""

import heapq
from collections.abc import Sequence

from kontronik_can_gw.output import NEVER
from kontronik_can_gw.signals.plan import MessagePlan

_LONG_AGO = -(1 << 62)
CYCLE, REQUEST = 1, 2
"""Why a message is due: its cycle, a request that was deferred."""

MIN_DISTANCE_NS = 1_000_000
"""Minimum distance between frames of a message that are not caused by an event."""


class Schedule:
    """Deadlines of a list of messages, addressed by their index."""

    def __init__(self, plans: Sequence[MessagePlan], now: int) -> None:
        self._cycle = [plan.cycle_ns for plan in plans]
        self._delay = [plan.delay_ns for plan in plans]
        self._last = [_LONG_AGO] * len(plans)
        self._deferred_until = [NEVER] * len(plans)
        self._cycle_deferred = [False] * len(plans)
        self._heap = [
            (now + phase, index, False)
            for index, phase in enumerate(phases(self._cycle))
            if self._cycle[index]
        ]
        """(when, message, True for a deferred request): at the same time the cycle of a message comes first."""
        heapq.heapify(self._heap)
        self.next_due = self._heap[0][0] if self._heap else NEVER
        """When ``due`` will return a message; NEVER for never."""

    def may_go(self, index: int, now: int) -> bool:
        """True if the message may be sent now: its minimum distance is over."""
        return now >= self._last[index] + self._delay[index]

    def defer(self, index: int) -> None:
        """Let ``due`` return the message when its minimum distance is over."""
        self._defer(index, self._last[index] + self._delay[index])

    def wait(self, index: int, now: int) -> None:
        """Defer the message until it may follow a frame sent now."""
        self._defer(index, now + max(self._delay[index], MIN_DISTANCE_NS))

    def sent(self, index: int, now: int) -> None:
        """Note that a frame of the message was sent; a deferred request is done."""
        self._last[index] = now
        self._cycle_deferred[index] = False
        if self._deferred_until[index] != NEVER:
            self._deferred_until[index] = NEVER
            self._note_next()

    def _note_next(self) -> None:
        """The first deadline that still holds; before it go those of requests that were done meanwhile."""
        heap = self._heap
        while heap and heap[0][2] and heap[0][0] != self._deferred_until[heap[0][1]]:
            heapq.heappop(heap)
        self.next_due = heap[0][0] if heap else NEVER

    def due(self, now: int) -> list[tuple[int, int, int]]:
        """(deadline, message, CYCLE, REQUEST or both), each message once.

        A late call skips missed cycles: it never returns a message twice.
        """
        heap = self._heap
        found: dict[int, tuple[int, int, int]] = {}
        while heap and heap[0][0] <= now:
            when, index, is_deferred = heap[0]
            if is_deferred:
                heapq.heappop(heap)
                if when != self._deferred_until[index]:
                    continue  # a frame has gone out since
                self._deferred_until[index] = NEVER
                first, _, why = found.get(index, (when, index, 0))
                why |= CYCLE | REQUEST if self._cycle_deferred[index] else REQUEST
                found[index] = (first, index, why)
                self._cycle_deferred[index] = False
            else:
                cycle = self._cycle[index]
                heapq.heapreplace(heap, (when + cycle * ((now - when) // cycle + 1), index, False))
                if self.may_go(index, now):
                    first, _, why = found.get(index, (when, index, 0))
                    found[index] = (first, index, why | CYCLE)
                else:
                    self.defer(index)
                    self._cycle_deferred[index] = True
        self._note_next()
        return list(found.values())

    def _defer(self, index: int, until: int) -> None:
        if self._deferred_until[index] == NEVER:
            self._deferred_until[index] = until
            heapq.heappush(self._heap, (until, index, True))
            self.next_due = self._heap[0][0]


def phases(cycles: Sequence[int]) -> list[int]:
    """A phase for each message within its cycle: messages of one cycle are spaced evenly, and the groups interleave."""
    members: dict[int, list[int]] = {}
    for index, cycle in enumerate(cycles):
        members.setdefault(cycle, []).append(index)
    found = [0] * len(cycles)
    for number, (cycle, indices) in enumerate(sorted(members.items())):
        for place, index in enumerate(indices):
            found[index] = cycle * (place * len(members) + number) // (len(indices) * len(members))
    return found
