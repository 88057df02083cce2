"""Readers of candump logs and PEAK TRC. asc.py reads ASC.

A damaged line is counted, and reading continues with the next line. Times are whole numbers of
nanoseconds, in TRC of microseconds. python-can reads the lines of TRC. Events other than frames are
left out.
"""

import io
import re
from binascii import unhexlify
from collections.abc import Iterator, Sequence
from io import BufferedReader
from itertools import takewhile
from typing import Any, BinaryIO

from kontronik_can_gw.desk.recordings.recording import ERROR, LATEST_NS, LogFrame
from kontronik_can_gw.frames import MAX_EXTENDED_ID, CanFrame
from kontronik_can_gw.light_imports import without_asammdf
from kontronik_can_gw.times import SECOND

OLDEST_WALL_S = 631_152_000
"""1990. Earlier times are not Unix times, but seconds since a start."""
MAX_S = 1 << 31
"""Limit of a frame's time. python-can returns any number, also infinite ones."""
_EXACT_S = 1 << 22
"""A float of at least this many seconds is not exact to the nanosecond."""
LONGEST_LINE = 4096
"""Bytes. The lines of all these formats are far shorter."""
FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
_BUS_ERROR = 0x80
_HEAD_LINES = 200
"""Number of lines that may contain a log's head."""
_SHOWN = 8
"""Number of damaged lines that are listed."""
_new = tuple.__new__
"""Makes a named tuple in half the time."""


def checked(item: LogFrame) -> LogFrame:
    """Return the frame, if it is possible.

    Raises ValueError if its id or its number of bytes is impossible on a CAN bus, or its time in a
    log.
    """
    frame = item.frame
    size = len(frame.data)
    can_id = frame.can_id
    if can_id & ERROR:
        can_id &= ~ERROR
        has_valid_id = 0 <= can_id <= MAX_EXTENDED_ID and not frame.extended
    else:
        has_valid_id = 0 <= can_id <= (MAX_EXTENDED_ID if frame.extended else 0x7FF)
    has_valid_size = size in FD_LENGTHS if frame.fd else size <= 8
    if item.time_ns > LATEST_NS or not has_valid_id or not has_valid_size:
        raise ValueError
    return item


def frame_of(message: Any, first_channel: int = 0) -> LogFrame:
    """Return the frame of a message of python-can. Raises ValueError if it is damaged.

    ``first_channel``: number in the log of the channel to which python-can gives the number 0.
    """
    data = bytes(message.data)
    dlc = message.dlc
    if not abs(message.timestamp) < MAX_S:
        raise ValueError
    if message.is_error_frame:
        frame = error_frame(message.arbitration_id, data)
    elif message.is_remote_frame:
        frame = remote_frame(message.arbitration_id, dlc, message.is_extended_id)
    else:
        size = dlc if message.is_fd else min(dlc, 8)
        if len(data) != size or (dlc > 15 and not message.is_fd):
            raise ValueError
        frame = CanFrame(message.arbitration_id, data, message.is_extended_id, message.is_fd)
    time_ns = round(message.timestamp * SECOND)
    if abs(message.timestamp) >= _EXACT_S:
        time_ns = round(time_ns, -3)
    channel = "1"
    if message.channel is not None:
        channel = str(message.channel + first_channel)
    return checked(LogFrame(time_ns, frame, message.is_rx, channel))


def error_frame(class_: int = 0, data: bytes = b"") -> CanFrame:
    """Return an error frame as in SocketCAN: with 8 bytes, and a bus error without a class."""
    can_id = class_ & MAX_EXTENDED_ID or _BUS_ERROR
    return CanFrame(ERROR | can_id, data[:8].ljust(8, b"\0"))


def remote_frame(can_id: int, dlc: int, extended: bool) -> CanFrame:
    """Return a remote frame. Raises ValueError if it requests an impossible number of bytes."""
    if not 0 <= dlc <= 15:
        raise ValueError
    return CanFrame(
        can_id,
        bytes(min(dlc, 8)),
        extended,
        remote=True,
    )


