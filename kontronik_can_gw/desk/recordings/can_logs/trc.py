"""PEAK TRC."""

import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import BinaryIO

from kontronik_can_gw.desk.recordings.can_logs.record import (
    FD_LENGTHS,
    OLDEST_WALL_S,
    SECOND_NS,
    Damage,
    LogFrame,
    is_possible,
)
from kontronik_can_gw.desk.recordings.can_logs.text import head_of, lines_of
from kontronik_can_gw.frames import CanFrame

TRC_HEAD = re.compile(
    rb";\s*(?:\$FILEVERSION|\$STARTTIME|\$COLUMNS|Start time|#{8})", re.IGNORECASE
)
TRC_LINE = re.compile(
    rb"\s*\d{1,10}\)?[ \t]+\d{1,12}(?:\.\d{1,6})?[ \t]+"
    rb"(?:(?:DT|FD|FB|FE|BI|RR|ST|EC|ER|EV|Rx|Tx|\d{1,2})[ \t]+)*(?:[0-9A-Fa-f]{8}|[0-9A-Fa-f]{4})[ \t]"
)
"""How a line of any version begins."""
_TRC_COLUMNS = {
    "1.0": "N,O,I,l,D",
    "1.1": "N,O,d,I,l,D",
    "1.3": "N,O,B,d,I,R,l,D",
    "2.0": "N,O,T,I,d,l,D",
}
_TRC_NEWEST = "N,O,T,B,I,d,R,L,D"
_TRC_FRAMES = {b"DT": False, b"FD": True, b"FB": True, b"FE": True, b"BI": True}
_TRC_EVENTS = frozenset((b"ST", b"EC", b"ER", b"EV"))
_TRC_OLD_EVENTS = frozenset((b"Warng", b"Error", b"ErrCt", b"Event"))
_TRC_DAY0 = datetime(1899, 12, 30, tzinfo=UTC)


class TrcReader:
    """PEAK TRC, file versions 1.0, 1.1, 1.3, 2.0 and 2.1."""

    def __init__(self, file: BinaryIO, damage: Damage) -> None:
        self._file = file
        self._damage = damage
        self.wall_start_ns: int | None = None
        version, columns = "", ""
        for line in head_of(file):
            text = line.decode("latin-1").strip()
            if text and not text.startswith(";"):
                break
            key, _, value = text.partition("=")
            if key == ";$FILEVERSION":
                version = value.strip()
            elif key == ";$COLUMNS":
                columns = value.strip()
            elif key == ";$STARTTIME":
                self.wall_start_ns = _trc_start(value)
        file.seek(0)
        if not columns:
            newest = _TRC_NEWEST if version.startswith("2") else _TRC_COLUMNS["1.0"]
            columns = _TRC_COLUMNS.get(version, newest)
        self._columns = [column.strip() for column in columns.split(",")]
        self._at = {column: index for index, column in enumerate(self._columns)}

    def __iter__(self) -> Iterator[LogFrame]:
        damage, count = self._damage, len(self._columns)
        min_count = count - (self._columns[-1] == "D")
        for number, line in lines_of(self._file):
            words = line.split(None, count - 1)
            if not words or words[0][:1] == b";":
                continue
            try:
                if len(words) < min_count:
                    raise ValueError
                foreign = self._foreign(words)
                if foreign is not None:
                    damage.skip(foreign)
                    continue
                item = self._frame(words)
            except (ValueError, LookupError):  # of numbers, texts, kinds, lengths
                damage.line(number)
                continue
            yield item

    def _foreign(self, words: list[bytes]) -> str | None:
        """What a line is that is no data frame; None for one."""
        at = self._at
        kind = words[at["T"]] if "T" in at else b""
        is_whole = len(words) == len(self._columns)
        if kind == b"RR" or (not kind and is_whole and words[-1].strip().upper() == b"RTR"):
            return "remote frames"
        old_kind = words[at["d"]] if "d" in at and not kind else b""
        if kind in _TRC_EVENTS or old_kind in _TRC_OLD_EVENTS or words[at["I"]] == b"FFFFFFFF":
            return "other events"
        return None

    def _frame(self, words: list[bytes]) -> LogFrame:
        """The frame of a line. ValueError, LookupError."""
        at = self._at
        fd = _TRC_FRAMES[words[at["T"]]] if "T" in at else False
        direction = words[at["d"]] if "d" in at else b""
        milliseconds, _, fraction = words[at["O"]].partition(b".")
        if direction not in (b"", b"Rx", b"Tx") or len(fraction) > 6 or not milliseconds.isdigit():
            raise ValueError
        id_text = words[at["I"]]
        can_id, extended = int(id_text, 16), len(id_text) > 4
        size = int(words[at["l"]]) if "l" in at else FD_LENGTHS[int(words[at["L"]])]
        is_whole = len(words) == len(self._columns)
        data = bytes.fromhex(words[-1].decode("ascii")) if is_whole else b""
        if len(data) != size or not is_possible(can_id, extended, size, fd):
            raise ValueError
        return LogFrame(
            int(milliseconds) * 1_000_000 + int(fraction.ljust(6, b"0")),
            CanFrame(can_id, data, extended, fd),
            direction == b"Rx",
            words[at["B"]].decode("ascii") if "B" in at else "1",
        )


def _trc_start(text: str) -> int | None:
    """Unix time in ns of days since 1899-12-30; None where it is none, or before 1990."""
    try:
        moment = _TRC_DAY0 + timedelta(days=float(text))
    except (ValueError, OverflowError):
        return None
    start = round((moment - datetime(1970, 1, 1, tzinfo=UTC)) / timedelta(microseconds=1)) * 1000
    return start if start >= OLDEST_WALL_S * SECOND_NS else None
