"""The format of captures.

Every entry is read as it was written, every intact block is found, and damage is reported without
further losses. If the content is wrong although the checksum is right, the sensible part is read,
or one line reports the reason. No other exception and no hang may occur.
"""

import copy
import itertools
import json
import random
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from capture_bench import START, Bench, made, samples
from hypothesis import given
from hypothesis import strategies as st

from kontronik_can_gw.assembly.capture_setup import CaptureSetup
from kontronik_can_gw.capture import format as capture
from kontronik_can_gw.capture.format import (
    MAGIC,
    Block,
    Damage,
    Entry,
    EntryKind,
    Scanner,
    block,
    data_payload,
    frame_data,
    json_payload,
    read_entries,
    read_frame,
    read_numbers,
)
from kontronik_can_gw.core.header_parts import HeaderError
from kontronik_can_gw.desk.recordings.inputs import CaptureInput, open_input
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.frames import CanFrame

pytestmark = pytest.mark.promise("damaged-captures")

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
def test_entries_are_read_as_they_were_written(listed: list[Entry]) -> None:
    expected = [
        entry if entry.kind in (EntryKind.BYTES, EntryKind.FRAME) else entry._replace(came_ns=None)
        for entry in listed
    ]
    assert list(read_entries(data_payload(listed))) == expected


@given(st.binary(max_size=200))
def test_garbage_in_a_table_is_refused_or_read_exactly(data: bytes) -> None:
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
def test_blocks_are_found_in_garbage_and_every_byte_is_counted(
    listed: list[bytes],
    rubbish: list[bytes],
    data: st.DataObject,
) -> None:
    stream = b""
    places = []
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
    written = [*rubbish[: len(listed)], rubbish[-1]]
    assert damaged == sum(map(len, written))


