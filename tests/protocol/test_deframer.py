"""Byte stream -> frames, held against the brute force of reference.py. Streams are synthetic but for the two recorded frames."""

import random
from collections.abc import Callable, Iterable

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from kontronik_can_gw.protocol import Counters, Deframer, Frame, InfoData, Kind, Layout, LiveData, codec, encode

from . import sheet
from .reference import ambiguous, certain_at, counters_of, frames_of, random_frame, seal
from .sheet import FORM_ROWS, FormRow
from .streams import Uart, overlapping_pair, random_chunks, random_stream, seeds, streams

PROPERTY = settings(deadline=None, max_examples=250, database=None)
LIVE_LEGACY, INFO_LEGACY, LIVE_V4, INFO_V4 = FORM_ROWS

form_rows = pytest.mark.parametrize("row", FORM_ROWS, ids=lambda row: f"{row.kind} {row.layout}")

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
        row = next(row for row in FORM_ROWS if (row.kind, row.layout) == (frame.kind.value, frame.layout.value))
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


@PROPERTY
@given(stream=streams)
@example(b"")
@example(b"KOD")
@example(b"KODKODL")
@example(b"KODI" + bytes(37))
def test_a_stream_fed_whole_gives_what_brute_force_finds(stream: bytes) -> None:
    check_against_the_reference(stream, [stream])


@PROPERTY
@given(stream=streams)
def test_a_stream_fed_byte_by_byte_gives_what_brute_force_finds(stream: bytes) -> None:
    check_against_the_reference(stream, one_by_one(stream))


@PROPERTY
@given(stream=streams, seed=seeds)
def test_a_stream_cut_anywhere_gives_what_brute_force_finds(stream: bytes, seed: int) -> None:
    check_against_the_reference(stream, random_chunks(stream, random.Random(seed)))


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


@form_rows
def test_each_lost_byte_costs_no_more_than_brute_force_says(row: FormRow) -> None:
    source = random.Random(3)
    clean = b"".join(random_frame(row, source) for _ in range(4))
    for at in range(len(clean)):
        lost = clean[:at] + clean[at + 1 :]
        check_against_the_reference(lost, [lost])
        frames, _ = run(one_by_one(lost))
        assert len(frames) >= 3, "only the frame that lost a byte is lost"


@form_rows
def test_each_flipped_bit_costs_at_most_its_own_frame(row: FormRow) -> None:
    source = random.Random(4)
    clean = b"".join(random_frame(row, source) for _ in range(3))
    for at in range(row.length, 2 * row.length):
        flipped = bytearray(clean)
        flipped[at] ^= 1 << source.randrange(8)
        check_against_the_reference(bytes(flipped), one_by_one(bytes(flipped)))
        frames, _ = run([bytes(flipped)])
        unprotected = row.covered <= at - row.length < row.crc_at
        assert len(frames) == (3 if unprotected else 2)


@pytest.mark.parametrize("fake", [b"K", b"KO", b"KOD", b"KODL", b"KODI", b"KODX", b"KODKO", b"KODLKODI", b"KODI" * 12])
@form_rows
def test_a_frame_directly_behind_rubbish_is_found(row: FormRow, fake: bytes) -> None:
    frame = random_frame(row, random.Random(5))
    for stream in (fake + frame, fake + frame + frame, frame + fake + frame):
        check_against_the_reference(stream, [stream])
        check_against_the_reference(stream, one_by_one(stream))
    assert [found.offset for found in run([fake + frame])[0]] == [len(fake)]


@pytest.mark.parametrize("fake", [b"KODL", b"KODI"])
@pytest.mark.parametrize("gap", range(45))
def test_a_frame_anywhere_behind_a_fake_header_is_found(fake: bytes, gap: int) -> None:
    for row in FORM_ROWS:
        stream = fake + bytes(gap) + random_frame(row, random.Random(gap))
        check_against_the_reference(stream, [stream])
        check_against_the_reference(stream, one_by_one(stream))
        assert [found.offset for found in run([stream])[0]] == [4 + gap]


