"""When each message is sent: cyclic with spread phases, by event, on change, never closer than its minimum distance.

Pure: ``trigger`` says that something happened, ``due`` says which messages are to be sent by now, ``next_deadline`` when to ask again.
"""

import heapq
from collections.abc import Sequence

from kontronik_can_gw.dbc_output.layout import MessagePlan

_NEVER = -(1 << 62)


class Schedule:
    """Deadlines of a list of messages, addressed by their index."""

    def __init__(self, plans: Sequence[MessagePlan], now: int) -> None:
        self._cycle = [plan.cycle_ns for plan in plans]
        self._delay = [plan.delay_ns for plan in plans]
        self._last = [_NEVER] * len(plans)
        self._waiting = [False] * len(plans)
        self._heap = [
            (now + phase, index, False) for index, phase in enumerate(phases(self._cycle)) if self._cycle[index]
        ]
        """(when, message, True for a request that had to wait): of one instant and message the cycle comes first."""
        heapq.heapify(self._heap)

    def request(self, index: int, now: int) -> bool:
        """True if the message may be sent now (it then counts as sent); otherwise it comes out of ``due`` when it may."""
        earliest = self._last[index] + self._delay[index]
        if now >= earliest:
            self._last[index] = now
            self._waiting[index] = False  # this frame is the one that was waited for
            return True
        if not self._waiting[index]:
            self._waiting[index] = True
            heapq.heappush(self._heap, (earliest, index, True))
        return False

    def due(self, now: int) -> list[tuple[int, bool]]:
        """(message, True for its cycle, False for a request that had to wait), in the order of their deadlines.

        A late call skips missed cycles: there is never more than one frame of a message at a time.
        """
        found: list[tuple[int, bool]] = []
        heap = self._heap
        while heap and heap[0][0] <= now:
            when, index, waited = heap[0]
            if not waited:
                cycle = self._cycle[index]
                heapq.heapreplace(heap, (when + cycle * ((now - when) // cycle + 1), index, False))
                if self.request(index, now):
                    found.append((index, True))
            else:
                heapq.heappop(heap)
                if not self._waiting[index]:
                    continue
                self._waiting[index] = False
                if self.request(index, now):
                    found.append((index, False))
        return found

    def next_deadline(self) -> int | None:
        """When ``due`` has something to say, None for never."""
        return self._heap[0][0] if self._heap else None


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
