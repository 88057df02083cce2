"""The deframer, compared with the brute-force search of reference.py.

The streams are synthetic except for the two recorded frames.
"""

import random
import zlib
from collections.abc import Callable, Iterable
from itertools import product

import pytest
import specification
from hypothesis import example, given, settings
from hypothesis import strategies as st

from kontronik_can_gw.esc.kontronik import deframer
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.deframer import Deframer, DeframerCounters, Frame
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData

from .reference import certain_at, counters_of, form_row, frames_of
from .streams import random_chunks, seeds, streams

pytestmark = pytest.mark.promise("brute-force")

PROPERTY = settings(deadline=None, max_examples=100, database=None)


def run(chunks: Iterable[bytes]) -> tuple[list[Frame], Deframer]:
    """Feed and flush. After every step each byte must be counted, and at most 43 may be held."""
    deframer = Deframer()
    frames: list[Frame] = []
    fed = 0
    for chunk in chunks:
        frames += deframer.feed(chunk)
        fed += len(chunk)
        check_account(deframer, frames, fed)
    frames += deframer.flush()
    check_account(deframer, frames, fed)
    assert deframer.pending == 0
    return frames, deframer


def check_account(deframer: Deframer, frames: list[Frame], fed: int) -> None:
    counters = deframer.counters
    in_frames = sum(frame.form.length for frame in frames)
    assert counters.bytes == fed == in_frames + counters.dropped_bytes + deframer.pending
    assert 0 <= deframer.pending <= 43
    assert counters.live + counters.info == len(frames)


def one_by_one(stream: bytes) -> list[bytes]:
    return [stream[at : at + 1] for at in range(len(stream))]


def described(frames: Iterable[Frame], stream: bytes) -> list[tuple[int, str, str, bytes]]:
    """Describe frames as the reference does. Their encoded data must give the fields' bytes."""
    result = []
    for frame in frames:
        raw = stream[frame.offset : frame.offset + frame.form.length]
        kind = "info" if frame.form.is_info else "live"
        row = form_row(kind, frame.layout.value)
        assert encode(frame.data, frame.layout)[: row.body_end] == raw[: row.body_end]
        result.append((frame.offset, kind, frame.layout.value, raw))
    return result


def check_against_the_reference(stream: bytes, source: random.Random) -> None:
    for chunks in ([stream], one_by_one(stream), random_chunks(stream, source)):
        frames, deframer = run(chunks)
        assert described(frames, stream) == [tuple(found) for found in frames_of(stream)]
        assert deframer.counters.as_dict() == counters_of(stream)


def state_of(deframer: Deframer) -> tuple[dict[str, int], int]:
    return deframer.counters.as_dict(), deframer.pending


# ---- comparison with the brute-force search


@settings(PROPERTY, max_examples=300)
@given(stream=streams, seed=seeds)
@example(b"", 0)
@example(b"KOD", 0)
@example(b"KODKODL", 0)
@example(b"KODI" + bytes(37), 0)
def test_frames_are_those_of_the_brute_force_search_in_any_chunks(stream: bytes, seed: int) -> None:
    check_against_the_reference(stream, random.Random(seed))


# ---- the moment at which a frame is returned


@PROPERTY
@given(stream=streams, seed=seeds)
def test_state_at_every_moment_depends_on_the_bytes_alone(stream: bytes, seed: int) -> None:
    """A frame is returned as soon as it is certain. Counters do not depend on the chunks."""
    by_byte = Deframer()
    states = [state_of(by_byte)]
    moments = []
    for number, byte in enumerate(one_by_one(stream), start=1):
        moments += [number] * len(by_byte.feed(byte))
        states.append(state_of(by_byte))
    moments += [len(stream)] * len(by_byte.flush())
    assert moments == certain_at(stream)
    by_chunk = Deframer()
    fed = 0
    for chunk in random_chunks(stream, random.Random(seed)):
        by_chunk.feed(chunk)
        fed += len(chunk)
        assert state_of(by_chunk) == states[fed]


# ---- flush, and types of input


@PROPERTY
@given(parts=st.lists(streams, max_size=4), seed=seeds)
def test_deframer_is_like_new_after_flush(parts: list[bytes], seed: int) -> None:
    source = random.Random(seed)
    deframer = Deframer()
    total = dict.fromkeys(DeframerCounters().as_dict(), 0)
    base = 0

    def moved(frames: list[Frame]) -> list[Frame]:
        return [frame._replace(offset=frame.offset - base) for frame in frames]

    for part in parts:
        fresh = Deframer()
        for chunk in random_chunks(part, source):
            assert moved(deframer.feed(chunk)) == fresh.feed(chunk)
            assert deframer.pending == fresh.pending
        assert moved(deframer.flush()) == fresh.flush()
        for name, value in fresh.counters.as_dict().items():
            total[name] += value
        assert state_of(deframer) == (total, 0)
        base += len(part)


