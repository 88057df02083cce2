"""The capture's format: every entry comes back, every intact block is found, damage is reported and costs nothing else."""

import random
import struct
import zlib
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kontronik_can_gw.capture.format import (
    MAGIC,
    Block,
    Damage,
    Entry,
    Kind,
    Scanner,
    block,
    data_payload,
    frame_data,
    read_entries,
    read_frame,
    read_numbers,
)
from kontronik_can_gw.frames import CanFrame

entries = st.builds(
    Entry,
    st.integers(0, 2**64 - 1),
    st.integers(0, 255),
    st.integers(0, 65535),
    st.binary(max_size=80),
    st.integers(0, 255),
    st.integers(0, 2**64 - 1),
)
payloads = st.one_of(st.binary(max_size=200), st.just(b"x" * 5000), st.just(MAGIC * 30))


def scanned(data: bytes, size: int | None = None) -> list[Block | Damage]:
    scanner = Scanner()
    found: list[Block | Damage] = []
    step = size or max(1, len(data))
    for at in range(0, len(data), step):
        found += scanner.feed(data[at : at + step])
    return found + scanner.flush()


@given(st.lists(entries, max_size=20))
def test_entries_come_back(listed: list[Entry]) -> None:
    expected = [
        entry if entry.kind in (Kind.BYTES, Kind.FRAME) else entry._replace(came_ns=None)
        for entry in listed
    ]
    assert list(read_entries(data_payload(listed))) == expected


@given(st.binary(max_size=200))
def test_rubbish_as_a_table_is_refused_or_read_but_never_more(data: bytes) -> None:
    try:
        found = list(read_entries(data))
    except ValueError:
        return
    assert data_payload(found) == data


@given(
    st.lists(payloads, max_size=5),
    st.lists(st.binary(max_size=60), min_size=6, max_size=6),
    st.data(),
)
def test_blocks_are_found_amid_rubbish_and_every_byte_is_accounted_for(
    listed: list[bytes], rubbish: list[bytes], data: st.DataObject
) -> None:
    stream, places = b"", []
    for number, payload in enumerate(listed):
        stream += rubbish[number]
        places.append(len(stream))
        stream += block(b"D", number, payload)
    stream += rubbish[-1]
    found = scanned(stream, data.draw(st.integers(1, max(1, len(stream)))))
    blocks = [b for b in found if isinstance(b, Block)]
    assert [(b.offset, b.payload) for b in blocks] == list(zip(places, listed, strict=True))
    assert [b.number for b in blocks] == list(range(len(listed)))
    damaged = sum(d.length for d in found if isinstance(d, Damage))
    assert damaged == sum(len(rubbish[n]) for n in range(len(listed))) + len(rubbish[-1])


def test_any_flipped_bit_costs_its_block_and_no_other() -> None:
    parts = [block(b"D", n, bytes((n,)) * 50) for n in range(3)]
    stream = b"".join(parts)
    rng = random.Random(1)
    for bit in rng.sample(range(len(stream) * 8), 300):
        broken = bytearray(stream)
        broken[bit // 8] ^= 1 << bit % 8
        hit = next(n for n in range(3) if bit // 8 < sum(map(len, parts[: n + 1])))
        found = scanned(bytes(broken), 64)
        assert {b.number for b in found if isinstance(b, Block)} == {0, 1, 2} - {hit}
        assert [d.length for d in found if isinstance(d, Damage)] == [len(parts[hit])]


def test_a_block_that_claims_to_be_huge_is_none() -> None:
    """A deflated bomb, or a length from rubbish, must not make the reader wait or swell."""
    packed = zlib.compress(bytes(1 << 22), 9)
    head = struct.pack("<4scBHIII", MAGIC, b"D", 1, 0, len(packed), 1000, 0)
    bomb = head + struct.pack("<I", zlib.crc32(packed, zlib.crc32(head))) + packed
    good = block(b"D", 1, b"good")
    found = scanned(bomb + good)
    assert [b.payload for b in found if isinstance(b, Block)] == [b"good"]


@given(
    st.builds(
        CanFrame,
        st.integers(0, 0x7FF),
        st.binary(max_size=64),
        st.booleans(),
        st.booleans(),
        page=st.just(0),
        remote=st.booleans(),
        queued=st.just(False),
    )
)
def test_a_can_frame_comes_back(frame: CanFrame) -> None:
    assert read_frame(frame_data(frame)) == frame


@pytest.mark.parametrize("read", [read_frame, read_numbers])
def test_data_that_is_too_short_is_refused(read: Callable[[bytes], object]) -> None:
    with pytest.raises(ValueError):
        read(b"abc")
