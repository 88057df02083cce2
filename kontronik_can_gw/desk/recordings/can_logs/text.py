"""Readers of logs that are text: candump, Vector ASC, PEAK TRC. A line that cannot be read is counted, the next one is read again.

Times stay whole numbers of nanoseconds. The formats, where no specification is public, are read as python-can reads them.
"""

import re
from collections.abc import Iterator
from datetime import datetime
from typing import BinaryIO

from kontronik_can_gw.desk.recordings.can_logs.record import (
    OLDEST_WALL_S,
    SECOND_NS,
    Damage,
    LogFrame,
    is_possible,
)
from kontronik_can_gw.frames import CanFrame

LONGEST_LINE = 4096
"""Bytes; a line of any of these formats is far shorter."""
HEAD_LINES = 200
"""Lines in which a log's head is looked for."""

CANDUMP_LINE = re.compile(
    rb"\((\d{1,12})\.(\d{1,9})\)[ \t]+([\x21-\x7e]{1,64})[ \t]+"
    rb"([0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})#(?:(#[0-9A-Fa-f])?((?:[0-9A-Fa-f]{2})*)(?:_[0-9A-Fa-f])?|([Rr][0-9A-Fa-f]{0,2}))"
    rb"(?:[ \t]+([RTrt]))?[ \t\r\n]*"
)
_CANDUMP_END = re.compile(CANDUMP_LINE.pattern + rb"\Z")
CANDUMP_SCREEN_LINE = re.compile(
    rb"[ \t]*\((\d{1,12})\.(\d{1,9})\)[ \t]+([\x21-\x7e]{1,64})[ \t]+(?:(RX|TX) [B-] [E-][ \t]+)?([0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})"
    rb"[ \t]+\[(\d{1,2})\](?:((?:[ \t]+[0-9A-Fa-f]{2})*)(?:[ \t]+'.*'|[ \t]+ERRORFRAME)?|[ \t]+(remote request))[ \t\r\n]*"
)
"""What ``candump -ta`` shows; a length of two digits is one of CAN FD."""
_ERROR_FLAG = 0x20000000

ASC_LINE = re.compile(
    rb"[ \t]*(\d{1,10})\.(\d{1,9})[ \t]+(?:"
    rb"(\d{1,3})[ \t]+([0-9A-Fa-f]{1,9})([xX]?)[ \t]+(Rx|Tx|TxRq)[ \t]+(?:d[ \t]+([0-9A-Fa-f]{1,2})((?:[ \t]+[0-9A-Fa-f]{1,3})*)|([rR]))"
    rb"|CANFD[ \t]+(\d{1,3})[ \t]+(Rx|Tx|TxRq)[ \t]+([0-9A-Fa-f]{1,9})([xX]?)[ \t]+(?:[^\d\s]\S*[ \t]+)?([01])[ \t]+([01])[ \t]+"
    rb"([0-9A-Fa-f])[ \t]+(\d{1,2})((?:[ \t]+[0-9A-Fa-f]{1,3})*)"
    rb"|(?:CANFD[ \t]+)?\d{1,3}[ \t]+(?:(?:Rx|Tx)[ \t]+)?(ErrorFrame)"
    rb")",
    re.IGNORECASE,
)
ASC_HEAD = re.compile(
    rb"\s*(?:date\s|base\s+(?:hex|dec)|begin\s+triggerblock|//\s*version)", re.IGNORECASE
)
_ASC_OTHER = re.compile(
    rb"\s*(?://.*|(?:date|base|begin|end|no|internal|previous)\b.*|\d+\.\d+\s+(?!\d+\s+\S+\s+(?:Rx|Tx)\b)(?!CANFD\b)[\x09\x20-\x7e\x80-\xff]+)?\s*",
    re.IGNORECASE,
)
_ASC_BASE = re.compile(
    rb"\s*base\s+(hex|dec)(?:\s+timestamps\s+(absolute|relative))?", re.IGNORECASE
)
_ASC_DATE = re.compile(r"\s*(?:date|begin\s+triggerblock)\s+\w+\s+(.+?)\s*$", re.IGNORECASE)
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_GERMAN_MONTHS = {"mär": "mar", "mrz": "mar", "mai": "may", "okt": "oct", "dez": "dec"}
_RELATIVE = b"relative"
_ASC_EVENT = re.compile(rb"\s*(\d+)\.(\d{1,9})\s")


def head_of(file: BinaryIO) -> Iterator[bytes]:
    """The first lines, in which a log says what it is."""
    for _ in range(HEAD_LINES):
        line = file.readline(LONGEST_LINE)
        if not line:
            return
        yield line


def nanoseconds(seconds: bytes, fraction: bytes) -> int:
    """A time of whole seconds and up to nine decimals."""
    return int(seconds) * SECOND_NS + int(fraction.ljust(9, b"0"))


