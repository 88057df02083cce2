"""Finds the frames of a stream by brute force, from their definition.

Imports nothing of the tested package. A frame has a header of four bytes, one of four forms
(length, covered bytes, position of the CRC) and a matching CRC-32. The search begins at the
earliest position and finds no overlapping frames. If two forms match at one position, the shorter
one counts.
"""

import random
from collections.abc import Iterable
from functools import cache
from typing import NamedTuple

from specification import FORM_ROWS, FormRow

LONGEST_OF = {b"KODL": 40, b"KODI": 44}
SHORTEST_FIRST = sorted(FORM_ROWS, key=lambda row: row.length)
LONG_RUNS = frozenset({0x00, 0x80, 0xC0, 0xE0, 0xF0, 0xF8, 0xFC, 0xFE, 0xFF})
COUNTED = [
    "live_v4",
    "live_legacy",
    "info_v4",
    "info_legacy",
    "headers",
    "crc_errors",
    "unknown_kinds",
    "dropped_noise",
    "dropped_crc",
    "dropped_unknown_kind",
    "dropped_incomplete",
    "long_run_bytes",
    "longer_crcs",
]


def _shift_eight(remainder: int) -> int:
    for _ in range(8):
        remainder = remainder >> 1 ^ (0xEDB88320 if remainder & 1 else 0)
    return remainder


_TABLE = [_shift_eight(byte) for byte in range(256)]


def crc32(data: bytes) -> int:
    """Return the CRC-32 (ISO-HDLC): polynomial EDB88320h, start and final XOR all ones."""
    remainder = 0xFFFFFFFF
    for byte in data:
        remainder = remainder >> 8 ^ _TABLE[(remainder ^ byte) & 0xFF]
    return remainder ^ 0xFFFFFFFF


def form_row(kind: str, layout: str) -> FormRow:
    return next(row for row in FORM_ROWS if (row.kind, row.layout) == (kind, layout))


def seal(row: FormRow, middle: bytes) -> bytes:
    """Return a valid frame with these bytes between header and CRC."""
    assert len(middle) == row.crc_at - 4, "the fields and FORM_ROWS of tests/specification differ"
    frame = row.header + middle
    return frame + crc32(frame[: row.covered]).to_bytes(4, "little")


def random_frame(row: FormRow, source: random.Random) -> bytes:
    return seal(row, source.randbytes(row.crc_at - 4))


def fits(stream: bytes, at: int, row: FormRow) -> bool:
    frame = stream[at : at + row.length]
    return (
        len(frame) == row.length
        and frame[:4] == row.header
        and crc32(frame[: row.covered])
        == int.from_bytes(frame[row.crc_at : row.crc_at + 4], "little")
    )


class Found(NamedTuple):
    offset: int
    kind: str
    layout: str
    raw: bytes

    @property
    def end(self) -> int:
        return self.offset + len(self.raw)


def frames_of(stream: bytes) -> list[Found]:
    """Return all frames of the whole stream, by trying every form at every byte."""
    found = []
    at = 0
    while at < len(stream):
        row = next((row for row in SHORTEST_FIRST if fits(stream, at, row)), None)
        if row is None:
            at += 1
        else:
            found.append(Found(at, row.kind, row.layout, stream[at : at + row.length]))
            at += row.length
    return found


def _gaps(size: int, found: Iterable[Found]) -> list[tuple[int, int]]:
    """Return begin and end of the stretches before, between and after the frames."""
    gaps = []
    begin = 0
    for frame in found:
        gaps.append((begin, frame.offset))
        begin = frame.end
    return [*gaps, (begin, size)]


def counters_of(stream: bytes) -> dict[str, int]:
    """Return the counters that are correct after the whole stream was fed and flushed.

    Every byte is classified by itself.
    """
    found = frames_of(stream)
    size = len(stream)
    count = dict.fromkeys(COUNTED, 0)
    for frame in found:
        count[f"{frame.kind}_{frame.layout}"] += 1
        count["headers"] += 1
    for begin, end in _gaps(size, found):
        failed_until = begin
        incomplete_until = begin
        unknown_until = begin
        cut_until = begin
        for at in range(begin, end):
            header = stream[at : at + 4]
            if header in LONGEST_OF:
                count["headers"] += 1
                if at + LONGEST_OF[header] <= size:
                    count["crc_errors"] += 1
                    is_longer = (
                        crc32(stream[at : at + 34]).to_bytes(4, "little")
                        == stream[at + 34 : at + 38]
                    )
                    count["longer_crcs"] += header == b"KODL" and is_longer
                    failed_until = max(failed_until, at + LONGEST_OF[header])
                else:
                    incomplete_until = size
            elif header[:3] == b"KOD" and len(header) == 4:
                count["unknown_kinds"] += 1
                unknown_until = at + 3
            elif header == b"KOD":
                cut_until = size
            if at < incomplete_until:
                count["dropped_incomplete"] += 1
            elif at < failed_until:
                count["dropped_crc"] += 1
            elif at < unknown_until:
                count["dropped_unknown_kind"] += 1
            elif at < cut_until:
                count["dropped_incomplete"] += 1
            else:
                count["dropped_noise"] += 1
            count["long_run_bytes"] += stream[at] in LONG_RUNS
    count["bytes"] = size
    count["live"] = count["live_v4"] + count["live_legacy"]
    count["info"] = count["info_v4"] + count["info_legacy"]
    count["dropped_bytes"] = size - sum(len(frame.raw) for frame in found)
    return count


def certain_at(stream: bytes) -> list[int]:
    """Return, for each frame, the number of received bytes after which the frame is certain.

    That is the frame's end. It is later if a header before it, outside any frame, could still
    become a frame of its longest form.
    """
    moments = []
    moment = 0
    begin = 0
    for frame in frames_of(stream):
        moment = max(moment, frame.end)
        for at in range(begin, frame.offset):
            moment = max(moment, at + LONGEST_OF.get(stream[at : at + 4], 0))
        moments.append(min(moment, len(stream)))
        begin = frame.end
    return moments


@cache
def ambiguous(kind: str) -> bytes:
    """Return a synthetic V4 frame whose beginning is a valid legacy frame.

    The legacy frame is 2 (live) or 3 (info) bytes shorter. Its CRC is in the place of V4's reserved
    bytes and the beginning of V4's CRC, and does not cover the last fields. So the search tries
    values of the last fields until the V4 CRC begins with the end of the legacy CRC.
    """
    legacy = form_row(kind, "legacy")
    v4 = form_row(kind, "v4")
    for number in range(1 << 24):
        digits = number.to_bytes(4, "little")
        free = legacy.crc_at - legacy.covered
        body = digits[free:].ljust(legacy.covered - 4, b"\0") + digits[:free]
        short = seal(legacy, body)
        long = seal(v4, short[4 : v4.crc_at])
        if long.startswith(short):
            return long
    raise AssertionError("no such frame")