def test_any_flipped_bit_loses_only_its_own_block() -> None:
    parts = [block(b"D", n, bytes((n,)) * 50) for n in range(3)]
    assert len({len(part) for part in parts}) == 1
    stream = b"".join(parts)
    rng = random.Random(1)
    for bit in rng.sample(range(len(stream) * 8), 300):
        broken = bytearray(stream)
        broken[bit // 8] ^= 1 << bit % 8
        hit = bit // 8 // len(parts[0])
        found = scanned(bytes(broken), 64)
        assert {b.number for b in found if isinstance(b, Block)} == {0, 1, 2} - {hit}
        assert [d.length for d in found if isinstance(d, Damage)] == [len(parts[hit])]


def test_block_with_a_huge_claimed_length_is_refused() -> None:
    """A compressed bomb, or a length from garbage, must not cost the reader time or memory."""
    packed = zlib.compress(bytes(1 << 22), 9)
    head = struct.pack(
        "<4scBHIII",
        MAGIC,
        b"D",
        1,
        0,
        len(packed),
        1000,
        0,
    )
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
def test_can_frame_is_read_as_it_was_written(frame: CanFrame) -> None:
    assert read_frame(frame_data(frame)) == frame


@pytest.mark.parametrize("read", [read_frame, read_numbers])
def test_data_that_is_too_short_is_refused(read: Callable[[bytes], object]) -> None:
    with pytest.raises(ValueError):
        read(b"abc")


# --- wrong contents


VALUES: tuple[Any, ...] = (
    None,
    0,
    -1,
    10**30,
    1.5,
    1e308,
    float("inf"),
    float("nan"),
    True,
    [],
    [1],
    {},
    {"a": 1},
    "",
    "x",
    "1/0",
    "1e9999",
    "9" * 5000,
)
GONE = object()


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench(*made(2, True)).live(3, 1)


@pytest.fixture(scope="module")
def header(bench: Bench) -> dict[str, Any]:
    state = {
        "escs": [{"energy": 1, "run_time": 2, "losses": 3}] * 2,
        "can_state": 1,
        "started_ns": START,
    }
    times = {"monotonic_ns": START, "wall_ns": START, "created_ns": START}
    more = times | {"run": "r", "part": 0, "devices": [None, None], "state": state}
    found: dict[str, Any] = json.loads(json_payload(bench.setup.header() | more))
    return found


def places(found: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of every value in a JSON document."""
    yield path
    children = dict(enumerate(found)) if isinstance(found, list) else found
    if isinstance(children, dict):
        for key, child in children.items():
            yield from places(child, (*path, key))


def changed(document: Any, path: tuple[Any, ...], value: Any) -> Any:
    if not path:
        return value
    made_new = copy.deepcopy(document)
    inner = made_new
    for key in path[:-1]:
        inner = inner[key]
    if value is GONE:
        del inner[path[-1]]
    else:
        inner[path[-1]] = value
    return made_new


def read_all(path: Path) -> None:
    """Read everything of a capture. Only our own errors may occur."""
    lines: tuple[str, ...] = ("read",)
    try:
        with open_input(path) as found:
            assert isinstance(found, CaptureInput)
            found.is_marked = True
            for _ in found.frames():
                pass
            for row in samples(found):
                found.wall_ns(row.time_ns)
            list(found.esc_bytes(1))
            assert found.channel
            assert found.provenance
            assert len(found.damage) < 100
    except (UserError, RunError) as error:
        lines = error.problems
    assert lines
    assert all(line.isprintable() for line in lines)


@pytest.mark.parametrize("seed", range(2))
def test_wrong_header_values_cause_only_our_own_errors(
    seed: int,
    header: dict[str, Any],
    bench: Bench,
    tmp_path: Path,
) -> None:
    path = tmp_path / "a.kcap"
    data = block(b"D", 1, data_payload(bench.entries[:40])) + block(b"E", 2, b"")
    combinations = list(itertools.product(places(header), (*VALUES, GONE)))
    random.Random(seed).shuffle(combinations)
    for place, value in combinations[:30]:
        if not place and value is GONE:
            continue
        document = changed(header, place, value)
        path.write_bytes(block(b"H", 0, json.dumps(document).encode()) + data)
        read_all(path)


PYTHON = re.compile(
    r"codec can't|' object|NoneType|subscript|invalid literal|unhashable|has no attribute|must be|"
    r"unpack|argument|fromhex|\bint\(|\bstr\b|\bdict\b|indices|Expecting|not iterable|expected"
)
"""Words in Python's own error messages."""


def test_refused_header_is_described_in_words_for_users(header: dict[str, Any]) -> None:
    combinations = list(itertools.product(places(header), (*VALUES, GONE)))
    random.Random(7).shuffle(combinations)
    refused = []
    for place, value in combinations[:250]:
        if not place:
            continue
        try:
            CaptureSetup.of(changed(header, place, value))
        except HeaderError as error:
            refused.append((place, value, str(error)))
    assert [each for each in refused if PYTHON.search(each[2])] == []
    assert len(refused) > 50


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        (("dbc", "text"), "Größe 5 €", "dbc: the text of the file has '€', but each character"),
        (("canopen", "eds", "text"), "€", "canopen.eds: the text of the file has '€'"),
        (("canopen", "stored"), ["€"], "canopen.stored has a value of the wrong type or form"),
        (("dbc", "text"), GONE, 'dbc lacks "text"'),
        (("escs", 0, "pole_pairs"), "x", "escs has 'x', which is not a whole number from 1 to"),
        (("run",), 5, "run has '5', which is not a text of at most 4096 characters"),
        (("escs", 0, "gear"), 5, "escs has a value of the wrong type or form"),
        (("canopen", "nodes", 0, "serial"), GONE, 'canopen.nodes lacks "serial"'),
        (("ports",), 7, '"ports" is not a list. Use another part of the run'),
    ],
)
def test_refused_header_names_its_part(
    header: dict[str, Any],
    place: tuple[Any, ...],
    value: Any,
    said: str,
    tmp_path: Path,
) -> None:
    path = tmp_path / "a.kcap"
    path.write_bytes(block(b"H", 0, json_payload(changed(header, place, value))))
    with pytest.raises(UserError) as refused:
        open_input(path)
    assert refused.value.problems[0].startswith(f"{path}: the header cannot be used: {said}")


