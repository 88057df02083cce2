"""The frames that a CAN interface has accepted and that have not left it. Pure."""

from collections import deque
from typing import Any

from kontronik_can_gw.times import NEVER

UNCOUNTED = -1
"""The count of an interface whose number of sent frames is not known."""


class UnderWay:
    """The frames that the interface has accepted and that have not left it.

    The interface's count includes frames of other programs, which share its queue. So a frame has
    left only if it has also left the kernel's queue.
    """

    def __init__(self) -> None:
        self.count = 0
        """The interface's last count of sent frames, or ``UNCOUNTED``."""
        self.frames = 0
        """Number of frames under way."""
        self.looked = 0
        """Time of the last look."""
        self._accepted: deque[tuple[int, int]] = deque()
        """Times and numbers of accepted frames, oldest first."""

    @property
    def oldest(self) -> int:
        """Time at which the oldest frame was accepted. NEVER without frames."""
        return self._accepted[0][0] if self._accepted else NEVER

    def forget(self) -> None:
        """Forget the frames, because they have left or are lost."""
        self._accepted.clear()
        self.frames = 0

    def add(self, frames: int, now: int) -> None:
        """Add accepted frames."""
        if frames:
            self._accepted.append((now, frames))
            self.frames += frames

    def look(self, count: int, queued: int, now: int) -> bool:
        """Take the interface's count. Returns True if it has changed.

        ``queued`` is the number of own frames in the kernel's queue. A count that is smaller than
        before was reset. Then the frames under way are forgotten.
        """
        moved = count - self.count
        self.count = count
        if count == UNCOUNTED or moved < 0:
            moved = self.frames
        self._remove(max(0, min(moved, self.frames - queued)))
        self.add(queued - self.frames if queued > self.frames else 0, self.looked)
        self.looked = now
        return bool(moved)

    def adopt(self, departures: Any, now: int) -> None:
        """Take over the frames of iterations in C.

        ``accepted`` frames were accepted since the last call. ``older`` and ``newer`` of all
        frames are under way, and were accepted before and after the check at ``checked``.
        """
        frames = departures.older + departures.newer
        added = min(departures.accepted, frames)
        added_newer = min(departures.newer, added)
        self.count = departures.count
        self._remove(max(0, self.frames - (frames - added)))
        self.looked = departures.checked
        self.add(added - added_newer, self.looked)
        self.add(added_newer, now)

    def _remove(self, frames: int) -> None:
        accepted = self._accepted
        self.frames -= frames
        while frames:
            at, number = accepted.popleft()
            if number > frames:
                accepted.appendleft((at, number - frames))
                break
            frames -= number
