"""When to try again what failed: soon at first, then more and more seldom, up to a bound, for ever."""

from kontronik_can_gw.esc.telemetry import MS

FIRST_NS = 100 * MS


class Retry:
    """``due`` is None while nothing is to be tried."""

    def __init__(self, longest_ns: int) -> None:
        self.due: int | None = None
        self._longest = longest_ns
        self._pause = FIRST_NS

    def failed(self, now: int) -> int:
        """Try later, at the time that is returned: each time twice as late."""
        self.due = due = now + self._pause
        self._pause = min(self._pause * 2, self._longest)
        return due

    def succeeded(self) -> None:
        """Nothing is to be tried; the next failure begins with the shortest pause."""
        self.due = None
        self._pause = FIRST_NS
