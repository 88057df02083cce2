"""Readers of logs that are text: candump, Vector ASC, PEAK TRC. A line that cannot be read is counted, the next one is read again.

Each format is a regular expression; its groups have the same names in all of them. Times stay whole numbers of nanoseconds. The formats,
where no specification is public, are read as python-can reads them. Error and remote frames and other events are left out.
"""

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import BinaryIO

from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.desk.recordings.can_logs.record import (
    FD_LENGTHS,
    OLDEST_WALL_S,
    SECOND_NS,
    Damage,
    is_possible,
)
from kontronik_can_gw.frames import CanFrame

LONGEST_LINE = 4096
"""Bytes; a line of any of these formats is far shorter."""
_HEAD_LINES = 200
"""Lines in which a log's head is looked for."""
_Found = dict[str, bytes | None]
"""The groups of a line: time (s, f), id, data, and what else the format has."""


class TextReader(ABC):
    """Reads an open log line by line."""

    def __init__(self, file: BinaryIO, damage: Damage) -> None:
        self._file = file
        self._damage = damage
        self._number = 1
        self.wall_start_ns: int | None = None
        self._read_head([file.readline(LONGEST_LINE) for _ in range(_HEAD_LINES)])
        file.seek(0)

    def __iter__(self) -> Iterator[TimedFrame]:
        self._number = 1
        while line := self._file.readline(LONGEST_LINE):
            try:
                item = self._frame(line)
            except (ValueError, LookupError):  # of numbers, texts, kinds, lengths
                self._damage.line(self._number)
            else:
                if item is not None:
                    yield item
            self._number += line.endswith(b"\n")

    @abstractmethod
    def _read_head(self, lines: list[bytes]) -> None:
        """Find out what the log says of itself."""

    @abstractmethod
    def _frame(self, line: bytes) -> TimedFrame | None:
        """The frame of a line; None for a line without one. ValueError, LookupError where it is damaged."""


def _groups(pattern: "re.Pattern[bytes]", line: bytes) -> _Found:
    """ValueError where the line is none of these."""
    match = pattern.fullmatch(line)
    if match is None:
        raise ValueError
    return match.groupdict()


def _nanoseconds(found: _Found, digits: int = 9) -> int:
    """The time, of a whole number and decimals of units of 10**digits ns."""
    return int((found["s"] or b"0") + (found["f"] or b"").ljust(digits, b"0"))


def _can_frame(
    found: _Found, extended: bool, size: int | None = None, fd: bool = False, base: int = 16
) -> CanFrame:
    """ValueError where the numbers are no frame."""
    words = (found["data"] or b"").split()[:size]
    data = bytes.fromhex(b"".join(words).decode()) if base == 16 else bytes(map(int, words))
    can_id = int(found["id"] or b"", base)
    if size not in (None, len(data)) or not is_possible(can_id, extended, len(data), fd):
        raise ValueError
    return CanFrame(can_id, data, extended, fd)


# --- candump

_CANDUMP = rb"\((?P<s>\d{1,12})\.(?P<f>\d{1,9})\)[ \t]+[\x21-\x7e]{1,64}[ \t]+"
_ERROR_ID = rb"[2367ABEFabef][0-9A-Fa-f]{7}"
CANDUMP_LINE = re.compile(
    _CANDUMP + rb"(?:(?P<none>" + _ERROR_ID + rb")|(?P<id>[0-9A-Fa-f]{8}|[0-9A-Fa-f]{3}))#"
    rb"(?:(?P<fd>#[0-9A-Fa-f])?(?P<data>(?:[0-9A-Fa-f]{2})*)(?:_[0-9A-Fa-f])?|(?P<remote>[Rr][0-9A-Fa-f]{0,2}))"
    rb"(?:[ \t]+(?P<dir>[RTrt]))?[ \t\r\n]*"
)
CANDUMP_SCREEN_LINE = re.compile(
    rb"[ \t]*" + _CANDUMP + rb"(?:(?P<dir>RX|TX) [B-] [E-][ \t]+)?"
    rb"(?:(?P<none>"
    + _ERROR_ID
    + rb")|(?P<id>[0-9A-Fa-f]{8}|[0-9A-Fa-f]{3}))[ \t]+\[(?P<size>\d{1,2})\]"
    rb"(?:(?P<data>(?:[ \t]+[0-9A-Fa-f]{2})*)(?:[ \t]+'.*'|[ \t]+ERRORFRAME)?|[ \t]+(?P<remote>remote request))[ \t\r\n]*"
)
"""What ``candump -ta`` shows; a length of two digits is one of CAN FD."""


