"""What the readers of CAN logs share: a frame as it stands in a log, and the account of what cannot be read."""

from collections.abc import Iterator
from typing import NamedTuple, Protocol

from kontronik_can_gw.frames import CanFrame

SECOND_NS = 1_000_000_000
FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
OLDEST_WALL_S = 631_152_000
"""1990: what is earlier is no Unix time but seconds since a start."""
_SHOWN = 8


class LogFrame(NamedTuple):
    """A frame of a log. ``time_ns``: as the log counts. ``received``: marked as received (Rx). ``channel``: interface, or number from 1."""

    time_ns: int
    frame: CanFrame
    received: bool
    channel: str


class Reader(Protocol):
    """One format's reader of an open log."""

    wall_start_ns: int | None
    """Unix time of the log's time 0; None where it does not say."""

    def __iter__(self) -> Iterator[LogFrame]: ...


def is_possible(can_id: int, extended: bool, size: int, fd: bool) -> bool:
    """True where a frame with this id and number of bytes exists on a CAN bus."""
    return can_id <= (0x1FFFFFFF if extended else 0x7FF) and (
        size in FD_LENGTHS if fd else size <= 8
    )


class Damage:
    """Counts what cannot be read and what is not ours. Memory stays small however much it is."""

    def __init__(self) -> None:
        self.lines = 0
        self._line_ranges: list[list[int]] = []
        self.stretches = 0
        self.stretch_bytes = 0
        self._stretches: list[list[int]] = []
        self.notes: list[str] = []
        self.foreign: dict[str, int] = {}

    def line(self, number: int) -> None:
        """A line (counted from 1) is no line of this format."""
        self.lines += 1
        if self._line_ranges and self._line_ranges[-1][1] == number - 1:
            self._line_ranges[-1][1] = number
        elif len(self._line_ranges) <= _SHOWN:
            self._line_ranges.append([number, number])

    def stretch(self, start: int, end: int) -> None:
        """Bytes of the file that mean nothing."""
        if end <= start:
            return
        self.stretch_bytes += end - start
        if self._stretches and self._stretches[-1][1] == start:
            self._stretches[-1][1] = end
            return
        self.stretches += 1
        if len(self._stretches) <= _SHOWN:
            self._stretches.append([start, end])

    def skip(self, what: str, number: int = 1) -> None:
        """Frames that are whole but no data frames: error frames, remote frames."""
        self.foreign[what] = self.foreign.get(what, 0) + number

    def texts(self) -> list[str]:
        """One line for each kind of damage."""
        texts = []
        if self.lines:
            shown = [f"{a}" if a == b else f"{a} to {b}" for a, b in self._line_ranges[:_SHOWN]]
            rest = self.lines - sum(b - a + 1 for a, b in self._line_ranges[:_SHOWN])
            if rest:
                shown.append(f"and {rest} more")
            texts.append(
                f"{self.lines} damaged line{'s' if self.lines > 1 else ''}: {', '.join(shown)}"
            )
        if self.stretches == 1:
            start, end = self._stretches[0]
            texts.append(f"a damaged stretch of {end - start} bytes at offset {start}")
        elif self.stretches:
            shown = [f"{b - a} at offset {a}" for a, b in self._stretches[:_SHOWN]]
            if self.stretches > _SHOWN:
                shown.append(f"and {self.stretches - _SHOWN} more")
            texts.append(
                f"{self.stretches} damaged stretches, {self.stretch_bytes} bytes in all: {', '.join(shown)}"
            )
        return texts + self.notes
