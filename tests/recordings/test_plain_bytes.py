"""Plain bytes of one ESC: every frame found by brute force is a row at its assumed time.

Any bytes may be between the frames.
"""

import random
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from capture_bench import samples
from esc.reference import Found, frames_of
from esc.streams import random_stream
from recordings import convert, dump_bytes
from specification import LIVE_STRUCT

from kontronik_can_gw.capture.format import EntryKind
from kontronik_can_gw.desk.recordings import bytes_input
from kontronik_can_gw.desk.recordings.bytes_input import BytesInput

pytestmark = pytest.mark.promise("tables")

NAMES = ("electrical_speed", "battery_voltage", "battery_current")
PERIOD_NS = 10_000_000
STREAMS: dict[str, Callable[[random.Random], bytes]] = {
    "frames and pieces of frames": lambda source: random_stream(source, 60),
    "long rubbish": lambda source: b"".join(
        random_stream(source, 8) + source.randbytes(3000) for _ in range(4)
    ),
    "headers without end": lambda source: (
        random_stream(source, 20) + b"KODL" * 900 + random_stream(source, 20)
    ),
    "nothing": lambda _: b"",
}


def assumed_times(found: list[Found]) -> list[int]:
    """Return the times of frames in a file of plain bytes, which has no times.

    There is one live frame in each period. An info frame is placed half a period before the frame
    that follows it, but not before the previous one.
    """
    times: list[int] = []
    lives = 0
    for frame in found:
        if frame.kind == "live":
            times.append(lives * PERIOD_NS)
            lives += 1
        else:
            before = times[-1] if times else 0
            times.append(max(before, lives * PERIOD_NS - PERIOD_NS // 2))
    return times


@pytest.mark.parametrize("kind", list(STREAMS))
@pytest.mark.parametrize("seed", range(6))
def test_rows_are_exactly_the_frames_found_by_brute_force(
    tmp_path: Path,
    kind: str,
    seed: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With small reads, a read may end anywhere in a frame or in rubbish."""
    source = random.Random(f"{kind} {seed}")
    monkeypatch.setattr(bytes_input, "CHUNK", source.choice([1, 7, 44, 100, 5000, 1 << 18]))
    stream = STREAMS[kind](source)
    path = tmp_path / "esc.bin"
    path.write_bytes(stream)
    dump = BytesInput(path)
    found = frames_of(stream)
    times = assumed_times(found)

    at = 0
    ends = {}
    for entry in dump.entries():
        if entry.kind == EntryKind.BYTES:
            assert entry.data
            at += len(entry.data)
            ends[at] = entry.time_ns
    assert at == len(stream)
    assert [ends[frame.end] for frame in found] == times

    expected = []
    for frame, time_ns in zip(found, times, strict=True):
        if frame.kind == "live":
            speed, volts, amperes, *_ = struct.unpack_from(LIVE_STRUCT, frame.raw, 4)
            expected.append((time_ns, (speed, volts / 100, amperes / 10)))
    names = [field.name for field in dump.fields]
    rows = samples(dump, [names.index(name) for name in NAMES])
    assert [(row.time_ns, row.values) for row in rows] == expected
    dropped = len(stream) - sum(len(frame.raw) for frame in found)
    told = [line.split()[0] for line in dump.damage if "outside of frames" in line]
    assert told == ([str(dropped)] if dropped else [])


def _time_of(line: str) -> float:
    """Return the time of a line of a candump log, in seconds."""
    return float(line[1:].partition(")")[0])


@pytest.mark.parametrize(
    ("start", "end"), [("3.3", "9"), ("0", "0"), (None, "7.7"), ("12", None), ("8", "8.001")]
)
def test_part_of_plain_bytes_has_the_frames_of_the_whole_at_its_times(
    tmp_path: Path,
    start: str | None,
    end: str | None,
) -> None:
    source = tmp_path / "esc.bin"
    source.write_bytes(dump_bytes(15, faults=True))
    options = []
    if start:
        options += ["--from", start]
    if end:
        options += ["--until", end]
    assert convert("-q", source, tmp_path / "all.log") == 0
    assert convert("-q", source, tmp_path / "part.log", *options) == 0
    lines = (tmp_path / "all.log").read_text().splitlines()
    low = float(start or 0)
    high = float(end or 1e9)
    wanted = [line for line in lines if low <= _time_of(line) <= high]
    assert len(lines) > len(wanted) > 0
    assert (tmp_path / "part.log").read_text().splitlines() == wanted