class LogReader:
    """An iterable of the LogFrames of an open log.

    ``damage`` has a line for each damaged part. It is complete after the end of the log.
    """

    wall_start_ns: int | None = None
    """Unix time of the log's time 0. None if the log does not have it."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.damage: list[str] = []

    def close(self) -> None:
        """Release all resources except the file."""

    def __iter__(self) -> Iterator[LogFrame]:
        raise NotImplementedError


class TextReader(LogReader):
    """Reads a log line by line.

    ``file`` is at its beginning. Its first buffer must contain the log's head. A later head begins
    a new session, because logs can be joined. If both have a date, the times of the session count
    from the date of the log's first head.
    """

    def __init__(self, file: BufferedReader) -> None:
        super().__init__(file)
        self._file: BufferedReader = file
        self._line_number = 1
        self._damaged = 0
        """Number of damaged lines."""
        self._last_damaged = 0
        """Number of the last damaged line."""
        self._shown: list[str] = []
        """Numbers of the first damaged lines."""
        self._later_head: list[bytes] = []
        """The lines of a later head that have been read so far."""
        self._is_first_head = True
        self._session_ns = 0
        """Time between the date of the log and the date of the session."""
        head = io.BytesIO(file.peek()).readlines()
        self.wall_start_ns = self._read_head(head[:_HEAD_LINES])

    def __iter__(self) -> Iterator[LogFrame]:
        while line := self._file.readline(LONGEST_LINE):
            item = self._read_line(line)
            if item is not None:
                yield item
        self._describe_damage()

    def _read_line(self, line: bytes) -> LogFrame | None:
        """Return the frame of the next line, or of the next piece of a long line.

        None if it does not have a frame.
        """
        item = None
        number = self._line_number
        self._line_number += line.endswith(b"\n")
        try:
            if line.strip() and not self._is_in_head(line):
                item = self._frame(line)
                if item is not None and self._session_ns:
                    item = self._in_session(item)
        except (ValueError, LookupError):  # a damaged number, text or length
            self._note_damage(number)
        return item

    def _note_damage(self, number: int) -> None:
        if number == self._last_damaged:  # another piece of a long line
            return
        self._last_damaged = number
        self._damaged += 1
        if self._damaged <= _SHOWN:
            self._shown.append(str(number))

    def _describe_damage(self) -> None:
        count = self._damaged
        if not count:
            return
        noun = "damaged lines" if count > 1 else "damaged line"
        text = f"{count} {noun}: {', '.join(self._shown)}"
        if count > _SHOWN:
            text += f" and {count - _SHOWN} more"
        self.damage.insert(0, text)

    def _is_in_head(self, line: bytes) -> bool:
        """Return True for a line of a head. The line after a later head begins its session."""
        if self._is_head(line, bool(self._later_head)):
            if len(self._later_head) < _HEAD_LINES:
                self._later_head.append(line)
            return True
        if self._later_head:
            head = [*self._later_head, line]
            self._later_head = []
            if not self._is_first_head:
                start_ns = self._read_head(head)
                if start_ns is not None and self.wall_start_ns is not None:
                    self._session_ns = start_ns - self.wall_start_ns
        self._is_first_head = False
        return False

    def _in_session(self, item: LogFrame) -> LogFrame:
        """Return a frame with its time since the date of the log. Unix times stay as they are."""
        if item.time_ns >= OLDEST_WALL_S * SECOND:
            return item
        return checked(item._replace(time_ns=item.time_ns + self._session_ns))

    def _is_head(self, line: bytes, is_inside: bool) -> bool:
        """Return True for a line of a head. ``is_inside``: the previous line was one, too."""
        raise NotImplementedError

    def _read_head(self, lines: list[bytes]) -> int | None:
        """Read the settings in a head, which may be followed by a frame.

        Returns the Unix time in ns from which the times count. None if the head has no date.
        """
        raise NotImplementedError

    def _frame(self, line: bytes) -> LogFrame | None:
        """Return the checked frame of a line. None for a line without a frame.

        Raises ValueError or LookupError if the line is damaged.
        """
        raise NotImplementedError


def nanoseconds(text: bytes) -> int:
    """Return decimal seconds, which may be negative, as exact nanoseconds.

    Raises ValueError for other texts.
    """
    is_negative = text.startswith(b"-")
    seconds, _, fraction = text[is_negative:].partition(b".")
    if not seconds.isdigit() or len(seconds) > 12:
        raise ValueError
    if not fraction.isdigit() or len(fraction) > 9:
        raise ValueError
    found = int(seconds + fraction.ljust(9, b"0"))
    if is_negative:
        return -found
    return found


# --- candump

_ID = rb"(?:(?P<error>[2367ABEFabef][0-9A-Fa-f]{7})|(?P<id>[0-9A-Fa-f]{8}|[0-9A-Fa-f]{3}))"
"""``error`` is the id of an error frame, which has the bit ERROR."""
_LINE = re.compile(
    rb"[ \t]*\((?P<time>\d+\.\d+)\)[ \t]+(?P<channel>[\x21-\x7e]{1,64})[ \t]+"
    + _ID
    + rb"#(?:(?P<fd>#[0-9A-Fa-f])?(?P<data>(?:[0-9A-Fa-f]{2})*)(?:_[0-9A-Fa-f])?"
    rb"|(?P<remote>[Rr][0-9A-Fa-f]{0,2}))(?:[ \t]+(?P<dir>[RTrt]))?\s*"
)


candump_line = _LINE.fullmatch
"""Matches a line of ``candump -L``: ``(1700000000.123456) can0 681#0011223344556677 R``."""


