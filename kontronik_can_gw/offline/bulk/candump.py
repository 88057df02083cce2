"""CAN frames in columns -> lines of a candump log, as ``can_logs.writer`` writes them one by one.

(1.010000) can0 688#0000008A09000001 T
"""

import io
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from kontronik_can_gw.dbc_output.layout import MessagePlan
from kontronik_can_gw.offline.bulk.frames import Found
from kontronik_can_gw.offline.bulk.sending import CanFrames
from kontronik_can_gw.offline.can_logs import CanLogWriter
from kontronik_can_gw.offline.can_logs.record import SECOND_NS
from kontronik_can_gw.offline.tables import DISORDER_NS

_US = 1_000_000
_MOST_SECONDS = 1 << 16
_LATEST_NS = 1 << 62
_TURN = 64
_Records = NDArray[np.void]
_HEX = np.frombuffer("".join(f"{pair & 255:02X}{pair >> 8:02X}" for pair in range(1 << 16)).encode(), np.uint32)
"""Four digits of each pair of bytes, as a little-endian number has them."""
_THREE = np.frombuffer("".join(f"{number:03d}" for number in range(1000)).encode(), "V3")


def write(
    blocks: Iterator[Found],
    plans: Sequence[MessagePlan],
    opened: Callable[[], IO[bytes] | Path],
    start_ns: int | None,
    end_ns: int | None,
    reached: Callable[[], None],
) -> tuple[int, int] | None:
    """Write the frames from ``start_ns`` to ``end_ns`` after the first one; how many, and when the last one was.

    None where there is none; then nothing was opened. ``reached`` is called from time to time.
    """
    lines = Lines(plans)
    single = io.BytesIO()
    write_one = CanLogWriter(single, "candump", None).write
    file: IO[bytes] | None = None
    origin_ns: int | None = None
    low, high = 0 if start_ns is None else start_ns, _LATEST_NS if end_ns is None else end_ns
    count, last, latest = 0, 0, 0
    text: bytes | memoryview
    for number, found in enumerate(blocks):
        if isinstance(found, CanFrames):
            if not len(found):
                continue
            origin_ns = found.first_ns if origin_ns is None else origin_ns
            latest = found.last_ns - origin_ns
            chosen = found.between(origin_ns + low, origin_ns + high)
            text = lines.text(chosen, origin_ns)
            if len(chosen):
                count, last = count + len(chosen), chosen.last_ns - origin_ns
        else:
            for time_ns, frame, received in found:
                origin_ns = time_ns if origin_ns is None else origin_ns
                latest = time_ns - origin_ns
                if low <= latest <= high:
                    write_one(latest, frame, received)
                    count, last = count + 1, latest
            text = single.getvalue()
            single.seek(0)
            single.truncate()
        if len(text):
            if file is None:
                opened_file = opened()
                assert not isinstance(opened_file, Path)
                file = opened_file
            file.write(text)
        if isinstance(found, CanFrames) or not number % _TURN:
            reached()
        if latest > high + DISORDER_NS:
            break
    reached()
    return None if file is None else (count, last)


