"""When to repeat an attempt that failed."""

from kontronik_can_gw.times import MS

FIRST_RETRY_NS = 100 * MS


class Retry:
    """Pauses between attempts: each is twice as long as the one before, up to a maximum.

    ``due`` is the time of the next attempt. It is None while there is nothing to repeat.
    """

    def __init__(self, longest_ns: int) -> None:
        self.due: int | None = None
        self._longest_ns = longest_ns
        self._pause_ns = FIRST_RETRY_NS

    def failed(self, now: int) -> int:
        """Set ``due`` to the time of the next attempt and return it."""
        due = now + self._pause_ns
        self.due = due
        self._pause_ns = min(self._pause_ns * 2, self._longest_ns)
        return due

    def succeeded(self) -> None:
        """Cancel the next attempt. The next failure begins with the shortest pause."""
        self.due = None
        self._pause_ns = FIRST_RETRY_NS