candump_screen_line = re.compile(
    rb"[ \t]*(?:\([^()\n]{1,40}\)[ \t]+)?(?P<interface>[\w.-]{1,15})[ \t]+"
    rb"(?:[RT]X[ \t]+\S[ \t]+\S[ \t]+)?(?:[0-9A-F]{3}|[0-9A-F]{8})[ \t]+\[\d{1,2}\](?:[ \t]|\r?$)",
    re.MULTILINE,
).match
"""Matches a line of candump without ``-L``: ``(000.000000)  can0  681   [8]  00 11 22 33``."""
_split_lines = re.compile(
    rb"\(([0-3]?\d{1,9})\.(\d{6})\) ([\x21-\x7e]{1,64}) ([0-7][0-9A-F]{2}|[01][0-9A-F]{7})"
    rb"#([0-9A-F]{0,16})(?: ([RT]))?\n|([^\n]*\n)"
).findall
"""Returns a tuple for each line: the groups of a usual line, or any other line in the last group.

The groups need no further check, except for an odd number of digits. Its twin is ``candump_line``,
which reads every line, but takes five times as long (tests/recordings/test_candump_lines.py).
"""
_IS_RECEIVED = {b"R": True, b"r": True, b"T": False, b"t": False, b"": None, None: None}
"""Direction by its letter. None: the line does not have a direction."""


class CandumpReader(TextReader):
    """The reader of ``candump -L`` and ``-l``.

    All complete lines in the file's buffer are read at once, which is faster than line by line. An
    incomplete line, which is the last one in most buffers, is read alone.
    """

    def _is_head(self, line: bytes, is_inside: bool) -> bool:  # noqa: ARG002  it has no head
        return False

    def _read_head(self, lines: list[bytes]) -> int | None:
        first = next(filter(None, map(candump_line, lines)), None)
        if first is not None and float(first["time"]) >= OLDEST_WALL_S:
            return 0
        return None

    def __iter__(self) -> Iterator[LogFrame]:
        file = self._file
        while buffered := file.peek():
            size = buffered.rfind(b"\n") + 1
            if size:
                yield from self._read_lines(file.read(size))
                continue
            item = self._read_line(file.readline(LONGEST_LINE))
            if item is not None:
                yield item
        self._describe_damage()

    def _read_lines(self, lines: bytes) -> Iterator[LogFrame]:
        """Yield the frames of complete lines."""
        last_name = b""
        channel = ""
        for seconds, micros, name, can_id, digits, direction, other in _split_lines(lines):
            if other:
                for begin in range(0, len(other), LONGEST_LINE):
                    item = self._read_line(other[begin : begin + LONGEST_LINE])
                    if item is not None:
                        yield item
                continue
            try:
                data = unhexlify(digits)
            except ValueError:  # an odd number of digits
                self._note_damage(self._line_number)
                continue
            finally:
                self._line_number += 1
            if name != last_name:
                last_name = name
                channel = name.decode("ascii")
            extended = len(can_id) == 8
            frame = _new(CanFrame, (int(can_id, 16), data, extended, False, 0, False, False))
            time_ns = int(seconds + micros) * 1000
            yield _new(LogFrame, (time_ns, frame, _IS_RECEIVED[direction], channel))

    def _frame(self, line: bytes) -> LogFrame | None:
        match = candump_line(line)
        if match is None:
            raise ValueError
        found = match.groupdict()
        digits = found["data"] or b""
        data = bytes.fromhex(digits.decode())
        if found["error"]:
            frame = error_frame(int(found["error"], 16), data)
        else:
            can_id = int(found["id"], 16)
            extended = len(found["id"]) == 8
            if found["remote"]:
                dlc = int(found["remote"][1:2] or b"0", 16)
                frame = remote_frame(can_id, dlc, extended)
            else:
                frame = CanFrame(can_id, data, extended, found["fd"] is not None)
        time_ns = nanoseconds(found["time"])
        received = _IS_RECEIVED[found["dir"]]
        channel = found["channel"].decode("ascii")
        return checked(LogFrame(time_ns, frame, received, channel))