def lines_of(file: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Number (from 1) and bytes of each line; of one that is longer than a line can be its end."""
    number = 0
    while line := file.readline(LONGEST_LINE):
        number += 1
        if len(line) == LONGEST_LINE and not line.endswith(b"\n"):
            while (more := file.readline(LONGEST_LINE)) and not more.endswith(b"\n"):
                line = more
            line = (line + more)[-LONGEST_LINE:]
        yield number, line


class CandumpReader:
    """``candump -L`` and ``-l``: ``(1700000000.123456) can0 681#0011223344556677 R``; also what ``candump -ta`` shows."""

    def __init__(self, file: BinaryIO, damage: Damage) -> None:
        self._file = file
        self._damage = damage
        self.wall_start_ns: int | None = None
        heads = (
            CANDUMP_LINE.fullmatch(x) or CANDUMP_SCREEN_LINE.fullmatch(x) for x in head_of(file)
        )
        first = next(filter(None, heads), None)
        if first is not None and int(first[1]) >= OLDEST_WALL_S:
            self.wall_start_ns = 0
        file.seek(0)

    def __iter__(self) -> Iterator[LogFrame]:
        damage, whole = self._damage, CANDUMP_LINE.fullmatch
        channels: dict[bytes, str] = {}
        for number, line in lines_of(self._file):
            match = whole(line)
            if match is None and (shown := CANDUMP_SCREEN_LINE.fullmatch(line)) is not None:
                match = whole(_as_logged(shown))
                if match is None or (match[7] is None and len(match[6]) != 2 * int(shown[6])):
                    damage.line(number)
                    continue
            elif match is None:
                if not line.strip():
                    continue
                damage.line(number)
                start = line.rfind(b"(")  # rubbish in front of a whole line
                match = _CANDUMP_END.match(line, start) if start > 0 else None
                if match is None:
                    continue
            seconds, fraction, name, id_text, flags, data_text, remote, direction = match.groups()
            can_id = int(id_text, 16)
            extended = len(id_text) == 8
            if extended and can_id & _ERROR_FLAG:
                damage.skip("error frames")
                continue
            if remote is not None:
                damage.skip("remote frames")
                continue
            data = bytes.fromhex(data_text.decode("ascii"))
            fd = flags is not None
            if not is_possible(can_id, extended, len(data), fd):
                damage.line(number)
                continue
            channel = channels.get(name)
            if channel is None:
                channel = channels[name] = name.decode("ascii")
            frame = CanFrame(can_id, data, extended, fd)
            yield LogFrame(
                nanoseconds(seconds, fraction), frame, direction in (b"R", b"r"), channel
            )


def _as_logged(shown: "re.Match[bytes]") -> bytes:
    """The line of a log for one of the screen."""
    seconds, fraction, name, direction, can_id, length, data, remote = shown.groups()
    content = b"R"
    if remote is None:
        content = (b"#1" if len(length) == 2 else b"") + b"".join(data.split())
    end = b" " + direction[:1] if direction else b""
    return b"(%b.%b) %b %b#%b%b" % (seconds, fraction, name, can_id, content, end)


class AscReader:
    """Vector ASC, base hex or dec, times absolute or relative, CAN and CAN FD; other events are left out."""

    def __init__(self, file: BinaryIO, damage: Damage) -> None:
        self._file = file
        self._damage = damage
        self._base = 16
        self._relative = False
        self.wall_start_ns: int | None = None
        for line in head_of(file):
            if (match := _ASC_BASE.match(line)) is not None:
                self._base = 10 if match[1].lower() == b"dec" else 16
                self._relative = (match[2] or b"").lower() == _RELATIVE
            elif (date := _ASC_DATE.match(line.decode("utf-8", "replace"))) is not None:
                started = asc_time(date[1])
                if started is not None and started >= OLDEST_WALL_S * SECOND_NS:
                    self.wall_start_ns = started
            elif ASC_LINE.match(line) is not None:
                break
        file.seek(0)

    def __iter__(self) -> Iterator[LogFrame]:
        damage, relative = self._damage, self._relative
        find, other = ASC_LINE.match, _ASC_OTHER.fullmatch
        now = 0
        for number, line in lines_of(self._file):
            match = find(line)
            if match is None:
                if other(line) is None:
                    damage.line(number)
                elif relative and (event := _ASC_EVENT.match(line)) is not None:
                    now += nanoseconds(event[1], event[2])
                continue
            time_ns = nanoseconds(match[1], match[2])
            if relative:
                time_ns = now = now + time_ns
            if match[19] is not None:
                damage.skip("error frames")
            elif match[9] is not None or (
                match[10] is not None and not int(match[17]) and int(match[16], 16)
            ):
                damage.skip("remote frames")
            elif (frame := self._frame(match)) is None:
                damage.line(number)
            else:
                channel, direction = (match[10] or match[3]), (match[11] or match[6])
                received = direction.lower() == b"rx"
                yield LogFrame(time_ns, frame, received, channel.decode("ascii"))

    def _frame(self, match: "re.Match[bytes]") -> CanFrame | None:
        """The frame of a line; None where its numbers are no frame."""
        base = self._base
        fd = match[10] is not None
        try:
            if fd:
                id_text, x, content = match[12], match[13], match[18]
                size = int(match[17])
            else:
                id_text, x, content = match[4], match[5], match[8]
                size = min(8, int(match[7], base))
            can_id = int(id_text, base)
            words = content.split()[:size]
            if base == 16:
                data = bytes.fromhex(b"".join(words).decode("ascii"))
            else:
                data = bytes(map(int, words))
        except ValueError:
            return None
        if len(data) != size or not is_possible(can_id, bool(x), size, fd):
            return None
        return CanFrame(can_id, data, bool(x), fd)


def asc_time(text: str) -> int | None:
    """Unix time in ns of ``Nov 14 10:13:20.123 pm 2023``, local time as ASC files have it; None where it is no date."""
    words = text.lower().split()
    if len(words) not in (4, 5):
        return None
    month = _GERMAN_MONTHS.get(words[0][:3], words[0][:3])
    try:
        clock, _, fraction = words[2].partition(".")
        hour, minute, second = (int(part) for part in clock.split(":"))
        if len(words) == 5:
            hour = hour % 12 + (12 if words[3] == "pm" else 0)
        year, month_number, day = int(words[-1]), _MONTHS.index(month) + 1, int(words[1])
        moment = datetime(year, month_number, day, hour, minute, second)  # noqa: DTZ001  local
        return int(moment.timestamp()) * SECOND_NS + int((fraction or "0").ljust(9, "0")[:9])
    except (ValueError, OverflowError, OSError):
        return None