class CandumpReader(TextReader):
    """``candump -L`` and ``-l``: ``(1700000000.123456) can0 681#0011223344556677 R``; also what ``candump -ta`` shows."""

    def _read_head(self, lines: list[bytes]) -> None:
        found = (CANDUMP_LINE.fullmatch(x) or CANDUMP_SCREEN_LINE.fullmatch(x) for x in lines)
        first = next(filter(None, found), None)
        if first is not None and int(first["s"]) >= OLDEST_WALL_S:
            self.wall_start_ns = 0

    def _frame(self, line: bytes) -> TimedFrame | None:
        size = None
        match = CANDUMP_LINE.fullmatch(line)
        if match is None and (start := line.rfind(b"(")) > 0:
            # rubbish in front of a whole line
            match = CANDUMP_LINE.fullmatch(line, start)
            if match is not None:
                self._damage.line(self._number)
        if match is not None:
            found = match.groupdict()
            fd = found["fd"] is not None
        elif line.strip():
            found = _groups(CANDUMP_SCREEN_LINE, line)
            size = int(found["size"] or 0)
            fd = len(found["size"] or b"") == 2
        else:
            return None
        if found["none"] or found["remote"]:
            return None
        frame = _can_frame(found, len(found["id"] or b"") == 8, size, fd)
        received = (found["dir"] or b"")[:1] in (b"R", b"r")
        return TimedFrame(_nanoseconds(found), frame, received)


# --- Vector ASC

_ASC_TIME = rb"[ \t]*(?P<s>\d{1,10})\.(?P<f>\d{1,9})[ \t]+"
_ASC_DATA = rb"(?P<data>(?:[ \t]+[0-9A-Fa-f]{1,3})*)"
_ASC_CLASSIC = re.compile(
    _ASC_TIME + rb"\d{1,3}[ \t]+(?P<id>[0-9A-Fa-f]{1,9})(?P<x>[xX]?)[ \t]+(?P<dir>Rx|Tx|TxRq)[ \t]+"
    rb"(?:d[ \t]+(?P<size>[0-9A-Fa-f]{1,2})" + _ASC_DATA + rb"|(?P<remote>[rR]))",
    re.IGNORECASE,
)
_ASC_FD = re.compile(
    _ASC_TIME
    + rb"CANFD[ \t]+\d{1,3}[ \t]+(?P<dir>Rx|Tx|TxRq)[ \t]+(?P<id>[0-9A-Fa-f]{1,9})(?P<x>[xX]?)[ \t]+"
    rb"(?:[^\d\s]\S*[ \t]+)?[01][ \t]+[01][ \t]+(?P<dlc>[0-9A-Fa-f])[ \t]+(?P<size>\d{1,2})"
    + _ASC_DATA,
    re.IGNORECASE,
)
_ASC_ERROR = re.compile(
    _ASC_TIME + rb"(?:CANFD[ \t]+)?\d{1,3}[ \t]+(?:(?:Rx|Tx)[ \t]+)?ErrorFrame", re.IGNORECASE
)
ASC_LINES = (_ASC_CLASSIC, _ASC_FD, _ASC_ERROR)
ASC_HEAD = re.compile(
    rb"\s*(?:date\s|base\s+(?:hex|dec)|begin\s+triggerblock|//\s*version)", re.IGNORECASE
)
_ASC_OTHER = re.compile(
    rb"\s*(?://.*|(?:date|base|begin|end|no|internal|previous)\b.*|\d+\.\d+\s+(?!\d+\s+\S+\s+(?:Rx|Tx)\b)(?!CANFD\b)[\x09\x20-\x7e\x80-\xff]+)?\s*",
    re.IGNORECASE,
)
_ASC_EVENT = re.compile(_ASC_TIME)
_ASC_BASE = re.compile(
    rb"\s*base\s+(hex|dec)(?:\s+timestamps\s+(absolute|relative))?", re.IGNORECASE
)
_ASC_DATE = re.compile(r"\s*(?:date|begin\s+triggerblock)\s+\w+\s+(.+?)\s*$", re.IGNORECASE)
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_GERMAN_MONTHS = {"mär": "mar", "mrz": "mar", "mai": "may", "okt": "oct", "dez": "dec"}