def test_block_without_json_is_described_in_words_for_users(
    header: dict[str, Any],
    bench: Bench,
    tmp_path: Path,
) -> None:
    path = tmp_path / "a.kcap"
    head = block(b"H", 0, json_payload(header))
    data = block(b"D", 2, data_payload(bench.entries[:40]))
    for wrong in (b"{", b"\xff\xff", b"[" * 100_000, b"7"):
        path.write_bytes(head + block(b"I", 1, wrong) + data)
        with open_input(path) as found:
            list(found.frames())
            (damage,) = [line for line in found.damage if " is " in line]
            assert "JSON" in damage or "nested too deep" in damage
            assert not PYTHON.search(damage)


@pytest.mark.parametrize("part", ["x", [], None])
def test_later_part_without_a_number_is_damage(
    header: dict[str, Any],
    bench: Bench,
    tmp_path: Path,
    part: Any,
) -> None:
    data = block(b"D", 1, data_payload(bench.entries[:40]))
    for number, value in enumerate((0, part), 1):
        document = header | {"run": "a", "part": value}
        path = tmp_path / f"a-{number}.kcap"
        path.write_bytes(block(b"H", 0, json_payload(document)) + data)
    with open_input(tmp_path) as found:
        list(found.frames())
        assert any("has a part number that is not an integer" in line for line in found.damage)


def test_wrong_entries_cause_only_our_own_errors(
    header: dict[str, Any],
    bench: Bench,
    tmp_path: Path,
) -> None:
    path = tmp_path / "a.kcap"
    rng = random.Random(4)
    for _ in range(10):
        entries = list(bench.entries[:100])
        for _ in range(20):
            at = rng.randrange(len(entries))
            entry = entries[at]
            time_ns = rng.choice([0, 2**64 - 1, 2**62 + 1, rng.randrange(2**64)])
            entries[at] = rng.choice(
                [
                    entry._replace(time_ns=time_ns),
                    entry._replace(kind=rng.randrange(256), flags=rng.randrange(256)),
                    entry._replace(esc=rng.randrange(65536)),
                    entry._replace(data=rng.randbytes(rng.randrange(40))),
                    Entry(entry.time_ns, EntryKind.START, flags=1),
                    Entry(entry.time_ns, EntryKind.STATE, 0, b'{"escs": 7}'),
                    Entry(entry.time_ns, EntryKind.SAVED),
                ]
            )
        head = block(b"H", 0, json_payload(header))
        path.write_bytes(head + block(b"D", 1, data_payload(entries)))
        read_all(path)


def test_data_that_only_looks_like_blocks_costs_little_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Many heads promise megabytes, and each would have to be read to its end."""
    head = struct.pack("<4scBHIII", MAGIC, b"D", 0, 0, 8_000_000, 8_000_000, 0) + b"\0\0\0\0"
    data = head * 3000 + bytes(9_000_000)
    costs = [0]
    real = capture._payload

    def counting(
        buffer: bytearray,
        deflated: int,
        stored: int,
        size: int,
    ) -> bytes | None:
        costs[0] += stored
        return real(buffer, deflated, stored, size)

    monkeypatch.setattr(capture, "_payload", counting)
    assert all(isinstance(each, Damage) for each in scanned(data))
    assert 1 << 27 < costs[0] < 1 << 29, "of 24 GB that are promised"


def test_damage_of_a_completely_damaged_file_is_summed_up(
    header: dict[str, Any],
    tmp_path: Path,
) -> None:
    path = tmp_path / "a.kcap"
    empty = block(b"D", 1, data_payload([]))
    path.write_bytes(block(b"H", 0, json_payload(header)) + (empty + b"x") * 20_000)
    with open_input(path) as found:
        assert list(found.frames()) == []
        assert len(found.damage) < 60
        assert "and further damage" in found.damage


def test_header_cannot_forge_lines(header: dict[str, Any], bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "a.kcap"
    entries = block(b"D", 1, data_payload(bench.entries))
    for channel, shown in (("t1", "t1"), ("can0 123#11\\n(1.0) can0", "can0")):
        forged = changed(header, ("configuration",), f'[can]\nchannel = "{channel}"\n')
        path.write_bytes(block(b"H", 0, json_payload(forged)) + entries)
        with open_input(path) as found:
            assert isinstance(found, CaptureInput)
            assert found.channel == shown
    forged = changed(header, ("escs", 0, "name"), "a\nb")
    path.write_bytes(block(b"H", 0, json_payload(forged)) + entries)
    with pytest.raises(UserError, match="header cannot be used"):
        open_input(path)
