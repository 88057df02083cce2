"""Plain bytes of one ESC: every frame that brute force finds is a row at its assumed time, whatever stands between the frames."""

import random
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from esc.reference import Found, frames_of
from esc.sheet import LIVE_STRUCT
from esc.streams import random_stream
from recordings import convert, dump_bytes

from kontronik_can_gw.capture.format import Kind
from kontronik_can_gw.desk.recordings import bytes_input
from kontronik_can_gw.desk.recordings.bytes_input import BytesInput

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
    """A live frame each period, an info frame half a period before the next live frame, never back in time."""
    times: list[int] = []
    lives = 0
    for frame in found:
        if frame.kind == "live":
            times.append(lives * PERIOD_NS)
            lives += 1
        else:
            times.append(max(times[-1] if times else 0, lives * PERIOD_NS - PERIOD_NS // 2))
    return times


@pytest.mark.parametrize("kind", list(STREAMS))
@pytest.mark.parametrize("seed", range(6))
def test_rows_are_exactly_the_frames_found_by_brute_force(
    tmp_path: Path, kind: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However the file is read: small reads put every limit of a read anywhere in a frame and in rubbish."""
    source = random.Random(f"{kind} {seed}")
    monkeypatch.setattr(bytes_input, "CHUNK", source.choice([1, 7, 44, 100, 5000, 1 << 18]))
    stream = STREAMS[kind](source)
    (path := tmp_path / "esc.bin").write_bytes(stream)
    dump = BytesInput(path)
    found = frames_of(stream)
    times = assumed_times(found)

    at, ends = 0, {}
    for entry in dump.entries():
        if entry.kind == Kind.BYTES:
            assert entry.data
            at += len(entry.data)
            ends[at] = entry.time_ns
    assert at == len(stream)
    assert [ends[frame.end] for frame in found] == times

    lives = [
        (time_ns, struct.unpack_from(LIVE_STRUCT, frame.raw, 4))
        for frame, time_ns in zip(found, times, strict=True)
        if frame.kind == "live"
    ]
    names = [field.name for field in dump.fields]
    rows = list(dump.samples([names.index(name) for name in NAMES]))
    assert [row.values for row in rows] == [
        (data[0], data[1] / 100, data[2] / 10) for _, data in lives
    ]
    assert [row.time_ns for row in rows] == [time_ns for time_ns, _ in lives]
    dropped = len(stream) - sum(len(frame.raw) for frame in found)
    told = [line.split()[0] for line in dump.damage if "belong to no frame" in line]
    assert told == ([str(dropped)] if dropped else [])


@pytest.mark.parametrize(
    ("start", "end"), [("3.3", "9"), ("0", "0"), (None, "7.7"), ("12", None), ("8", "8.001")]
)
def test_a_part_of_plain_bytes_has_the_frames_of_the_whole_at_its_times(
    tmp_path: Path, start: str | None, end: str | None
) -> None:
    source = tmp_path / "esc.bin"
    source.write_bytes(dump_bytes(15, faults=True))
    options = [*(["--from", start] if start else []), *(["--until", end] if end else [])]
    assert convert("-q", source, tmp_path / "all.log") == 0
    assert convert("-q", source, tmp_path / "part.log", *options) == 0
    lines = (tmp_path / "all.log").read_text().splitlines()
    low, high = float(start or 0), float(end or 1e9)
    wanted = [line for line in lines if low <= float(line[1:].partition(")")[0]) <= high]
    assert len(lines) > len(wanted) > 0
    assert (tmp_path / "part.log").read_text().splitlines() == wanted
