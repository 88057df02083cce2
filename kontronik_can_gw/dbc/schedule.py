"""When each message is sent: cyclic with spread phases, by event, on change, never closer than its minimum distance.

Pure: ``request`` asks whether a message may be sent now, ``due`` returns the messages to send, ``sent`` reports a sent one, and
``next_deadline`` returns the time of the next call.
"""

import heapq
from collections.abc import Sequence

from kontronik_can_gw.output import NEVER
from kontronik_can_gw.signals.plan import MessagePlan

_LONG_AGO = -(1 << 62)


MIN_DISTANCE_NS = 1_000_000
"""Minimum distance between frames of a message that are not caused by an event."""


class Schedule:
    """Deadlines of a list of messages, addressed by their index."""

    def __init__(self, plans: Sequence[MessagePlan], now: int) -> None:
        self._cycle = [plan.cycle_ns for plan in plans]
        self._delay = [plan.delay_ns for plan in plans]
        self._last = [_LONG_AGO] * len(plans)
        self._deferred = [False] * len(plans)
        self._cycle_deferred = [False] * len(plans)
        self._heap = [
            (now + phase, index, False)
            for index, phase in enumerate(phases(self._cycle))
            if self._cycle[index]
        ]
        """(when, message, True for a deferred request): at the same time the cycle of a message comes first."""
        heapq.heapify(self._heap)

    def request(self, index: int, now: int) -> bool:
        """True if the message may be sent now; otherwise it is deferred, and ``due`` returns it when it may."""
        if now >= self._last[index] + self._delay[index]:
            return True
        self._defer(index, self._last[index] + self._delay[index])
        return False

    def wait(self, index: int, now: int) -> None:
        """Defer the message until it may follow a frame sent now."""
        self._defer(index, now + max(self._delay[index], MIN_DISTANCE_NS))

    def sent(self, index: int, now: int) -> None:
        """Note that a frame of the message was sent; a deferred request is done."""
        self._last[index] = now
        self._deferred[index] = self._cycle_deferred[index] = False

    def due(self, now: int) -> list[tuple[int, bool]]:
        """(message, True for its cycle, False for a deferred request), in the order of their deadlines, each once.

        A late call skips missed cycles: it never returns a message twice.
        """
        heap = self._heap
        if not heap or heap[0][0] > now:
            return []
        found: dict[int, bool] = {}
        while heap and heap[0][0] <= now:
            when, index, is_deferred = heap[0]
            if is_deferred:
                heapq.heappop(heap)
                if not self._deferred[index]:
                    continue  # a frame has gone out since
                if now < self._last[index] + self._delay[index]:
                    heapq.heappush(heap, (self._last[index] + self._delay[index], index, True))
                    continue
                self._deferred[index] = False
                found[index] = found.get(index, False) or self._cycle_deferred[index]
                self._cycle_deferred[index] = False
            else:
                cycle = self._cycle[index]
                heapq.heapreplace(heap, (when + cycle * ((now - when) // cycle + 1), index, False))
                if self.request(index, now):
                    found[index] = True
                else:
                    self._cycle_deferred[index] = True
        return list(found.items())

    def next_deadline(self) -> int:
        """When ``due`` will return a message; NEVER for never."""
        return self._heap[0][0] if self._heap else NEVER

    def _defer(self, index: int, until: int) -> None:
        if not self._deferred[index]:
            self._deferred[index] = True
            heapq.heappush(self._heap, (until, index, True))


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