@pytest.mark.parametrize("fake", [b"KODL", b"KODI"])
@pytest.mark.parametrize("tail", [b"", b"K", b"KO", b"KOD", b"KKOD", b"KODX", b"KODXYZ", b"KODL", b"KODI\0", b"KODKO"])
def test_a_stream_that_ends_anywhere_behind_a_fake_header_is_accounted_as_stated(fake: bytes, tail: bytes) -> None:
    for gap in range(60):
        stream = fake + bytes(gap) + tail
        check_against_the_reference(stream, [stream])
        check_against_the_reference(stream, one_by_one(stream))


@form_rows
def test_of_two_valid_frames_that_overlap_the_earlier_is_taken(row: FormRow) -> None:
    source = random.Random(6)
    stream = overlapping_pair(row, LIVE_LEGACY, 16, source)
    frames, _ = run(one_by_one(stream))
    assert [(frame.offset, frame.form.length) for frame in frames] == [(0, row.length)]
    spoilt = stream[:4] + bytes([stream[4] ^ 1]) + stream[5:]
    frames, _ = run(one_by_one(spoilt))
    assert [(frame.offset, frame.form.length) for frame in frames] == [(row.length - 16, 38)]


@form_rows
def test_a_header_that_straddles_the_end_of_a_frame_does_not_count(row: FormRow) -> None:
    source = random.Random(8)
    number = 0
    while True:  # until the CRC's last byte is a K
        frame = seal(row, number.to_bytes(4, "little") + source.randbytes(row.crc_at - 8))
        if frame.endswith(b"K"):
            break
        number += 1
    stream = frame + b"ODL" + bytes(60)
    frames, deframer = run([stream])
    assert len(frames) == 1
    assert (deframer.counters.headers, deframer.counters.crc_errors) == (1, 0)


@pytest.mark.parametrize("kind", ["live", "info"])
@both_cuts
def test_where_both_layouts_fit_the_shorter_wins_and_the_rest_is_noise(
    kind: str, cut: Callable[[bytes], list[bytes]]
) -> None:
    stream = ambiguous(kind)
    frames, deframer = run(cut(stream))
    assert [(frame.kind.value, frame.layout) for frame in frames] == [(kind, Layout.LEGACY)]
    assert deframer.counters.dropped_noise == len(stream) - frames[0].form.length == (2 if kind == "live" else 3)
    check_against_the_reference(stream, cut(stream))


def test_the_layout_may_change_in_mid_stream() -> None:
    source = random.Random(9)
    rows = [source.choice(FORM_ROWS) for _ in range(200)]
    stream = b"".join(random_frame(row, source) for row in rows)
    frames, deframer = run(random_chunks(stream, source))
    assert [(frame.kind.value, frame.layout.value) for frame in frames] == [(row.kind, row.layout) for row in rows]
    assert deframer.counters.dropped_bytes == 0
    assert all(getattr(deframer.counters, f"{row.kind}_{row.layout}") == rows.count(row) for row in FORM_ROWS)


# ---- when a frame comes out


@form_rows
def test_a_frame_is_emitted_on_its_last_byte(row: FormRow) -> None:
    source = random.Random(10)
    deframer = Deframer()
    for _ in range(5):
        frame = random_frame(row, source)
        for byte in one_by_one(frame)[:-1]:
            assert deframer.feed(byte) == []
        assert [found.form.length for found in deframer.feed(frame[-1:])] == [row.length]
        assert deframer.pending == 0


def test_the_recorded_frames_are_emitted_on_their_last_byte() -> None:
    deframer = Deframer()
    for frame, kind in ((sheet.RECORDED_LIVE, Kind.LIVE), (sheet.RECORDED_INFO, Kind.INFO)) * 3:
        emitted = [deframer.feed(byte) for byte in one_by_one(frame)]
        assert emitted[:-1] == [[]] * (len(frame) - 1)
        assert [found.kind for found in emitted[-1]] == [kind]
    assert deframer.counters.dropped_bytes == 0