# --- PEAK TRC

_TRC_HEAD = rb";\s*(?:\$FILEVERSION|\$STARTTIME|\$COLUMNS|Start time|#{8})"
trc_line = re.compile(_TRC_HEAD, re.IGNORECASE).match
"""Matches a line of the head."""
_NEWER_TRC = re.compile(r"\$FILEVERSION=(?!1\.0\s)")
"""A version except 1.0.

python-can reads files without a version as 1.0. It does not recognise an explicit 1.0, but reads
such files in the same way.
"""


_TRC_COLUMNS = {
    "": {"O": 1, "T": 4},
    "10": {"O": 1, "T": 4},
    "11": {"O": 1, "T": 2},
    "13": {"O": 1, "B": 2, "T": 3},
}
"""Columns of time, bus, and type of an error frame, by version.

The head of later versions names the columns.
"""


class TrcReader(TextReader):
    """The reader of PEAK TRC, file versions 1.0, 1.1, 1.3, 2.0 and 2.1."""

    def _is_head(self, line: bytes, is_inside: bool) -> bool:
        return line.lstrip().startswith(b";") and (is_inside or trc_line(line) is not None)

    def _read_head(self, lines: list[bytes]) -> int | None:
        with without_asammdf():
            from can.io.trc import TRCFileVersion, TRCReader
            from can.util import dlc2len
        is_in_head = re.compile(rb"\s*(?:;|$)").match
        head = b"".join(takewhile(is_in_head, lines)).decode("latin-1")
        self._length_of_code = dlc2len
        parser = TRCReader(io.StringIO(head))
        self._parser = parser
        try:
            parser._extract_header()
        except (ValueError, OverflowError):
            self.damage.append("its header is damaged")
        if parser.file_version is TRCFileVersion.UNKNOWN and _NEWER_TRC.search(head):
            parser._parse_cols = lambda _: None
            self.damage.append("its file version is unknown")
        version = "".join(filter(str.isdigit, parser.file_version.name))
        self._columns = _TRC_COLUMNS.get(version, parser.columns)
        self._has_direction = version not in ("", "10")
        start_s = parser._start_time
        parser._start_time = 0.0
        if start_s >= OLDEST_WALL_S:
            return round(start_s * 1e6) * 1000
        return None

    def _frame(self, line: bytes) -> LogFrame | None:
        text = line.decode("ascii").strip()
        if text.startswith(";"):
            return None
        columns = tuple(text.split(maxsplit=self._parser._num_columns))
        if self._is_error(columns):
            time_ms = float(columns[self._columns["O"]])
            time_ns = round(time_ms * 1_000) * 1_000
            channel = "1"
            if "B" in self._columns:
                channel = columns[self._columns["B"]]
            received = True if self._has_direction else None
            return checked(LogFrame(time_ns, error_frame(), received, channel))
        message = self._parser._parse_cols(columns)
        if message is None:
            return None
        if message.is_fd:  # other formats have the length instead of its code
            message.dlc = self._length_of_code(message.dlc)
        found = frame_of(message)
        time_ns = round(found.time_ns, -3)
        received = found.received if self._has_direction else None
        return found._replace(time_ns=time_ns, received=received)

    def _is_error(self, columns: Sequence[str]) -> bool:
        """Return True for the line of an error frame, which python-can does not read."""
        place = self._columns.get("T")
        if place is None or place >= len(columns):
            return False
        return columns[place] in ("ERROR", "Error", "ER")
