"""Reader of Vector ASC, which has no public specification.

It is read as python-can reads it, and as Vector's tools write it: symbolic names, requests to send,
times since midnight.
"""

import re
from datetime import datetime

from kontronik_can_gw.desk.recordings.can_logs.text import (
    OLDEST_WALL_S,
    TextReader,
    checked,
    error_frame,
    nanoseconds,
    remote_frame,
)
from kontronik_can_gw.desk.recordings.recording import LogFrame
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.times import SECOND

_DIRECTIONS = (b"rx", b"tx", b"txrq")
_REQUEST = b"txrq"
"""A request to send. The frame itself follows as Tx when it has been sent."""
_HEADS = (b"date", b"base", b"begin", b"end", b"no", b"internal", b"previous")
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_GERMAN_MONTHS = {"mär": "mar", "mrz": "mar", "mai": "may", "okt": "oct", "dez": "dec"}
_HEAD = rb"\s*(?:date\s|base\s+(?:hex|dec)|begin\s+triggerblock|//\s*version)"
_FRAME = rb"\s*(?P<time>-?\d+\.\d+)\s+(?:CANFD\s+\d+\s+(?:Rx|Tx)|\d+\s+\S+\s+(?:Rx|Tx))"
_frame = re.compile(_FRAME, re.IGNORECASE).match
asc_line = re.compile(_HEAD + b"|" + _FRAME, re.IGNORECASE).match
"""Matches the beginning of a line of the head, or of a frame."""
_decimal_id = re.compile(rb"\bid\s*=\s*(\d+)(x?)\b").search
"""The id at the end of a line, decimal whatever the base is."""
_Moment = tuple[datetime, int]
"""Local time in whole seconds, and nanoseconds."""
_CLOSE_S = 600
"""The first frame is this close to the beginning of its block."""


class AscReader(TextReader):
    """The reader of Vector ASC: base hex or dec, times absolute or relative, CAN and CAN FD."""

    _base = 16
    _is_relative = False
    _now = 0
    """Time of the last line, if times are relative."""

    def _is_head(self, line: bytes, is_inside: bool) -> bool:
        if is_inside:
            return _frame(line) is None and b"errorframe" not in line.lower()
        return line.lstrip()[:5].lower() == b"date "

    def _read_head(self, lines: list[bytes]) -> int | None:
        written = None
        began = None
        for line in lines:
            found = _frame(line)
            if found is not None:
                break
            words = line.decode("utf-8", "replace").lower().split()
            if words[:1] == ["base"]:
                self._base = 10 if words[1:2] == ["dec"] else 16
                self._is_relative = words[-1] == "relative"
            elif words[:1] == ["date"]:
                written = asc_time(words[2:])
            elif words[:2] == ["begin", "triggerblock"]:
                began = asc_time(words[3:])
        else:
            found = None
        began = began or written
        self._now = 0
        if began is None:
            return None
        if found is not None and not self._is_relative:
            began = _time_zero(began, written or began, float(found["time"]))
        moment, fraction_ns = began
        start_ns = int(moment.timestamp()) * SECOND + fraction_ns
        return start_ns if start_ns >= OLDEST_WALL_S * SECOND else None

    def _frame(self, line: bytes) -> LogFrame | None:
        line = line.lower()
        words = line.split()
        if words[0].startswith(b"//") or words[0] in _HEADS:
            return None
        time_ns = nanoseconds(words[0])
        if self._is_relative:
            self._now += time_ns
            time_ns = self._now
        is_fd = words[1:2] == [b"canfd"]
        if b"errorframe" in words[2:5]:
            received = b"tx" not in words[2:5]
            channel = words[2] if is_fd else words[1]
            return _logged(time_ns, error_frame(), received, channel)
        if is_fd:
            return self._fd_frame(time_ns, line, words[2:])
        if len(words) > 4 and words[3] in _DIRECTIONS:
            return self._classic_frame(time_ns, line, words[1:])
        return None  # an event of another kind

    def _classic_frame(self, time_ns: int, line: bytes, words: list[bytes]) -> LogFrame | None:
        channel, id_word, direction, kind, *data = words
        if direction == _REQUEST:
            return None
        number, extended = self._id(id_word, line)
        if kind == b"r":
            length = 0  # older files do not have it
            if data and data[0].isalnum() and len(data[0]) <= 2:
                length = int(data[0], self._base)
            frame = remote_frame(number, length, extended)
        elif kind == b"d":
            length = min(8, int(data[0], self._base))
            frame = CanFrame(number, self._bytes(data[1:], length), extended)
        else:
            raise ValueError
        return _logged(time_ns, frame, direction == b"rx", channel)

    def _fd_frame(self, time_ns: int, line: bytes, words: list[bytes]) -> LogFrame | None:
        if not words[0].isdigit() or words[1] == _REQUEST:
            return None  # "CANFD Start of measurement", or a request
        channel, direction, id_word, *rest = words
        if direction not in _DIRECTIONS:
            raise ValueError
        number, extended = self._id(id_word, line)
        if rest[0] not in (b"0", b"1"):
            del rest[0]  # the symbolic name
        code = int(rest[2], 16)
        length = int(rest[3])
        data = rest[4:]
        if code and not length:
            frame = remote_frame(number, code, extended)
        else:
            frame = CanFrame(
                number,
                self._bytes(data, length),
                extended,
                fd=True,
            )
        return _logged(time_ns, frame, direction == b"rx", channel)

    def _bytes(self, words: list[bytes], length: int) -> bytes:
        if len(words) < length:
            raise ValueError
        return bytes(int(byte, self._base) for byte in words[:length])

    def _id(self, word: bytes, line: bytes) -> tuple[int, bool]:
        """Return the id, and True if it has 29 bits.

        If ``word`` is a name, the line ends with the id.
        """
        extended = word.endswith(b"x")
        digits = word.removesuffix(b"x")
        stated = None
        if b"=" in line:
            stated = _decimal_id(line)
        if stated is None:
            return int(digits, self._base), extended
        number = int(stated[1])
        expected = f"{number:X}" if self._base == 16 else str(number)
        if digits.lstrip(b"0").upper() == expected.encode():
            return number, extended
        return number, bool(stated[2]) or number > 0x7FF


