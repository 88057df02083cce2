"""A log of CAN frames, whatever its format: its frames in order, as a stream, and an account of what is damaged."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Self

from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.desk.recordings.can_logs.blf import BlfReader
from kontronik_can_gw.desk.recordings.can_logs.record import SECOND_NS, Damage, Reader
from kontronik_can_gw.desk.recordings.can_logs.text import (
    ASC_HEAD,
    ASC_LINES,
    CANDUMP_LINE,
    CANDUMP_SCREEN_LINE,
    LONGEST_LINE,
    TRC_HEAD,
    TRC_LINE,
    AscReader,
    CandumpReader,
    TrcReader,
)
from kontronik_can_gw.errors import RunError, UserError

if TYPE_CHECKING:
    from kontronik_can_gw.desk.recordings.can_logs.mf4 import Mf4Reader

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
_LOOKS = {
    "candump": (CANDUMP_LINE.fullmatch, CANDUMP_SCREEN_LINE.fullmatch),
    "asc": (ASC_HEAD.match, *(pattern.match for pattern in ASC_LINES)),
    "trc": (TRC_HEAD.match,),
}
"""What finds a line of each text format; one of TRC alone could be another's."""
_READERS: dict[str, Callable[[BinaryIO, Damage], Reader]] = {
    "candump": CandumpReader,
    "asc": AscReader,
    "trc": TrcReader,
    "blf": BlfReader,
}
_SHORT = 64
_BACK_NS = 10 * SECOND_NS
_AHEAD_NS = 86_400 * SECOND_NS
"""A step of time that is larger must be confirmed by the frame after it, or it is a damaged time."""


def log_format(path: Path) -> str | None:
    """The format of a log by its first 64 KiB; by its suffix where they are damaged but more of that comes. None: no log. RunError."""
    head = _beginning(path, _HEAD)
    if head.startswith(b"LOGG"):
        return "blf"
    if head.startswith((b"MDF     ", b"UnFinMF ")):
        return "mf4"
    for line in head.removeprefix(b"\xef\xbb\xbf").split(b"\n", _HEAD_LINES)[:_HEAD_LINES]:
        for format_, looks_like in _LOOKS.items():
            if any(look(line) is not None for look in looks_like):
                return format_
    if b"LOBJ" in head:
        return "blf"
    if UART_MAGIC in head:  # bytes of an ESC, whatever they are called
        return None
    called = SUFFIXES.get(path.suffix.lower())
    if called is None or _is_blank(head):
        return called
    return called if _has_any(called, _beginning(path, _FAR)) else None


def _beginning(path: Path, size: int) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(size)
    except (OSError, ValueError) as error:
        raise RunError(f"{path}: cannot be opened: {_reason(error)}.") from None


def _is_blank(head: bytes) -> bool:
    """Nothing is in it, or a first line that was cut: the name is all there is to go by."""
    return not head.strip() or (
        len(head) < _SHORT and b"\n" not in head and head.rstrip().isascii() and b"\0" not in head
    )


def _has_any(format_: str, content: bytes) -> bool:
    """True where the beginning of a file holds anything of a format."""
    if format_ == "mf4":
        return False  # what has no beginning cannot be read
    if format_ == "blf":
        return b"LOBJ" in content
    looks = (*_LOOKS[format_], *((TRC_LINE.match,) if format_ == "trc" else ()))
    lines = [line for line in content.split(b"\n") if 0 < len(line) <= LONGEST_LINE]
    return any(look(line) is not None for line in lines for look in looks)


class CanLog:
    """An open log.

    UserError where it is no log that is known, or a table; RunError where it cannot be opened, or is MF4 and asammdf is missing.
    """

    _mf4: "Mf4Reader | None" = None

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
        self._reader: Reader
        if self.format == "mf4":
            from kontronik_can_gw.desk.recordings.can_logs.mf4 import Mf4Reader

            self._file.close()  # asammdf opens it itself
            self._reader = self._mf4 = Mf4Reader(path, self._damage)
        else:
            self._reader = _READERS[self.format](self._file, self._damage)

    @property
    def wall_start_ns(self) -> int | None:
        """Unix time in ns of the log's time 0; 0 where its times are Unix times, None where it does not say."""
        return self._reader.wall_start_ns

    @property
    def position(self) -> int:
        """Bytes read so far."""
        if self._mf4 is not None:
            return self._mf4.position
        return self.size if self._file.closed else min(self._file.tell(), self.size)

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
        self._file.close()
        if self._mf4 is not None:
            self._mf4.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _follows(item: TimedFrame, last: TimedFrame) -> bool:
    return -_BACK_NS <= item.time_ns - last.time_ns <= _AHEAD_NS


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
