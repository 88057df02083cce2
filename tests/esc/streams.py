"""Byte streams for the deframer's tests. All are synthetic except the two recorded frames."""

import random

import specification
from hypothesis import strategies as st
from specification import FORM_ROWS, FormRow

from kontronik_can_gw.esc.kontronik.codec import FORMS, Form
from kontronik_can_gw.esc.kontronik.fields import Data

from .reference import ambiguous, random_frame, seal

FRAGMENTS = [*b"K KO KOD KODL KODI KODK KODX KOKO KKOD KODKODI \0 \xff".split(b" ")]


def form_of(row: FormRow) -> Form:
    """Return the package's form for a row of the protocol specification."""
    return next(form for form in FORMS if form.name == f"{row.kind}_{row.layout}")


def decoded(form: Form, buffer: bytes, at: int = 0) -> Data:
    """Return the fields of a frame of this form without any check."""
    return form.data_type(*form.unpack_fields(buffer, at))


def overlapping_pair(
    first: FormRow,
    second: FormRow,
    shared: int,
    source: random.Random,
) -> bytes:
    """Return two valid frames that share the last ``shared`` bytes of the first."""
    start = first.length - shared
    assert 4 <= start <= first.covered - 4
    body = bytearray(source.randbytes(first.crc_at - 4))
    body[start - 4 : start] = second.header
    outer = seal(first, bytes(body))
    inner_begin = outer[start + 4 :]
    rest = source.randbytes(second.crc_at - 4 - len(inner_begin))
    return outer[:start] + seal(second, inner_begin + rest)


def random_piece(source: random.Random) -> bytes:
    """Return a piece of a stream: often a valid frame, else bytes that are hard for a deframer."""
    row = source.choice(FORM_ROWS)
    frame = random_frame(row, source)
    choice = source.randrange(16)
    if choice < 6:
        return frame
    if choice == 6:
        return source.choice([specification.RECORDED_LIVE, specification.RECORDED_INFO])
    if choice == 7:
        return source.choice([ambiguous("live"), ambiguous("info")])
    if choice == 8:  # truncated, at either end
        cut = source.randrange(1, len(frame))
        return source.choice([frame[:cut], frame[cut:]])
    if choice == 9:  # a whole frame after a false header
        header = source.choice([b"KODL", b"KODI"])
        return header + source.randbytes(source.randrange(0, 40)) + frame
    if choice == 10:  # headers in a row
        return source.choice([b"KODL", b"KODI", b"KOD"]) * source.randrange(1, 12)
    if choice == 11:
        shared = source.randrange(8, 32)
        fitting = [row for row in FORM_ROWS if 4 <= row.length - shared <= row.covered - 4]
        return overlapping_pair(source.choice(fitting), row, shared, source)
    if choice == 12:
        return source.randbytes(source.randrange(0, 60))
    if choice == 13:  # fragments as a frame's content
        content = b"".join(source.choices(FRAGMENTS, k=20))
        return seal(row, content.ljust(40, b"K")[: row.crc_at - 4])
    if choice == 14:  # one bad bit
        at = source.randrange(len(frame))
        wrong = frame[at] ^ 1 << source.randrange(8)
        return frame[:at] + bytes([wrong]) + frame[at + 1 :]
    return source.choice(FRAGMENTS)


def damaged(stream: bytes, source: random.Random, times: int) -> bytes:
    """Return the stream with some bytes lost, bits flipped and bytes inserted."""
    result = bytearray(stream)
    for _ in range(times):
        at = source.randrange(len(result) + 1)
        harm = source.randrange(3)
        if harm == 0:
            del result[at : at + source.choice([1, 1, 1, 5])]
        elif harm == 1 and at < len(result):
            result[at] ^= 1 << source.randrange(8)
        else:
            result[at:at] = source.choice([source.randbytes(1), source.choice(FRAGMENTS)])
    return bytes(result)


def random_stream(source: random.Random, pieces: int) -> bytes:
    stream = b"".join(random_piece(source) for _ in range(pieces))
    return damaged(stream, source, source.choice([0, 0, 1, 3, 10]))


def random_chunks(stream: bytes, source: random.Random) -> list[bytes]:
    """Cut the stream at random positions. Some chunks are empty."""
    largest = source.choice([2, 5, 40, 100])
    chunks = []
    at = 0
    while at < len(stream):
        size = source.randrange(largest + 1)
        chunks.append(stream[at : at + size])
        at += size
    return chunks


seeds = st.integers(0, 1 << 32)

pieces = st.one_of(
    st.sampled_from(FRAGMENTS),
    st.binary(max_size=50),
    seeds.map(lambda seed: random_piece(random.Random(seed))),
)
streams = st.one_of(
    st.lists(pieces, max_size=12).map(b"".join),
    seeds.map(lambda seed: random_stream(random.Random(seed), 12)),
)
