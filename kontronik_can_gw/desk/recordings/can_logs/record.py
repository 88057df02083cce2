"""What the readers of CAN logs share: which frames there can be, and the account of what cannot be read."""

from collections.abc import Iterator
from typing import Protocol

from kontronik_can_gw.capture.replay import TimedFrame

SECOND_NS = 1_000_000_000
FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
OLDEST_WALL_S = 631_152_000
"""1990: what is earlier is no Unix time but seconds since a start."""
_SHOWN = 8


class Reader(Protocol):
    """One format's reader of an open log: its frames in order, times as the log counts."""

    wall_start_ns: int | None
    """Unix time of the log's time 0; None where it does not say."""

    def __iter__(self) -> Iterator[TimedFrame]: ...


def is_possible(can_id: int, extended: bool, size: int, fd: bool) -> bool:
    """True where a frame with this id and number of bytes exists on a CAN bus."""
    return can_id <= (0x1FFFFFFF if extended else 0x7FF) and (
        size in FD_LENGTHS if fd else size <= 8
    )


class _Ranges:
    """Ranges of rising numbers, neighbours joined. Only the first are kept, however many there are."""

    def __init__(self) -> None:
        self.first: list[list[int]] = []
        self.count = self.total = self._end = 0

    def add(self, start: int, end: int) -> None:
        """Add numbers up to ``end``, which is not one of them; those that are there already count once."""
        start = max(start, self._end)
        if start >= end:
            return
        if not self.count or start > self._end:
            self.count += 1
            self.first += [[start, end]] if self.count <= _SHOWN else []
        elif self.count <= _SHOWN:
            self.first[-1][1] = end
        self.total += end - start
        self._end = end


class Damage:
    """Counts what cannot be read. Memory stays small however much it is."""

    def __init__(self) -> None:
        self._lines = _Ranges()
        self._stretches = _Ranges()
        self.notes: list[str] = []

    def line(self, number: int) -> None:
        """A line (counted from 1) is no line of this format."""
        self._lines.add(number, number + 1)

    def stretch(self, start: int, end: int) -> None:
        """Bytes of the file that mean nothing."""
        self._stretches.add(start, end)

    def texts(self) -> list[str]:
        """One line for each kind of damage."""
        texts = []
        lines, stretches = self._lines, self._stretches
        if lines.total:
            shown = [f"{a}" if a == b - 1 else f"{a} to {b - 1}" for a, b in lines.first]
            if rest := lines.total - sum(b - a for a, b in lines.first):
                shown.append(f"and {rest} more")
            plural = "s" if lines.total > 1 else ""
            texts.append(f"{lines.total} damaged line{plural}: {', '.join(shown)}")
        if stretches.count == 1:
            start, end = stretches.first[0]
            texts.append(f"a damaged stretch of {end - start} bytes at offset {start}")
        elif stretches.count:
            shown = [f"{end - start} at offset {start}" for start, end in stretches.first]
            if stretches.count > _SHOWN:
                shown.append(f"and {stretches.count - _SHOWN} more")
            texts.append(
                f"{stretches.count} damaged stretches, {stretches.total} bytes in all: {', '.join(shown)}"
            )
        return texts + self.notes