@PROPERTY
@given(stream=streams)
def test_a_frame_is_emitted_as_soon_as_no_continuation_could_take_it_away(stream: bytes) -> None:
    deframer = Deframer()
    moments: list[int] = []
    for number, byte in enumerate(one_by_one(stream), start=1):
        moments += [number] * len(deframer.feed(byte))
    moments += [len(stream)] * len(deframer.flush())
    assert moments == certain_at(stream)


def test_a_frame_behind_an_undecided_header_waits_for_that_header() -> None:
    frame = random_frame(LIVE_LEGACY, random.Random(12))
    deframer = Deframer()
    assert deframer.feed(b"KODI" + frame) == []
    assert deframer.pending == 42
    assert deframer.feed(b"\0") == []
    assert deframer.pending == 43
    assert [found.offset for found in deframer.feed(b"\0")] == [4]


@PROPERTY
@given(stream=streams, seed=seeds)
def test_counters_and_pending_are_the_same_at_every_moment_whatever_the_chunks(stream: bytes, seed: int) -> None:
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


@form_rows
def test_flush_finds_a_frame_behind_a_header_that_never_became_one(row: FormRow) -> None:
    frame = random_frame(row, random.Random(13))
    deframer = Deframer()
    early = deframer.feed(b"KODI" + frame[:-1])
    early += deframer.feed(frame[-1:])
    assert len(early) == (0 if row.length < 40 else 1)
    assert [(found.offset, found.form.length) for found in early + deframer.flush()] == [(4, row.length)]


@form_rows
def test_flush_drops_a_frame_that_is_not_whole_as_incomplete(row: FormRow) -> None:
    frame = random_frame(row, random.Random(14))
    for size in range(3, row.length):
        frames, deframer = run([frame[:size]])
        assert frames == []
        assert deframer.counters.dropped_incomplete == size
        assert deframer.counters.headers == (size >= 4)
        assert deframer.counters.crc_errors == 0


def test_flush_of_nothing_changes_nothing() -> None:
    deframer = Deframer()
    assert deframer.flush() == []
    assert state_of(deframer) == (Counters().as_dict(), 0)
    deframer.feed(sheet.RECORDED_LIVE)
    before = state_of(deframer)
    assert deframer.flush() == deframer.flush() == []
    assert state_of(deframer) == before


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
            assert [frame._replace(offset=frame.offset - base) for frame in frames] == fresh.feed(chunk)
            assert state_of(deframer) == (
                {n: total[n] + value for n, value in state_of(fresh)[0].items()},
                fresh.pending,
            )
        assert [frame._replace(offset=frame.offset - base) for frame in deframer.flush()] == fresh.flush()
        assert fresh.counters.as_dict() == counters_of(part)
        total = {name: total[name] + value for name, value in fresh.counters.as_dict().items()}
        assert state_of(deframer) == (total, 0)
        base += len(part)


def test_after_a_flush_that_ended_on_kod_rubbish_is_counted_at_once() -> None:
    deframer = Deframer()
    deframer.feed(b"KODL" + bytes(20) + b"KOD")
    deframer.flush()
    deframer.feed(b"x")
    assert deframer.pending == 0
    assert deframer.counters.dropped_noise == 1


def test_half_a_frame_before_a_flush_is_never_joined_to_the_half_behind_it() -> None:
    deframer = Deframer()
    frame = sheet.RECORDED_LIVE
    assert deframer.feed(frame[:20]) + deframer.flush() + deframer.feed(frame[20:]) + deframer.flush() == []
    assert [found.offset for found in deframer.feed(frame)] == [38]
    assert deframer.counters.dropped_incomplete == 20
    assert deframer.counters.dropped_noise == 18


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_any_buffer_of_bytes_may_be_fed_and_reused_afterwards(kind: Callable[[bytearray], bytes]) -> None:
    """The contract is bytes; a bytearray or a memoryview is read just so, and nothing of it is kept."""
    stream = sheet.RECORDED_LIVE + sheet.RECORDED_INFO + b"KO" + sheet.RECORDED_LIVE
    expected = run([stream])[0]
    for size in (1, 7, len(stream)):
        deframer = Deframer()
        frames: list[Frame] = []
        for at in range(0, len(stream), size):
            buffer = bytearray(stream[at : at + size])
            frames += deframer.feed(kind(buffer))
            buffer[:] = b"\xaa" * len(buffer)
        assert frames + deframer.flush() == expected