def _logged(time_ns: int, frame: CanFrame, received: bool, channel: bytes) -> LogFrame:
    """Return a checked frame. ``channel`` is a number, possibly with leading zeros."""
    name = str(int(channel))
    return checked(LogFrame(time_ns, frame, received, name))


def asc_time(words: list[str]) -> _Moment | None:
    """Return local time and nanoseconds of a date. None if it is not a date.

    For example ``Nov 14 10:13:20.123 pm 2023``.
    """
    try:
        month, day, clock, *half, year = words
        hour, minute, second = clock.split(":")
        second, _, fraction = second.partition(".")
        hours = int(hour)
        if half:
            hours %= 12
            if half == ["pm"]:
                hours += 12
        name = _GERMAN_MONTHS.get(month[:3], month[:3])
        month_number = _MONTHS.index(name) + 1
        date = (int(year), month_number, int(day))
        moment = datetime(*date, hours, int(minute), int(second))  # noqa: DTZ001  local
        moment.timestamp()
        return moment, int(fraction.ljust(9, "0")[:9])
    except (ValueError, LookupError, OverflowError, OSError):
        return None


def _time_zero(began: _Moment, written: _Moment, first_s: float) -> _Moment:
    """Return the time from which the times in the file count. The file does not contain it.

    It is the beginning of the block, the date of the file, or midnight. The result is the one with
    which the time of the first frame is closest to the beginning of the block.
    """
    begin, _ = began
    midnight = (begin.replace(hour=0, minute=0, second=0), 0)

    def distance_s(zero: _Moment) -> float:
        moment, _ = zero
        since_zero = begin - moment
        return abs(since_zero.total_seconds() - first_s)

    closest = min(
        began,
        written,
        midnight,
        key=distance_s,
    )
    if distance_s(closest) > _CLOSE_S:
        return began
    return closest
