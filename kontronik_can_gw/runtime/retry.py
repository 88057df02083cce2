"""When to repeat an attempt that failed."""

from kontronik_can_gw.times import MS, NEVER

FIRST_RETRY_NS = 100 * MS


class Retry:
    """Pauses between attempts: each is twice as long as the one before, up to a maximum.

    ``due`` is the time of the next attempt. It is NEVER while there is nothing to repeat.
    """

    def __init__(self, longest_ns: int) -> None:
        self.due = NEVER
        self._longest_ns = longest_ns
        self._pause_ns = FIRST_RETRY_NS

    def failed(self, now: int) -> None:
        """Set ``due`` to the time of the next attempt."""
        self.due = now + self._pause_ns
        self._pause_ns = min(self._pause_ns * 2, self._longest_ns)

    def succeeded(self) -> None:
        """Cancel the next attempt. The next failure begins with the shortest pause."""
        self.due = NEVER
        self._pause_ns = FIRST_RETRY_NS