def test_an_empty_chunk_changes_nothing() -> None:
    deframer = Deframer()
    for chunk in (b"", b"KO", b"", b"DL", b"", sheet.RECORDED_LIVE[4:]):
        before = state_of(deframer)
        frames = deframer.feed(chunk)
        assert chunk or (frames, state_of(deframer)) == ([], before)
    assert deframer.counters.live_legacy == 1


# ---- counters


def test_bytes_are_dropped_for_the_stated_reasons() -> None:
    _, deframer = run(
        [b"KO" + b"noise" + b"KODX" + b"KODL" + bytes(40) + sheet.RECORDED_LIVE + b"\xf8" + b"KODI" + bytes(5)]
    )
    counters = deframer.counters
    assert counters.dropped_noise == 2 + 5 + 1 + 4 + 1, "KO noise, the X, the four zeros behind 40 bytes, F8"
    assert counters.dropped_unknown_kind == 3
    assert counters.dropped_crc == 40
    assert counters.dropped_incomplete == 9
    assert (counters.headers, counters.crc_errors, counters.unknown_kinds) == (3, 1, 1)
    assert counters.long_run_bytes == 40 + 1 + 5
    assert counters.dropped_bytes == 13 + 3 + 40 + 9


def test_a_failed_info_header_is_blamed_for_44_bytes_and_nested_ones_extend_it() -> None:
    _, deframer = run([b"KODI" + bytes(60)])
    assert (deframer.counters.dropped_crc, deframer.counters.dropped_noise) == (44, 20)
    _, deframer = run([b"KODI" + bytes(16) + b"KODL" + bytes(60)])
    assert (deframer.counters.dropped_crc, deframer.counters.dropped_noise) == (60, 24)


def test_the_blame_of_a_failed_header_ends_at_the_next_frame() -> None:
    _, deframer = run([b"KODL" + sheet.RECORDED_LIVE + b"noise" + bytes(40)])
    assert (deframer.counters.dropped_crc, deframer.counters.dropped_noise) == (4, 45)


def test_the_k_behind_kod_may_begin_the_next_header() -> None:
    for stream in (b"KOD" + sheet.RECORDED_LIVE, b"KODKOD" + sheet.RECORDED_LIVE):
        frames, deframer = run(one_by_one(stream))
        assert len(frames) == 1
        assert deframer.counters.unknown_kinds == (len(stream) - 38) // 3
        assert deframer.counters.dropped_unknown_kind == len(stream) - 38


def test_a_copy_of_the_counters_does_not_move() -> None:
    deframer = Deframer()
    deframer.feed(b"noise")
    copy = deframer.counters.copy()
    assert copy == deframer.counters
    deframer.feed(sheet.RECORDED_INFO)
    assert copy.as_dict() == Counters(bytes=5, dropped_noise=5).as_dict()
    assert deframer.counters.as_dict()["info"] == deframer.counters.info == 1


def test_all_counters_and_totals_have_a_name() -> None:
    assert set(Counters().as_dict()) == set(counters_of(b""))
    counters = Counters(live_v4=1, live_legacy=2, info_v4=4, info_legacy=8, dropped_noise=1, dropped_crc=2)
    counters.dropped_unknown_kind = 4
    counters.dropped_incomplete = 8
    assert (counters.live, counters.info, counters.dropped_bytes) == (3, 12, 15)
    assert {name: counters.as_dict()[name] for name in ("live", "info", "dropped_bytes")} == {
        "live": 3,
        "info": 12,
        "dropped_bytes": 15,
    }


