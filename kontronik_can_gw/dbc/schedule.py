"""When each message is sent: cyclic with spread phases, by event, on change, never closer than its minimum distance.

Pure: ``may_go`` says whether a message may be sent now, ``defer`` puts it off until it may, ``due`` returns the messages to send, ``sent``
reports a sent one, and ``next_due`` is the time of the next call.
"""

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
        self._cycle_due = [
            now + phase if cycle else NEVER
            for cycle, phase in zip(self._cycle, phases(self._cycle), strict=True)
        ]
        self._deferred_until = [NEVER] * len(plans)
        self._cycle_deferred = [False] * len(plans)
        self._note_next()

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

    def due(self, now: int) -> list[tuple[int, int, int]]:
        """(deadline, message, CYCLE, REQUEST or both), each message once.

        A late call skips missed cycles: it never returns a message twice.
        """
        found = []
        for index, cycle in enumerate(self._cycle):
            when, why = NEVER, 0
            if (until := self._deferred_until[index]) <= now:
                when, why = until, CYCLE | REQUEST if self._cycle_deferred[index] else REQUEST
                self._deferred_until[index] = NEVER
                self._cycle_deferred[index] = False
            if (start := self._cycle_due[index]) <= now:
                self._cycle_due[index] += cycle * ((now - start) // cycle + 1)
                if self.may_go(index, now):
                    when, why = min(when, start), why | CYCLE
                else:
                    self.defer(index)
                    self._cycle_deferred[index] = True
            if why:
                found.append((when, index, why))
        self._note_next()
        return found

    def _note_next(self) -> None:
        self.next_due = min([*self._cycle_due, *self._deferred_until], default=NEVER)
        """When ``due`` will return a message; NEVER for never."""

    def _defer(self, index: int, until: int) -> None:
        if self._deferred_until[index] == NEVER:
            self._deferred_until[index] = until
            self.next_due = min(self.next_due, until)


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
