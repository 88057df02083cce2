"""Detects that no frame leaves the CAN interface. Pure: counts and times are passed in."""

from kontronik_can_gw.times import NEVER

CHECKS = 3
"""After this number of checks without a frame that has left, the interface is blocked.

Checks are a quarter of the shortest telemetry time-out apart. The last frame may have left up to a
quarter before the first of them, so nothing has left for three to four quarters of the time-out.
"""


class Departures:
    """Compares the frames that were handed to the interface with its own count of sent frames.

    The twin of ``check`` is ``is_blocked`` of native/linux.c, whose structure has the same
    fields. The interface's count includes frames of other programs. They share its queue, so they
    show as well that the bus takes frames. A count of 0 is not used, because there are drivers
    that do not count.
    """

    def __init__(self) -> None:
        self.count = 0
        """The last known count, or 0 if it is unknown."""
        self.waits_since = NEVER
        """A time since which frames have waited and none has left. NEVER if no frame waits."""
        self.check_due = NEVER
        """Time of the next check. NEVER if no frame waits."""
        self.waiting = 0
        """Number of accepted frames that have not left.

        It is too small by the frames of other programs that have left since, and too great by the
        frames that the driver has lost.
        """

    def forget(self) -> None:
        """Forget the frames that wait, because the interface was lost or is in bus-off."""
        self.waits_since = NEVER
        self.check_due = NEVER
        self.waiting = 0

    def note_handed_over(self, frames: int, now: int, period_ns: int) -> None:
        """Note that the interface has accepted frames. ``period_ns`` is the pause until a check."""
        self.waiting += frames
        if self.waits_since == NEVER:
            self.waits_since = now
            self.check_due = now + period_ns

    def check(self, count: int, now: int, period_ns: int) -> bool:
        """Take the interface's count. Returns True if a frame has left since the last check."""
        has_left = count != self.count
        self.waiting = max(0, self.waiting - (count - self.count))
        self.count = count
        if has_left:
            self.waits_since = now if self.waiting else NEVER
        self.check_due = NEVER if self.waits_since == NEVER else now + period_ns
        return has_left

    def is_blocked(self, now: int, period_ns: int) -> bool:
        """Return True if a frame waits and none has left during ``CHECKS`` checks."""
        return self.count > 0 and now - self.waits_since >= CHECKS * period_ns
