"""Byte stream -> frames, held against the brute force of reference.py. Streams are synthetic but for the two recorded frames."""

import random
import zlib
from collections.abc import Callable, Iterable

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from kontronik_can_gw.esc.kontronik import (
    Counters,
    Deframer,
    Frame,
    InfoData,
    Kind,
    Layout,
    LiveData,
    deframer,
    encode,
)

from . import sheet
from .reference import certain_at, counters_of, frames_of
from .sheet import FORM_ROWS
from .streams import Uart, random_chunks, random_stream, seeds, streams

PROPERTY = settings(deadline=None, max_examples=100, database=None)


SILENCE = "no bytes: "
FAILED_CRC = "headers but no valid CRC: "
PARTIAL = "a header but no whole frame yet"
UNKNOWN_KIND = "KOD frames of unknown kind"
OTHER_PROTOCOL = "bytes but never KOD: "
SLOWER_LINE = "bytes but never KOD, in long runs"


def run(chunks: Iterable[bytes]) -> tuple[list[Frame], Deframer]:
    """Feed and flush; after every step each byte must be accounted for and no more than 43 be held."""
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


def whole(stream: bytes) -> list[bytes]:
    return [stream]


both_cuts = pytest.mark.parametrize("cut", [one_by_one, whole])


def described(frames: Iterable[Frame], stream: bytes) -> list[tuple[int, str, str, bytes]]:
    """Frames in the words of the reference; the data encoded again must give the fields' bytes."""
    result = []
    for frame in frames:
        raw = stream[frame.offset : frame.offset + frame.form.length]
        again = encode(frame.data, frame.layout)
        row = next(
            row
            for row in FORM_ROWS
            if (row.kind, row.layout) == (frame.kind.value, frame.layout.value)
        )
        assert again[: row.body_end] == raw[: row.body_end]
        result.append((frame.offset, frame.kind.value, frame.layout.value, raw))
    return result


def check_against_the_reference(stream: bytes, chunks: Iterable[bytes]) -> None:
    frames, deframer = run(chunks)
    assert described(frames, stream) == [tuple(found) for found in frames_of(stream)]
    assert deframer.counters.as_dict() == counters_of(stream)


def state_of(deframer: Deframer) -> tuple[dict[str, int], int]:
    return deframer.counters.as_dict(), deframer.pending


# ---- against the brute force


@settings(PROPERTY, max_examples=150)
@given(stream=streams, seed=seeds)
@example(b"", 0)
@example(b"KOD", 0)
@example(b"KODKODL", 0)
@example(b"KODI" + bytes(37), 0)
def test_a_stream_gives_what_brute_force_finds_however_it_is_cut(stream: bytes, seed: int) -> None:
    for chunks in (whole(stream), one_by_one(stream), random_chunks(stream, random.Random(seed))):
        check_against_the_reference(stream, chunks)


@pytest.mark.parametrize("seed", range(8))
def test_long_damaged_streams_give_what_brute_force_finds_however_they_are_cut(seed: int) -> None:
    source = random.Random(seed)
    found = 0
    for _ in range(25):
        stream = random_stream(source, pieces=40)
        found += len(frames_of(stream))
        check_against_the_reference(stream, [stream])
        check_against_the_reference(stream, one_by_one(stream))
        check_against_the_reference(stream, random_chunks(stream, source))
    assert found > 250, "streams without frames would prove little"


# ---- when a frame comes out


@PROPERTY
@given(stream=streams)
def test_a_frame_is_emitted_as_soon_as_no_continuation_could_take_it_away(stream: bytes) -> None:
    deframer = Deframer()
    moments: list[int] = []
    for number, byte in enumerate(one_by_one(stream), start=1):
        moments += [number] * len(deframer.feed(byte))
    moments += [len(stream)] * len(deframer.flush())
    assert moments == certain_at(stream)


@PROPERTY
@given(stream=streams, seed=seeds)
def test_counters_and_pending_are_the_same_at_every_moment_whatever_the_chunks(
    stream: bytes, seed: int
) -> None:
    """Not only after flush: what was counted depends on the bytes fed so far, not on how they were cut."""
    by_byte = Deframer()
    states = [state_of(by_byte)]
    for byte in one_by_one(stream):
        by_byte.feed(byte)
        states.append(state_of(by_byte))
    by_chunk = Deframer()
    fed = 0
    for chunk in random_chunks(stream, random.Random(seed)):
        by_chunk.feed(chunk)
        fed += len(chunk)
        assert state_of(by_chunk) == states[fed]