# ---- hostile input

SIZE = 1 << 16
HOSTILE = (
    b"KOD",
    b"KODL",
    b"KODI",
    b"KODLKODI",
    b"K",
    b"KO",
    b"\0",
    b"\xff",
    b"KODI" + bytes(39),
    random.Random(16).randbytes(SIZE),
)


@pytest.mark.parametrize("unit", HOSTILE, ids=lambda unit: repr(unit[:9]))
@pytest.mark.parametrize(
    "cut",
    [
        one_by_one,
        lambda stream: [stream],
    ],
    ids=["bytes", "whole"],
)
def test_work_on_hostile_input_is_linear(
    unit: bytes,
    cut: Callable[[bytes], list[bytes]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calculated: list[int] = []

    def counted(data: bytes, crc: int = 0) -> int:
        calculated.append(len(data))
        return zlib.crc32(data, crc)

    monkeypatch.setattr(deframer, "crc32", counted)
    work = []
    for size in (SIZE // 4, SIZE):
        calculated.clear()
        repeated = unit * (size // len(unit) + 1)
        frames, _ = run(cut(repeated[:size]))
        assert not frames
        work.append((len(calculated), sum(calculated)))
    (calls, crc_bytes), (more_calls, more_bytes) = work
    assert more_calls <= 4 * (calls + 50)
    assert more_bytes <= 4 * (crc_bytes + 50 * 40)
    assert more_calls <= 4 * (SIZE // 4 + 1), "four CRCs for a header of four bytes at most"


# ---- diagnosis


def noise_without_kod(size: int) -> bytes:
    return random.Random(18).randbytes(size).replace(b"K", b"J")


_SPOILT = bytearray(specification.RECORDED_LIVE)
_SPOILT[20] ^= 1
BAD = bytes(_SPOILT)
_BARE = specification.RECORDED_LIVE[:34]
LONGER = _BARE + zlib.crc32(_BARE).to_bytes(4, "little")
DIAGNOSES: list[tuple[str, list[bytes]]] = [
    ("no bytes: ", [b""]),
    (
        "bytes but never KOD: ",
        [
            noise_without_kod(1),
            noise_without_kod(63),
            noise_without_kod(64),
            noise_without_kod(1000),
        ],
    ),
    (
        "bytes but never KOD: ",
        [
            bytes(63),
            b"\xfe" * 899 + b"J" * 101,
        ],
    ),
    (
        "bytes but never KOD, in long runs",
        [
            bytes(64),
            b"\xfe" * 900 + b"J" * 100,
        ],
    ),
    (
        "headers but no valid CRC: ",
        [
            BAD * 5,
            b"KODX" + noise_without_kod(500) + BAD * 5,
        ],
    ),
    (
        "live frames of 38 bytes whose CRC covers 34 bytes",
        [
            LONGER * 3,
            BAD * 3 + LONGER * 2 + bytes(8),
        ],
    ),
    ("KOD frames of unknown kind", [(b"KODX" + bytes(36)) * 10]),
    (
        "a header but no whole frame yet",
        [
            specification.RECORDED_LIVE[:4],
            specification.RECORDED_LIVE[:20],
            specification.RECORDED_LIVE[:30],
            specification.RECORDED_LIVE[:37],
            noise_without_kod(10) + specification.RECORDED_LIVE[:4],
        ],
    ),
]
BEFORE = (
    b"",
    encode(LiveData(), WireLayout.V4),
    encode(InfoData(), WireLayout.V4),
    BAD + b"KODX",
    bytes(64),
)


@pytest.mark.promise("esc-diagnosis")
@pytest.mark.parametrize(("expected", "received"), DIAGNOSES)
def test_bytes_without_a_frame_have_a_diagnosis(expected: str, received: list[bytes]) -> None:
    for before, stream in product(BEFORE, received):
        deframer = Deframer()
        since = deframer.counters.copy()
        found = deframer.feed(before) + deframer.flush()
        assert (deframer.counters.diagnosis(since) is None) is bool(found)
        since = deframer.counters.copy()
        deframer.feed(stream)
        assert str(deframer.counters.diagnosis(since)).startswith(expected)
        deframer.flush()
        assert str(deframer.counters.diagnosis(since)).startswith(expected)


@pytest.mark.promise("layouts")
def test_live_frames_whose_crc_covers_34_bytes_are_counted_and_not_accepted() -> None:
    """One other receiver takes them. No recording is public."""
    deframer = Deframer()
    assert deframer.feed(LONGER * 60) + deframer.flush() == []
    assert deframer.counters.longer_crcs == 59  # the last one may be a longer frame's beginning
    recorded = Deframer()
    assert len(recorded.feed(specification.RECORDED_LIVE * 60 + bytes(8))) == 60
    assert recorded.counters.longer_crcs == 0
