"""Stretches and the bytes between them hold exactly the frames, and leave exactly the counters, of one Deframer over the whole stream."""

import random
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from protocol.reference import ambiguous, random_frame
from protocol.sheet import FORM_ROWS, RECORDED_INFO, RECORDED_LIVE
from protocol.streams import damaged, random_stream
from protocol.streams import pieces as stream_pieces

from kontronik_can_gw.offline.bulk.scan import Stretch, form_of, pass_over, pieces
from kontronik_can_gw.protocol.codec import Kind
from kontronik_can_gw.protocol.deframer import Deframer, Frame

ROWS = {(row.kind, row.layout): row for row in FORM_ROWS}


def in_chunks(stream: bytes, largest: int) -> Callable[[int], bytes]:
    """A read function that gives up to ``largest`` bytes at once."""
    at = 0

    def read(wanted: int) -> bytes:
        nonlocal at
        data = stream[at : at + min(wanted, largest)]
        at += len(data)
        return data

    return read


def frames_of(stretch: Stretch) -> list[Frame]:
    """The frames of a stretch by its arrays."""
    found = []
    for kind, records, offsets in (
        (Kind.LIVE, stretch.live, stretch.live_offsets),
        (Kind.INFO, stretch.info, stretch.info_offsets),
    ):
        form = form_of(kind, stretch.layout)
        found += [
            Frame(form, offset, form.data_type._make(record))
            for offset, record in zip(offsets.tolist(), records.tolist(), strict=True)
        ]
    return sorted(found, key=lambda frame: frame.offset)


def check(stream: bytes, largest: int = 1 << 22, least: int = 1) -> int:
    """Compare with one Deframer; how many frames came from stretches."""
    expected = Deframer()
    whole = expected.feed(stream) + expected.flush()
    deframer, found, at, in_stretches = Deframer(), [], 0, 0
    for piece in pieces(in_chunks(stream, largest), least, largest):
        if isinstance(piece, Stretch):
            assert piece.offset == at
            assert stream[at : at + len(piece.data)] == piece.data
            new = frames_of(piece)
            assert len(new) >= least
            assert len(new) == piece.live_count + len(piece.infos)
            in_stretches += len(new)
            found += new
            pass_over(deframer, piece)
            at += len(piece.data)
        else:
            assert piece
            assert stream[at : at + len(piece)] == piece
            found += deframer.feed(piece)
            at += len(piece)
    found += deframer.flush()
    assert at == len(stream)
    assert found == whole
    assert deframer.counters == expected.counters
    return in_stretches


def clean(layout: str, frames: int, source: random.Random, every: int = 10) -> bytes:
    live, info = ROWS["live", layout], ROWS["info", layout]
    return b"".join(random_frame(live if n % every else info, source) for n in range(frames))


@given(st.lists(stream_pieces, max_size=30).map(b"".join), st.integers(1, 200), st.integers(1, 4))
@settings(max_examples=100, deadline=None)
def test_any_stream_in_any_chunks(stream: bytes, largest: int, least: int) -> None:
    check(stream, largest, least)
    check(stream, 1 << 22, least)


@pytest.mark.parametrize("seed", range(8))
def test_random_streams(seed: int) -> None:
    source = random.Random(seed)
    stream = random_stream(source, 60)
    for _ in range(4):
        check(stream, source.choice([1, 7, 44, 45, 100, 1000, 1 << 20]), source.choice([1, 2, 5]))


@pytest.mark.parametrize("seed", range(8))
def test_long_streams_with_damage(seed: int) -> None:
    source = random.Random(1000 + seed)
    stream = b"".join(
        clean(source.choice(["v4", "legacy"]), source.randrange(1, 300), source, source.choice([2, 10, 100]))
        for _ in range(5)
    )
    stream = damaged(stream, source, source.choice([0, 1, 5, 20]))
    check(stream, source.choice([300, 4000, 1 << 20]), source.choice([1, 8, 16]))


@pytest.mark.parametrize("layout", ["v4", "legacy"])
def test_all_of_a_clean_stream_is_stretches(layout: str) -> None:
    stream = clean(layout, 5000, random.Random(1))
    assert check(stream) == 5000
    assert check(stream, 1 << 14) == 5000


def test_every_chunk_limit() -> None:
    source = random.Random(2)
    stream = (
        b"noise KOD" + clean("v4", 12, source) + b"KODL" + bytes(10) + clean("legacy", 12, source) + ambiguous("live")
        + clean("v4", 6, source) + ambiguous("info") + b"KO" + clean("v4", 6, source)[:-3]
    )  # fmt: skip
    for largest in (*range(1, 120), *range(120, len(stream), 31)):
        check(stream, largest)


@pytest.mark.parametrize("kind", ["live", "info"])
def test_of_two_forms_the_shorter_wins_inside_a_stretch(kind: str) -> None:
    source = random.Random(3)
    around = clean("v4", 40, source)
    assert check(around + ambiguous(kind) + around) >= 78
    assert check(ambiguous(kind) * 50) >= 0


@pytest.mark.parametrize(
    "noise",
    [b"K", b"KO", b"KOD", b"KODL", b"KODI", b"KODX", b"KODL" + bytes(35), b"KODI" + bytes(39), b"KK", b"\0"],
    ids=repr,
)
def test_a_stretch_begins_only_where_nothing_is_pending(noise: bytes) -> None:
    stream = clean("v4", 30, random.Random(4)) + noise + clean("v4", 30, random.Random(5))
    for largest in (1 << 20, *range(1, 150, 7)):
        check(stream, largest)


def test_bytes_of_one_recorded_kind() -> None:
    assert check((RECORDED_INFO + RECORDED_LIVE * 99) * 20) == 2000


def test_nothing_and_rubbish() -> None:
    assert check(b"") == 0
    assert check(bytes(10_000)) == 0
    assert check(b"KODL" * 5000) == 0
    assert check(b"K" * 5000, 777) == 0
