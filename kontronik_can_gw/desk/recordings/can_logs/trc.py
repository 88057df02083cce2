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
from kontronik_can_gw.desk.recordings.can_logs.text import HEAD_LINES, LONGEST_LINE, lines_of
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
_TRC_FRAMES = {"DT": False, "FD": True, "FB": True, "FE": True, "BI": True}
_TRC_EVENTS = frozenset(("ST", "EC", "ER", "EV"))
_TRC_OLD_EVENTS = frozenset((b"Warng", b"Error", b"ErrCt", b"Event"))
_TRC_DAY0 = datetime(1899, 12, 30, tzinfo=UTC)


class TrcReader:
    """PEAK TRC, file versions 1.0, 1.1, 1.3, 2.0 and 2.1."""

    def __init__(self, file: BinaryIO, damage: Damage) -> None:
        self._file = file
        self._damage = damage
        self.wall_start_ns: int | None = None
        version, columns = "", ""
        for _, line in zip(
            range(HEAD_LINES), iter(lambda: file.readline(LONGEST_LINE), b""), strict=False
        ):
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
            columns = _TRC_COLUMNS.get(
                version, _TRC_NEWEST if version.startswith("2") else _TRC_COLUMNS["1.0"]
            )
        self._columns = [column.strip() for column in columns.split(",")]

    def __iter__(self) -> Iterator[LogFrame]:
        damage = self._damage
        columns = self._columns
        at = {column: index for index, column in enumerate(columns)}
        count = len(columns)
        has_data = columns[-1:] == ["D"]
        least = count - 1 if has_data else count
        o, i = at.get("O", 1), at.get("I", 2)
        t, d, bus = at.get("T"), at.get("d"), at.get("B")
        size_at, is_length = (at["l"], True) if "l" in at else (at.get("L", count - 2), False)
        for number, line in lines_of(self._file):
            words = line.split(None, count - 1)
            if not words or words[0][:1] == b";":
                continue
            try:
                if len(words) < least:
                    raise ValueError
                kind = "DT" if t is None else words[t].decode("ascii")
                direction = b"" if d is None else words[d]
                if kind == "RR" or (
                    t is None and len(words) == count and words[-1].strip().upper() == b"RTR"
                ):
                    damage.skip("remote frames")
                    continue
                if kind in _TRC_EVENTS or (t is None and direction in _TRC_OLD_EVENTS):
                    damage.skip("other events")
                    continue
                if kind not in _TRC_FRAMES or direction not in (b"", b"Rx", b"Tx"):
                    raise ValueError
                id_text = words[i]
                if id_text == b"FFFFFFFF":
                    damage.skip("other events")
                    continue
                fd = _TRC_FRAMES[kind]
                milliseconds, _, fraction = words[o].partition(b".")
                if len(fraction) > 6 or not milliseconds.isdigit():
                    raise ValueError
                time_ns = int(milliseconds) * 1_000_000 + int(fraction.ljust(6, b"0"))
                can_id = int(id_text, 16)
                extended = len(id_text) > 4
                size = int(words[size_at])
                if not is_length:
                    size = FD_LENGTHS[size]
                data = bytes.fromhex(words[-1].decode("ascii")) if len(words) == count else b""
                if len(data) != size or not is_possible(can_id, extended, size, fd):
                    raise ValueError
                channel = "1" if bus is None else words[bus].decode("ascii")
            except (ValueError, IndexError):  # of numbers, texts, lengths
                damage.line(number)
                continue
            yield LogFrame(
                time_ns, CanFrame(can_id, data, extended, fd), direction == b"Rx", channel
            )


def _trc_start(text: str) -> int | None:
    """Unix time in ns of days since 1899-12-30; None where it is none, or before 1990."""
    try:
        moment = _TRC_DAY0 + timedelta(days=float(text))
    except (ValueError, OverflowError):
        return None
    start = round((moment - datetime(1970, 1, 1, tzinfo=UTC)) / timedelta(microseconds=1)) * 1000
    return start if start >= OLDEST_WALL_S * SECOND_NS else None