class AscReader(TextReader):
    """Vector ASC, base hex or dec, times absolute or relative, CAN and CAN FD."""

    _base, _relative, _now = 16, False, 0

    def _read_head(self, lines: list[bytes]) -> None:
        for line in lines:
            if (match := _ASC_BASE.match(line)) is not None:
                self._base = 10 if match[1].lower() == b"dec" else 16
                self._relative = (match[2] or b"").lower() == b"relative"
            elif (date := _ASC_DATE.match(line.decode("utf-8", "replace"))) is not None:
                started = asc_time(date[1])
                if started is not None and started >= OLDEST_WALL_S * SECOND_NS:
                    self.wall_start_ns = started
            elif any(pattern.match(line) for pattern in ASC_LINES):
                break

    def __iter__(self) -> Iterator[TimedFrame]:
        self._now = 0
        return super().__iter__()

    def _frame(self, line: bytes) -> TimedFrame | None:
        match = _ASC_CLASSIC.match(line) or _ASC_FD.match(line)
        event = match or _ASC_ERROR.match(line)
        if event is None and _ASC_OTHER.fullmatch(line) is None:
            raise ValueError
        if (event := event or _ASC_EVENT.match(line)) is None:
            return None
        time_ns = _nanoseconds(event.groupdict())
        if self._relative:
            time_ns = self._now = self._now + time_ns
        if match is None:
            return None
        found = match.groupdict()
        if (fd := "dlc" in found) and not int(found["size"]) and int(found["dlc"], 16):
            return None
        if found.get("remote"):
            return None
        size = int(found["size"]) if fd else min(8, int(found["size"], self._base))
        frame = _can_frame(found, bool(found["x"]), size, fd, self._base)
        return TimedFrame(time_ns, frame, found["dir"].lower() == b"rx")


def asc_time(text: str) -> int | None:
    """Unix time in ns of ``Nov 14 10:13:20.123 pm 2023``, local time as ASC files have it; None where it is no date."""
    try:
        month, day, clock, *half, year = text.lower().split()
        hour, minute, second = clock.split(":")
        second, _, fraction = second.partition(".")
        hours = int(hour) % 12 + 12 * (half == ["pm"]) if half else int(hour)
        name = _GERMAN_MONTHS.get(month[:3], month[:3])
        date = int(year), _MONTHS.index(name) + 1, int(day)
        moment = datetime(*date, hours, int(minute), int(second))  # noqa: DTZ001  local
        return int(moment.timestamp()) * SECOND_NS + int(fraction.ljust(9, "0")[:9])
    except (ValueError, LookupError, OverflowError, OSError):
        return None


# --- PEAK TRC