class Lines:
    """Of the messages of one layout, all sent on ``channel``."""

    def __init__(self, plans: Sequence[MessagePlan], channel: str = "can0") -> None:
        self._heads = [f") {channel} {_name(plan)}#{'#1' if plan.fd else ''}".encode("ascii") for plan in plans]
        self._forms: dict[tuple[int, int], _Records] = {}
        """By message and width of the time: lines whose constant parts are written; they are used again and again."""

    def text(self, frames: CanFrames, origin_ns: int) -> bytes | memoryview:
        """The lines; times count from ``origin_ns``."""
        if not len(frames):
            return b""
        first, last = _second(frames.first_ns - origin_ns), _second(frames.last_ns - origin_ns)
        if (digits := len(str(last))) > len(str(first)):
            border = origin_ns + 10 ** (digits - 1) * SECOND_NS - 500  # from there on seconds have a digit more
            before, behind = frames.between(origin_ns, border - 1), frames.between(border, frames.last_ns)
            return bytes(self.text(before, origin_ns)) + bytes(self.text(behind, origin_ns))
        seconds = _Seconds(first, last, digits)
        stamps: dict[int, _Records] = {}
        lines = []
        for part in frames.parts:
            if id(part.times) not in stamps:
                stamps[id(part.times)] = _stamps(part.times - origin_ns, seconds)
            lines.append(self._lines(part.message, stamps[id(part.times)], part.data))
        return _merged(lines, [part.places for part in frames.parts])

    def _lines(self, message: int, stamps: _Records, data: NDArray[np.uint8]) -> _Records:
        count, length = data.shape
        form = self._forms.get((message, stamps.itemsize))
        if form is None or len(form) < count:
            head = self._heads[message]
            form = np.empty(
                count, [("stamp", stamps.dtype), ("head", f"V{len(head)}"), ("data", f"V{2 * length}"), ("end", "V3")]
            )
            form["head"], form["end"] = np.void(head), np.void(b" T\n")
            self._forms[message, stamps.itemsize] = form
        made = form[:count]
        even = data if length % 2 == 0 else np.pad(data, ((0, 0), (0, 1)))
        made["stamp"] = stamps
        made["data"] = _HEX[np.ascontiguousarray(even).view(np.uint16)].view(f"V{even.shape[1] * 2}")[:, 0]
        return made.view(f"V{made.itemsize}")


def _name(plan: MessagePlan) -> str:
    return f"{plan.can_id:08X}" if plan.extended else f"{plan.can_id:03X}"


def _second(since_ns: int) -> int:
    return (since_ns + 500) // SECOND_NS


class _Seconds:
    """Texts of whole seconds from ``first`` to ``last``, which all have so many digits."""

    def __init__(self, first: int, last: int, digits: int) -> None:
        self.digits = digits
        self._first = first
        self._texts: _Records | None = None
        if last - first <= _MOST_SECONDS:
            self._texts = self._made(list(range(first, last + 1)))

    def of(self, seconds: NDArray[np.int64]) -> _Records:
        """The text of each."""
        return self._made(seconds.tolist()) if self._texts is None else self._texts[seconds - self._first]

    def _made(self, numbers: list[int]) -> _Records:
        return np.frombuffer("".join(map(str, numbers)).encode("ascii"), f"V{self.digits}")


def _stamps(since_ns: NDArray[np.int64], texts: _Seconds) -> _Records:
    """An opening bracket and the time of each line."""
    us = (since_ns + 500) // 1000
    seconds = us // _US
    us = (us - seconds * _US).astype(np.uint32)
    ms = us // 1000
    made = np.empty(len(us), [("open", "V1"), ("s", f"V{texts.digits}"), ("dot", "V1"), ("ms", "V3"), ("us", "V3")])
    made["open"], made["dot"] = np.void(b"("), np.void(b".")
    made["s"] = texts.of(seconds)
    made["ms"] = _THREE[ms]
    made["us"] = _THREE[us - ms * 1000]
    return made.view(f"V{made.itemsize}")


def _merged(lines: list[_Records], places: list[NDArray[np.int64]]) -> memoryview:
    """All lines, each at its place among all."""
    count = len(lines)
    if all(len(each) == len(lines[0]) for each in lines) and all(
        (where == np.arange(number, count * len(where), count)).all() for number, where in enumerate(places)
    ):  # by turns
        rows = np.empty(len(lines[0]), [(str(number), each.dtype) for number, each in enumerate(lines)])
        for number, each in enumerate(lines):
            rows[str(number)] = each
        return rows.view(np.uint8).data
    lengths = [each.itemsize for each in lines]
    if len(set(lengths)) == 1:
        merged = np.empty(sum(len(each) for each in lines), lines[0].dtype)
        for each, where in zip(lines, places, strict=True):
            merged[where] = each
        return merged.view(np.uint8).data
    widths = np.empty(sum(len(each) for each in lines), np.int64)
    for length, where in zip(lengths, places, strict=True):
        widths[where] = length
    ends = widths.cumsum()
    text = np.empty(int(ends[-1]), np.uint8)
    for each, length, where in zip(lines, lengths, places, strict=True):
        anywhere = np.ndarray(len(text) - length + 1, each.dtype, text, 0, (1,))  # a line may begin at any byte
        anywhere[ends[where] - length] = each
    return text.data
