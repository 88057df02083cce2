"""Continuous times for the frames of a log whose clock was set while it was written.

A log has the time of day of the machine that wrote it, or times since its start. One rule holds for
every format:

1. If ten frames in a row are more than 100 ms before the frames in front of them, the clock was set
   back. The spacing of the frames and the time of day continue, and the step is reported.
2. Frames that go back less far, or fewer of them, are out of order and keep their times.
3. A time that jumps ahead by more than 10 s is kept and reported: a pause looks the same as a clock
   that was set ahead.
4. A single time that leads far away and back is damaged, and its frame is left out.

Rules 1, 3 and 4 need the frames that follow. A frame at a usual time is returned at once.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice

from kontronik_can_gw.desk.recordings.recording import ClockStep, LogFrame
from kontronik_can_gw.times import SECOND

_DISORDER_NS = 100_000_000
"""Frames of several interfaces may be this far out of order."""
_STEP_FRAMES = 10
"""Frames in a row that must agree on a step back."""
_FAR_NS = 10 * SECOND
"""A single frame that is farther away than this from its neighbours has a damaged time."""
_DAY_NS = 86_400 * SECOND
_LONE_NS = SECOND
"""A single frame this far ahead does not count if the next frame has an earlier time."""
_REMEMBERED = 256
"""Frames in which the periods of the ids are looked up."""


class LogClock:
    """Gives the frames of a log continuous times, and remembers where the clock was set.

    ``is_live``: the next frame may not have arrived yet, so the first one is trusted.
    """

    def __init__(self, source: Iterable[LogFrame], *, is_live: bool = False) -> None:
        self.steps: list[ClockStep] = []
        """Complete when all frames have been read."""
        self.impossible = 0
        """Frames that were left out because their time is damaged."""
        self._source = iter(source)
        self._is_live = is_live
        self._ahead: deque[LogFrame] = deque()
        self._recent: deque[LogFrame] = deque(maxlen=_REMEMBERED)
        self._shift_ns = 0
        """Added to the times of the log since the last step."""

    def frames(self) -> Iterator[LogFrame]:
        """Yield the frames in their order, at continuous times."""
        last = None
        before = None
        ahead = self._ahead
        source = self._source
        while (item := ahead.popleft() if ahead else next(source, None)) is not None:
            time_ns = item.time_ns + self._shift_ns
            if last is None or before is None:
                if self._is_alone(item):
                    self.impossible += 1
                    continue
                last = before = time_ns
            elif time_ns - last > _FAR_NS:
                if self._leads_back(item):
                    self.impossible += 1
                    continue
                self.steps.append(ClockStep(time_ns, time_ns - last, is_kept=True))
                last = before = time_ns
            elif time_ns >= last:
                before = last
                last = time_ns
            elif last - time_ns > _DISORDER_NS:
                if last - before > _LONE_NS and time_ns >= before - _DISORDER_NS:
                    last = max(before, time_ns)  # the frame before this one was too far ahead
                elif (following := self._agreeing(last)) is not None:
                    time_ns = self._set_back(item, following, last)
                    last = before = time_ns
                elif last - time_ns > _FAR_NS and not self._is_followed(item):
                    self.impossible += 1
                    continue
            if self._shift_ns:
                item = item._replace(time_ns=time_ns)
            self._recent.append(item)
            yield item

    def _look_ahead(self, count: int) -> Sequence[LogFrame]:
        """Return the next frames without consuming them. There are fewer at the end of the log.

        A pipe may not have them yet, so a frame in its order must not need them.
        """
        missing = max(0, count - len(self._ahead))
        self._ahead.extend(islice(self._source, missing))
        return list(islice(self._ahead, count))

    def _is_alone(self, first: LogFrame) -> bool:
        """Return True if the first frame is far later than the next two, which agree."""
        following = self._look_ahead(1)
        if not following or first.time_ns - following[0].time_ns <= _FAR_NS:
            return False
        following = self._look_ahead(2)
        return len(following) == 2 and _follows(following[1], following[0])

    def _leads_back(self, item: LogFrame) -> bool:
        """Return True if the times after this frame are far earlier again."""
        for count in (1, 2):
            following = self._look_ahead(count)
            if len(following) < count or _follows(following[-1], item):
                return False
            if following[-1].time_ns < item.time_ns - _FAR_NS:
                return True
        return False

    def _is_followed(self, item: LogFrame) -> bool:
        following = self._look_ahead(1)
        return not following or _follows(following[0], item)

    def _agreeing(self, last: int) -> Sequence[LogFrame] | None:
        """Return the next frames if enough of them are before ``last``, too. None otherwise."""
        following = self._look_ahead(_STEP_FRAMES - 1)
        if len(following) < _STEP_FRAMES - 1:
            return None
        limit_ns = last - _DISORDER_NS - self._shift_ns
        if max(one.time_ns for one in following) >= limit_ns:
            return None
        return following

    def _set_back(self, item: LogFrame, following: Sequence[LogFrame], last: int) -> int:
        """Record a step before ``item``. Return the time at which the spacing continues."""
        time_ns = max(last, self._due_ns(item, following, last))
        by_ns = item.time_ns + self._shift_ns - time_ns
        self._shift_ns -= by_ns
        self.steps.append(ClockStep(time_ns, by_ns))
        return time_ns

    def _due_ns(self, item: LogFrame, following: Sequence[LogFrame], last: int) -> int:
        """Return the time at which ``item`` was due.

        The periods of the ids give one estimate each. The result is their median.
        """
        guesses: dict[object, int] = {}
        for one in (item, *following):
            name = _name(one)
            if name in guesses:
                continue
            earlier = (seen.time_ns for seen in reversed(self._recent) if _name(seen) == name)
            times = list(islice(earlier, 2))
            if len(times) == 2:
                last_ns, before_ns = times
                due_ns = 2 * last_ns - before_ns
                guesses[name] = due_ns - (one.time_ns - item.time_ns)
        if not guesses:
            return last
        ordered = sorted(guesses.values())
        return ordered[(len(ordered) - 1) // 2]


def _name(item: LogFrame) -> object:
    return item.channel, item.frame.key


def _follows(item: LogFrame, before: LogFrame) -> bool:
    return -_FAR_NS <= item.time_ns - before.time_ns <= _DAY_NS
