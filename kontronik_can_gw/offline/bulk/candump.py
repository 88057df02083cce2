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
from kontronik_can_gw.offline.tables import DISORDER_NS

_US = 1_000_000
_MOST_SECONDS = 1 << 16
_LATEST_NS = 1 << 62
_HEX = np.frombuffer("".join(f"{byte:02X}" for byte in range(256)).encode(), "V2")
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
    for found in blocks:
        if isinstance(found, CanFrames):
            if not len(found.times):
                continue
            origin_ns = int(found.times[0]) if origin_ns is None else origin_ns
            since = found.times - origin_ns
            chosen = slice(*np.searchsorted(since, (low, high + 1)).tolist())
            since, latest = since[chosen], int(since[-1])
            text = lines.text(found.part(chosen), origin_ns)
            if len(since):
                count, last = count + len(since), int(since[-1])
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
        if text:
            if file is None:
                opened_file = opened()
                assert not isinstance(opened_file, Path)
                file = opened_file
            file.write(text)
        reached()
        if latest > high + DISORDER_NS:
            break
    return None if file is None else (count, last)


class Lines:
    """Of the messages of one layout, all sent on ``channel``."""

    def __init__(self, plans: Sequence[MessagePlan], channel: str = "can0") -> None:
        names = [f"{plan.can_id:08X}" if plan.extended else f"{plan.can_id:03X}" for plan in plans]
        heads = [f") {channel} {name}#{'#1' if plan.fd else ''}" for name, plan in zip(names, plans, strict=True)]
        # shorter ones are filled up with bytes 0, which no line has: they are taken out of the text at the end
        self._heads = np.array([head.encode() for head in heads] or [b""])
        self._lengths = np.array([plan.length for plan in plans], np.int64)
        self._width = max((plan.length for plan in plans), default=0)
        self._even = len({len(head) for head in heads}) <= 1 and len(set(self._lengths.tolist())) <= 1

    def text(self, frames: CanFrames, origin_ns: int) -> bytes:
        """The lines; times count from ``origin_ns``."""
        count, width = len(frames.times), self._width
        if not count:
            return b""
        us = (frames.times - (origin_ns - 500)) // 1000
        seconds, us = us // _US, us % _US
        stamps = _seconds(seconds)
        heads = self._heads.dtype
        line = np.empty(
            count,
            [
                *(("open", "V1"), ("s", stamps.dtype), ("dot", "V1"), ("ms", "V3"), ("us", "V3")),
                *(("head", f"V{heads.itemsize}"), ("data", "V2", (width,)), ("end", "V3")),
            ],
        )
        line["open"], line["dot"], line["end"] = np.void(b"("), np.void(b"."), np.void(b" T\n")
        line["s"] = stamps
        ms = us // 1000
        line["ms"] = _THREE[ms]
        line["us"] = _THREE[us - ms * 1000]
        line["head"] = self._heads.view(f"V{heads.itemsize}")[frames.messages]
        line["data"] = _HEX[frames.data[:, :width]]
        if self._even and seconds[0] >= 0 and len(str(seconds[0])) == len(str(seconds[-1])):
            return line.tobytes()
        short = self._lengths[frames.messages]
        beyond = np.arange(width) >= short[:, None]
        if beyond.any():
            line["data"][beyond] = np.void(b"\0\0")
        return line.tobytes().translate(None, b"\0")


def _seconds(seconds: NDArray[np.int64]) -> NDArray[np.bytes_]:
    """As text, filled up with bytes 0 behind; they do not go back."""
    first, last = int(seconds[0]), int(seconds[-1])
    if last - first <= _MOST_SECONDS:
        return np.array([b"%d" % number for number in range(first, last + 1)])[seconds - first]
    return np.array([b"%d" % number for number in seconds.tolist()])