def test_the_position_of_a_frame_is_that_in_the_whole_stream() -> None:
    noise = b"noise!" * 1000
    frames, _ = run(random_chunks(noise + sheet.RECORDED_LIVE + noise + sheet.RECORDED_INFO, random.Random(15)))
    assert [frame.offset for frame in frames] == [6000, 12_038]
    assert [type(frame.data) for frame in frames] == [LiveData, InfoData]


# ---- hostile input

MEGABYTE = 1 << 20
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
    "random": random.Random(16).randbytes(MEGABYTE),
}
HOSTILE_BYTE_BY_BYTE = {"KOD", "KODL", "KODI", "zeros", "random"}


class Work:
    """Counts the CRCs that are calculated and the bytes they run over."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.calls = self.bytes = 0
        real = codec.crc32  # type: ignore[attr-defined]  # imported there from zlib

        def counted(data: bytes) -> int:
            self.calls += 1
            self.bytes += len(data)
            return int(real(data))

        monkeypatch.setattr(codec, "crc32", counted)

    def of(self, chunks: Iterable[bytes]) -> tuple[int, int]:
        self.calls = self.bytes = 0
        deframer = Deframer()
        for chunk in chunks:
            deframer.feed(chunk)
        deframer.flush()
        counters = deframer.counters
        assert counters.bytes == counters.dropped_bytes, "nothing hostile is a frame, and nothing is lost"
        return self.calls, self.bytes


def repeated(unit: bytes, size: int) -> bytes:
    return (unit * (size // len(unit) + 1))[:size]


@pytest.mark.parametrize("name", HOSTILE)
@both_cuts
def test_the_work_on_a_megabyte_of_hostile_input_is_linear(
    name: str, cut: Callable[[bytes], list[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    work = Work(monkeypatch)
    size = MEGABYTE
    if cut is one_by_one and name not in HOSTILE_BYTE_BY_BYTE:
        size = MEGABYTE // 8  # to stay fast
    calls, crc_bytes = work.of(cut(repeated(HOSTILE[name], size // 4)))
    more_calls, more_bytes = work.of(cut(repeated(HOSTILE[name], size)))
    assert more_calls <= 4 * (calls + 50)
    assert more_bytes <= 4 * (crc_bytes + 50 * 40)
    assert more_calls <= 3 * (size // 4 + 1), "at most three CRCs for a header, and a header has four bytes"


@pytest.mark.parametrize("unit", HOSTILE.values(), ids=HOSTILE.keys())
def test_hostile_input_gives_the_same_counters_and_bounded_pending_however_it_is_cut(unit: bytes) -> None:
    stream = repeated(unit, 5_011)
    source = random.Random(17)
    for chunks in (whole(stream), one_by_one(stream), random_chunks(stream, source)):
        frames, deframer = run(chunks)
        assert frames == []
        assert deframer.counters.as_dict() == counters_of(stream)


def test_a_frame_is_still_found_behind_a_megabyte_of_headers() -> None:
    stream = b"KODLKODI" * (MEGABYTE // 8) + sheet.RECORDED_LIVE + bytes(2)
    assert [found.offset for found in run([stream])[0]] == [MEGABYTE]


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


def test_silence_is_diagnosed_as_no_bytes() -> None:
    assert diagnosis_of(b"").startswith(SILENCE)
    assert "KOSMIK" in diagnosis_of(b"")


def test_while_frames_come_there_is_no_diagnosis() -> None:
    for frame in (
        sheet.RECORDED_LIVE,
        sheet.RECORDED_INFO,
        encode(LiveData(), Layout.V4),
        encode(InfoData(), Layout.V4),
    ):
        deframer = Deframer()
        deframer.feed(noise_without_kod(100) + b"KODX" + b"KODL" + bytes(50) + frame)
        assert deframer.counters.diagnosis() is None


def test_bytes_without_kod_are_diagnosed_as_parity_or_another_protocol() -> None:
    for size in (1, 63, 64, 1000):
        text = diagnosis_of(noise_without_kod(size))
        assert text.startswith(OTHER_PROTOCOL)
        assert "parity" in text and "8E1" in text


def test_headers_without_a_valid_crc_are_diagnosed() -> None:
    bad = bytearray(sheet.RECORDED_LIVE)
    bad[20] ^= 1
    assert diagnosis_of(bytes(bad) * 5).startswith(FAILED_CRC)
    assert diagnosis_of(b"KODX" + noise_without_kod(500) + bytes(bad) * 5).startswith(FAILED_CRC)


def test_kod_of_unknown_kind_is_diagnosed() -> None:
    assert diagnosis_of((b"KODX" + bytes(36)) * 10).startswith(UNKNOWN_KIND)


def test_a_header_whose_frame_never_came_whole_is_diagnosed() -> None:
    assert diagnosis_of(sheet.RECORDED_LIVE[:30], flush=True) == PARTIAL


@pytest.mark.parametrize("size", [4, 20, 37])
def test_a_frame_that_is_just_arriving_is_not_diagnosed_as_another_protocol(size: int) -> None:
    assert diagnosis_of(sheet.RECORDED_LIVE[:size]) == PARTIAL
    assert diagnosis_of(noise_without_kod(10) + sheet.RECORDED_LIVE[:size]) == PARTIAL


def test_few_zeros_are_not_yet_diagnosed_as_a_slower_line() -> None:
    assert diagnosis_of(bytes(63)).startswith(OTHER_PROTOCOL)
    assert diagnosis_of(bytes(64)).startswith(SLOWER_LINE)


def test_a_slower_line_needs_nine_tenths_of_long_runs() -> None:
    assert diagnosis_of(b"\xfe" * 900 + b"J" * 100).startswith(SLOWER_LINE)
    assert diagnosis_of(b"\xfe" * 899 + b"J" * 101).startswith(OTHER_PROTOCOL)


@pytest.mark.parametrize("resume_at_low_stop", [False, True])
def test_the_model_of_the_line_reads_what_was_sent_at_its_own_rate(resume_at_low_stop: bool) -> None:
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
    text = diagnosis_of(received)
    assert text.startswith(SLOWER_LINE)
    assert "9600" in text and "old JIVE" in text


def test_frames_read_without_parity_by_a_16550_are_diagnosed_as_wrong_parity() -> None:
    line = Uart()
    for _ in range(50):
        line.send(sheet.RECORDED_LIVE)
        line.idle(2000)
    received = line.received(parity=False, resume_at_low_stop=True)
    frames, deframer = run([received])
    assert frames == []
    text = deframer.counters.diagnosis()
    assert text is not None
    assert text.startswith(OTHER_PROTOCOL)


def test_a_diagnosis_since_a_moment_looks_only_at_what_came_after_it() -> None:
    bad = bytearray(sheet.RECORDED_LIVE)
    bad[20] ^= 1
    deframer = Deframer()
    steps: list[tuple[bytes, str | None]] = [
        (sheet.RECORDED_LIVE, None),
        (b"", SILENCE),
        (bytes(bad) + bytes(20), FAILED_CRC),
        (noise_without_kod(100), OTHER_PROTOCOL),
        (b"KODX" + bytes(10), UNKNOWN_KIND),
        (bytes(100), SLOWER_LINE),
        (noise_without_kod(100), OTHER_PROTOCOL),
        (b"", SILENCE),
        (sheet.RECORDED_INFO, None),
        (b"", SILENCE),
        (bytes(70), SLOWER_LINE),
    ]
    for received, expected in steps:
        since = deframer.counters.copy()
        deframer.feed(received)
        text = deframer.counters.diagnosis(since)
        assert text is None if expected is None else text is not None and text.startswith(expected)
    assert deframer.counters.diagnosis() is None, "over all, frames came"


def test_a_partial_frame_since_a_moment_is_diagnosed_as_such() -> None:
    deframer = Deframer()
    deframer.feed(sheet.RECORDED_LIVE)
    since = deframer.counters.copy()
    deframer.feed(sheet.RECORDED_LIVE[:30])
    deframer.flush()
    assert deframer.counters.diagnosis(since) == PARTIAL
