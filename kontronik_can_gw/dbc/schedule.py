"""When each message is sent: cyclic with spread phases, by event, on change, never closer than its minimum distance.

Pure: ``request`` asks whether a message may go now, ``due`` says which are to go by now, ``sent`` is told what went, ``next_deadline``
says when to ask again.
"""

import heapq
from collections.abc import Sequence

from kontronik_can_gw.signals.plan import MessagePlan

_NEVER = -(1 << 62)


MIN_DISTANCE_NS = 1_000_000
"""Between frames that follow each other without an event."""


class Schedule:
    """Deadlines of a list of messages, addressed by their index."""

    def __init__(self, plans: Sequence[MessagePlan], now: int) -> None:
        self._cycle = [plan.cycle_ns for plan in plans]
        self._delay = [plan.delay_ns for plan in plans]
        self._last = [_NEVER] * len(plans)
        self._waiting = [False] * len(plans)
        self._cycle_waits = [False] * len(plans)
        self._heap = [
            (now + phase, index, False)
            for index, phase in enumerate(phases(self._cycle))
            if self._cycle[index]
        ]
        """(when, message, True for one that had to wait): of one instant and message the cycle comes first."""
        heapq.heapify(self._heap)

    def request(self, index: int, now: int) -> bool:
        """True if the message may be sent now; otherwise it comes out of ``due`` when it may."""
        if now >= self._last[index] + self._delay[index]:
            return True
        self._put_off(index, self._last[index] + self._delay[index])
        return False

    def wait(self, index: int, now: int) -> None:
        """Let the message come out of ``due`` again, as soon as it may after a frame sent now."""
        self._put_off(index, now + max(self._delay[index], MIN_DISTANCE_NS))

    def sent(self, index: int, now: int) -> None:
        """A frame of the message went out: it is the one that was waited for."""
        self._last[index] = now
        self._waiting[index] = self._cycle_waits[index] = False

    def due(self, now: int) -> list[tuple[int, bool]]:
        """(message, True for its cycle, False for a request that had to wait), in the order of their deadlines, each once.

        A late call skips missed cycles: there is never more than one frame of a message at a time.
        """
        found: dict[int, bool] = {}
        heap = self._heap
        while heap and heap[0][0] <= now:
            when, index, waited = heap[0]
            if waited:
                heapq.heappop(heap)
                if not self._waiting[index]:
                    continue  # a frame has gone out since
                if now < self._last[index] + self._delay[index]:
                    heapq.heappush(heap, (self._last[index] + self._delay[index], index, True))
                    continue
                self._waiting[index] = False
                found[index] = found.get(index, False) or self._cycle_waits[index]
                self._cycle_waits[index] = False
            else:
                cycle = self._cycle[index]
                heapq.heapreplace(heap, (when + cycle * ((now - when) // cycle + 1), index, False))
                if self.request(index, now):
                    found[index] = True
                else:
                    self._cycle_waits[index] = True
        return list(found.items())

    def next_deadline(self) -> int | None:
        """When ``due`` has something to say, None for never."""
        return self._heap[0][0] if self._heap else None

    def _put_off(self, index: int, until: int) -> None:
        if not self._waiting[index]:
            self._waiting[index] = True
            heapq.heappush(self._heap, (until, index, True))


def phases(cycles: Sequence[int]) -> list[int]:
    """A start for each message within its cycle, so that those of one cycle are evenly apart and the groups interleave."""
    members: dict[int, list[int]] = {}
    for index, cycle in enumerate(cycles):
        members.setdefault(cycle, []).append(index)
    found = [0] * len(cycles)
    for number, (cycle, indices) in enumerate(sorted(members.items())):
        for place, index in enumerate(indices):
            found[index] = cycle * (place * len(members) + number) // (len(indices) * len(members))
    return found