# ---- flush, and what may be fed


@PROPERTY
@given(parts=st.lists(streams, max_size=4), seed=seeds)
def test_after_a_flush_the_deframer_is_as_new(parts: list[bytes], seed: int) -> None:
    source = random.Random(seed)
    deframer = Deframer()
    total = dict.fromkeys(Counters().as_dict(), 0)
    base = 0
    for part in parts:
        fresh = Deframer()
        fed = 0
        for chunk in random_chunks(part, source):
            frames = deframer.feed(chunk)
            fed += len(chunk)
            assert [frame._replace(offset=frame.offset - base) for frame in frames] == fresh.feed(
                chunk
            )
            assert state_of(deframer) == (
                {n: total[n] + value for n, value in state_of(fresh)[0].items()},
                fresh.pending,
            )
        assert [
            frame._replace(offset=frame.offset - base) for frame in deframer.flush()
        ] == fresh.flush()
        assert fresh.counters.as_dict() == counters_of(part)
        total = {name: total[name] + value for name, value in fresh.counters.as_dict().items()}
        assert state_of(deframer) == (total, 0)
        base += len(part)


# ---- counters


# ---- hostile input

SIZE = 1 << 18
HOSTILE = {
    "KOD": b"KOD",
    "KODL": b"KODL",
    "KODI": b"KODI",
    "KODLKODI": b"KODLKODI",
    "K": b"K",
    "KO": b"KO",
    "zeros": b"\0",
    "ones": b"\xff",
    "KODI and 39 zeros": b"KODI" + bytes(39),
    "random": random.Random(16).randbytes(SIZE),
}


