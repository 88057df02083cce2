"""A log of CAN frames, whatever its format: its frames in order, as a stream, and an account of what is damaged."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.desk.recordings.can_logs.text import (
    LONGEST_LINE,
    SECOND_NS,
    TRC_HEAD,
    TRC_LINE,
    AscReader,
    CandumpReader,
    Damage,
    asc_line,
    candump_line,
)
from kontronik_can_gw.errors import RunError, UserError

SUFFIXES = {
    ".log": "candump",
    ".candump": "candump",
    ".asc": "asc",
    ".blf": "blf",
    ".trc": "trc",
    ".mf4": "mf4",
    ".mdf": "mf4",
}
NAMES = {
    "candump": "CAN log (candump)",
    "asc": "ASC log",
    "blf": "BLF file",
    "trc": "TRC file",
    "mf4": "MF4 file",
}
"""What people call the formats."""
_HEAD, _HEAD_LINES = 1 << 16, 2000
_FAR = 1 << 20
"""So far into a file whose beginning is damaged something of its format must come."""
UART_MAGIC = b"KOD"
"""What a telemetry frame begins with."""
_LINES: dict[str, Callable[[bytes], object]] = {
    "candump": candump_line,
    "asc": asc_line,
    "trc": TRC_HEAD.match,
}
_BEGINNINGS = {b"LOGG": "blf", b"MDF     ": "mf4", b"UnFinMF ": "mf4"}
_BACK_NS = 10 * SECOND_NS
_AHEAD_NS = 86_400 * SECOND_NS
"""A step of time that is larger must be confirmed by the frame after it, or it is a damaged time."""


def log_format(path: Path) -> str | None:
    """The format of a log by its content; by its suffix where its beginning is damaged but lines of that come. None: no log. RunError."""
    head = _beginning(path, _HEAD)
    for magic, found in _BEGINNINGS.items():
        if head.startswith(magic):
            return found
    for line in head.removeprefix(b"\xef\xbb\xbf").split(b"\n", _HEAD_LINES)[:_HEAD_LINES]:
        for found, is_line in _LINES.items():
            if is_line(line):
                return found
    called = SUFFIXES.get(path.suffix.lower(), "")
    if not head.strip():
        return called
    if UART_MAGIC in head or called not in _LINES:  # bytes of an ESC, whatever they are called
        return None
    is_line = TRC_LINE.match if called == "trc" else _LINES[called]
    lines = (line for line in _beginning(path, _FAR).split(b"\n") if len(line) <= LONGEST_LINE)
    return called if any(map(is_line, lines)) else None


def _beginning(path: Path, size: int) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(size)
    except (OSError, ValueError) as error:
        raise RunError(f"{path}: cannot be opened: {_reason(error)}.") from None


def _reader_of(format_: str) -> Callable[..., Any]:
    if format_ in ("candump", "asc"):
        return CandumpReader if format_ == "candump" else AscReader
    from kontronik_can_gw.desk.recordings.can_logs import library

    readers = {"blf": library.BlfReader, "trc": library.TrcReader, "mf4": library.Mf4Reader}
    return readers[format_]


class CanLog:
    """An open log.

    UserError where it is no log that is known, or a table; RunError where it cannot be opened, or is MF4 and asammdf is missing.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._damage = Damage()
        self.format = log_format(path) or ""
        if not self.format:
            raise UserError(f"{path}: is no CAN log that is known (candump, ASC, BLF, TRC, MF4).")
        try:
            self.size = path.stat().st_size
            self._file = path.open("rb")
        except OSError as error:
            raise RunError(f"{path}: cannot be opened: {_reason(error)}.") from None
        self._reader = _reader_of(self.format)(self._file, self._damage)

    @property
    def wall_start_ns(self) -> int | None:
        """Unix time in ns of the log's time 0; 0 where its times are Unix times, None where it does not say. Known with the first frame."""
        found: int | None = self._reader.wall_start_ns
        return found

    @property
    def position(self) -> int:
        """Bytes read so far."""
        return min(int(self._reader.position), self.size)

    @property
    def damage(self) -> list[str]:
        """One line for each kind of damage; complete after the frames."""
        return self._damage.texts()

    def frames(self) -> Iterator[TimedFrame]:
        """The frames in the order of the log. RunError where the file cannot be read.

        Left out is what has a time that leads far away and back: a digit or a bit of it is damaged.
        """
        last: TimedFrame | None = None
        doubtful: TimedFrame | None = None
        wrong = 0
        try:
            for item in self._reader:
                if last is None or _follows(item, last):
                    wrong += doubtful is not None
                elif doubtful is not None and _follows(item, doubtful):
                    # two agree: the clock was set, or the first frame was the damaged one
                    yield doubtful
                else:
                    wrong += doubtful is not None
                    doubtful = item
                    continue
                doubtful, last = None, item
                yield item
        except OSError as error:
            raise RunError(f"{self.path}: cannot be read: {_reason(error)}.") from None
        if doubtful is not None:
            yield doubtful
        if wrong:
            plural = "s" if wrong > 1 else ""
            self._damage.notes.append(f"{wrong} frame{plural} with an impossible time left out")

    def close(self) -> None:
        """Close the file."""
        self._reader.close()
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _follows(item: TimedFrame, last: TimedFrame) -> bool:
    return -_BACK_NS <= item.time_ns - last.time_ns <= _AHEAD_NS


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
