"""When the wall clock of a recording was synchronised, so that dates are reliable."""

from collections.abc import Iterator

from kontronik_can_gw.capture.format import CLOCK_FLAGS

TRUSTS = {flags: is_trusted for is_trusted, flags in CLOCK_FLAGS.items()}
"""If the wall clock is synchronised, by the flags of a CLOCK entry."""


class TrustedTimes:
    """When the wall clock was synchronised, in the order of time."""

    def __init__(self, first: bool | None = None) -> None:
        self._first = first
        """The state at the beginning. None means unknown."""
        self._changes: list[tuple[int, bool | None]] = []

    @property
    def is_known(self) -> bool:
        """True if the state at the beginning is known."""
        return self._first is not None

    def restart(self) -> None:
        """Forget all changes, because the capture is read again."""
        self._changes = []

    def add(self, time_ns: int, is_trusted: bool | None) -> None:
        self._changes.append((time_ns, is_trusted))

    def at(self, time_ns: int) -> bool | None:
        """Return the state at a time."""
        for since_ns, is_trusted in reversed(self._changes):
            if since_ns <= time_ns:
                return is_trusted
        return self._first

    def untrusted(self) -> Iterator[tuple[int, int | None]]:
        """Yield begin and end of each time without synchronisation. The last end may be None."""
        began: int | None = None
        for time_ns, is_trusted in self._changes:
            if is_trusted is False and began is None:
                began = time_ns
            elif is_trusted is not False and began is not None:
                yield began, time_ns
                began = None
        if began is not None:
            yield began, None