class Work:
    """Counts the CRCs that are calculated and the bytes they run over."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.calls = self.bytes = 0

        def counted(data: bytes, crc: int = 0) -> int:
            self.calls += 1
            self.bytes += len(data)
            return zlib.crc32(data, crc)

        monkeypatch.setattr(deframer, "crc32", counted)

    def of(self, chunks: Iterable[bytes]) -> tuple[int, int]:
        self.calls = self.bytes = 0
        deframer = Deframer()
        for chunk in chunks:
            deframer.feed(chunk)
        deframer.flush()
        counters = deframer.counters
        assert counters.bytes == counters.dropped_bytes, (
            "nothing hostile is a frame, and nothing is lost"
        )
        return self.calls, self.bytes


def repeated(unit: bytes, size: int) -> bytes:
    return (unit * (size // len(unit) + 1))[:size]


@pytest.mark.parametrize("name", HOSTILE)
@both_cuts
def test_the_work_on_hostile_input_is_linear(
    name: str, cut: Callable[[bytes], list[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    work = Work(monkeypatch)
    calls, crc_bytes = work.of(cut(repeated(HOSTILE[name], SIZE // 4)))
    more_calls, more_bytes = work.of(cut(repeated(HOSTILE[name], SIZE)))
    assert more_calls <= 4 * (calls + 50)
    assert more_bytes <= 4 * (crc_bytes + 50 * 40)
    assert more_calls <= 3 * (SIZE // 4 + 1), (
        "at most three CRCs for a header, and a header has four bytes"
    )


# ---- diagnosis


def diagnosis_of(stream: bytes, flush: bool = False) -> str:
    deframer = Deframer()
    deframer.feed(stream)
    if flush:
        deframer.flush()
    text = deframer.counters.diagnosis()
    assert text is not None
    return text


def noise_without_kod(size: int) -> bytes:
    return random.Random(18).randbytes(size).replace(b"K", b"J")


BAD = sheet.RECORDED_LIVE[:20] + bytes((sheet.RECORDED_LIVE[20] ^ 1,)) + sheet.RECORDED_LIVE[21:]
DIAGNOSES: list[tuple[str, list[bytes]]] = [
    (SILENCE, [b""]),
    (OTHER_PROTOCOL, [noise_without_kod(size) for size in (1, 63, 64, 1000)]),
    (OTHER_PROTOCOL, [bytes(63), b"\xfe" * 899 + b"J" * 101]),
    (SLOWER_LINE, [bytes(64), b"\xfe" * 900 + b"J" * 100]),
    (FAILED_CRC, [BAD * 5, b"KODX" + noise_without_kod(500) + BAD * 5]),
    (UNKNOWN_KIND, [(b"KODX" + bytes(36)) * 10]),
    (PARTIAL, [sheet.RECORDED_LIVE[:size] for size in (4, 20, 30, 37)]),
    (PARTIAL, [noise_without_kod(10) + sheet.RECORDED_LIVE[:4]]),
]


@pytest.mark.parametrize(("expected", "received"), DIAGNOSES)
def test_what_was_received_without_a_frame_has_a_diagnosis(
    expected: str, received: list[bytes]
) -> None:
    for stream in received:
        assert diagnosis_of(stream).startswith(expected)


def test_a_frame_that_never_came_whole_is_diagnosed_although_nothing_is_pending() -> None:
    assert diagnosis_of(sheet.RECORDED_LIVE[:30], flush=True) == PARTIAL


@pytest.mark.parametrize("resume_at_low_stop", [False, True])
def test_the_model_of_the_line_reads_what_was_sent_at_its_own_rate(
    resume_at_low_stop: bool,
) -> None:
    line = Uart()
    sent = sheet.RECORDED_LIVE + bytes(range(256)) + sheet.RECORDED_INFO
    for byte in one_by_one(sent):
        line.send(byte)
        line.idle(random.Random(byte).randrange(9))
    assert line.received(parity=True, resume_at_low_stop=resume_at_low_stop) == sent
    frames, _ = run([line.received(parity=True, resume_at_low_stop=resume_at_low_stop)])
    assert [frame.kind for frame in frames] == [Kind.LIVE, Kind.INFO]


@pytest.mark.parametrize("resume_at_low_stop", [False, True], ids=["waits for high", "as a 16550"])
@pytest.mark.parametrize("parity", [False, True], ids=["8N1", "8E1"])
@pytest.mark.parametrize("gaps", [False, True], ids=["no gaps", "gaps"])
def test_9600_baud_read_at_115200_is_diagnosed_as_a_slower_line(
    resume_at_low_stop: bool, parity: bool, gaps: bool
) -> None:
    source = random.Random(19)
    line = Uart()
    for byte in one_by_one(source.randbytes(200)):
        line.send(byte, slower=12, parity=parity)
        line.idle(source.randrange(500) if gaps else 0)
    received = line.received(parity=True, resume_at_low_stop=resume_at_low_stop)
    assert len(received) > 200
    assert diagnosis_of(received).startswith(SLOWER_LINE)


def test_frames_read_without_parity_by_a_16550_are_diagnosed_as_wrong_parity() -> None:
    line = Uart()
    for _ in range(50):
        line.send(sheet.RECORDED_LIVE)
        line.idle(2000)
    received = line.received(parity=False, resume_at_low_stop=True)
    assert run([received])[0] == []
    assert diagnosis_of(received).startswith(OTHER_PROTOCOL)


def test_a_diagnosis_since_a_moment_looks_only_at_what_came_after_it() -> None:
    deframer = Deframer()
    steps: list[tuple[bytes, str | None]] = [
        (sheet.RECORDED_LIVE, None),
        (b"", SILENCE),
        (BAD + bytes(20), FAILED_CRC),
        (noise_without_kod(100), OTHER_PROTOCOL),
        (b"KODX" + bytes(10), UNKNOWN_KIND),
        (bytes(100), SLOWER_LINE),
        (noise_without_kod(100), OTHER_PROTOCOL),
        (b"", SILENCE),
        (sheet.RECORDED_INFO, None),
        (encode(LiveData(), Layout.V4), None),
        (encode(InfoData(), Layout.V4), None),
        (bytes(70), SLOWER_LINE),
        (sheet.RECORDED_LIVE[:30], PARTIAL),
    ]
    for received, expected in steps:
        since = deframer.counters.copy()
        deframer.feed(received)
        text = deframer.counters.diagnosis(since)
        assert text is None if expected is None else text is not None and text.startswith(expected)
    assert deframer.counters.diagnosis() is None, "over all, frames came"
