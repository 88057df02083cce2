"""Recorded time against real time: when what was recorded is to come again."""

import threading
import time
from collections.abc import Callable

from kontronik_can_gw.esc.telemetry import SECOND


class Pace:
    """``speed``: recorded seconds in a real one; None: as fast as possible. ``stop`` may be called from a signal handler."""

    def __init__(
        self,
        speed: float | None,
        clock: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], object] | None = None,
    ) -> None:
        self.speed = speed
        self.latest_ns = 0
        """The most that anything came too late."""
        self.stopped = False
        self._clock = clock
        self._ended = threading.Event()
        self._sleep = sleep or self._ended.wait
        self._origin: tuple[int, int] | None = None

    def stop(self) -> None:
        """End the pause that is being made; ``wait`` returns False from now on."""
        self.stopped = True
        self._ended.set()

    def wait(self, time_ns: int) -> bool:
        """Pause until a recorded time is due; the first call sets what time it is now. False: stopped."""
        if self.stopped or self.speed is None:
            return not self.stopped
        now = self._clock()
        if self._origin is None:
            self._origin = (now, time_ns)
        due = self._origin[0] + int((time_ns - self._origin[1]) / self.speed)
        while (left := due - now) > 0:
            self._sleep(min(left / SECOND, 1.0))
            if self.stopped:
                return False
            now = self._clock()
        self.latest_ns = max(self.latest_ns, now - due)
        return True

    def pause(self, seconds: float) -> None:
        """Pause, or less if stopped."""
        if not self.stopped:
            self._sleep(seconds)