TRC_HEAD = re.compile(
    rb";\s*(?:\$FILEVERSION|\$STARTTIME|\$COLUMNS|Start time|#{8})", re.IGNORECASE
)
TRC_LINE = re.compile(
    rb"\s*\d{1,10}\)?[ \t]+\d{1,12}(?:\.\d{1,6})?[ \t]+"
    rb"(?:(?:DT|FD|FB|FE|BI|RR|ST|EC|ER|EV|Rx|Tx|\d{1,2})[ \t]+)*(?:[0-9A-Fa-f]{8}|[0-9A-Fa-f]{4})[ \t]"
)
"""How a line of any version begins."""
_TRC_EVENT = re.compile(
    rb"\s*\d{1,10}\)?\s+[\d.]+\s+(?:\d+\s+)?(?:RR|ST|EC|ER|EV|Warng|Error|ErrCt|Event|FFFFFFFF)\s.*",
    re.DOTALL,
)
_TRC_COLUMNS = {
    "1.0": "N,O,I,l,D",
    "1.1": "N,O,d,I,l,D",
    "1.3": "N,O,B,d,I,R,l,D",
    "2.0": "N,O,T,I,d,l,D",
    "2.1": "N,O,T,B,I,d,R,L,D",
}
_TRC_PIECES = {
    "O": rb"(?P<s>\d{1,12})(?:\.(?P<f>\d{1,6}))?",
    "T": rb"(?P<kind>DT|FD|FB|FE|BI)",
    "I": rb"(?P<id>[0-9A-Fa-f]{1,8})",
    "B": rb"[\x21-\x7e]+",
    "d": rb"(?P<dir>Rx|Tx)",
    "l": rb"(?P<size>\d{1,2})",
    "L": rb"(?P<dlc>\d{1,2})",
}
"""Columns that are read; the data stand in the last one, D."""
_TRC_DAY0 = datetime(1899, 12, 30, tzinfo=UTC)


class TrcReader(TextReader):
    """PEAK TRC, file versions 1.0, 1.1, 1.3, 2.0 and 2.1."""

    def _read_head(self, lines: list[bytes]) -> None:
        version, columns = "", ""
        for line in lines:
            key, _, value = line.decode("latin-1").strip().partition("=")
            if key and not key.startswith(";"):
                break
            if key == ";$FILEVERSION":
                version = value.strip()
            elif key == ";$COLUMNS":
                columns = value.replace(" ", "")
            elif key == ";$STARTTIME":
                self.wall_start_ns = _trc_start(value)
        if not columns.endswith(",D"):
            newest = "2.1" if version.startswith("2") else "1.0"
            columns = _TRC_COLUMNS.get(version, _TRC_COLUMNS[newest])
        names = columns.removesuffix(",D").split(",")
        pieces = (_TRC_PIECES.get(name, rb"\S+") for name in names)
        data = rb"(?:\s+(?P<data>\S[^\r\n]*))?\s*"
        self._line = re.compile(rb"\s*" + rb"\s+".join(pieces) + data)

    def _frame(self, line: bytes) -> TimedFrame | None:
        if not line.strip() or line.lstrip()[:1] == b";" or _TRC_EVENT.fullmatch(line):
            return None
        found = _groups(self._line, line)
        if (found["data"] or b"").strip().upper() == b"RTR":
            return None
        fd = found.get("kind") not in (None, b"DT")
        size = found.get("size")
        length = FD_LENGTHS[int(found["dlc"] or 0)] if size is None else int(size)
        frame = _can_frame(found, len(found["id"] or b"") > 4, length, fd)
        if len((found["data"] or b"").split()) > length:
            raise ValueError
        return TimedFrame(_nanoseconds(found, 6), frame, found.get("dir") == b"Rx")


def _trc_start(text: str) -> int | None:
    """Unix time in ns of days since 1899-12-30; None where it is none, or before 1990."""
    try:
        moment = _TRC_DAY0 + timedelta(days=float(text))
    except (ValueError, OverflowError):
        return None
    start = (moment - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1) * 1000
    return start if start >= OLDEST_WALL_S * SECOND_NS else None
