"""The states after a power loss that follow from a log of writes and flushes."""

import random
import struct

import block_log
import pytest
from block_log import SECTOR, Entry, Log, State, Write, entries_before, read_entries, torn

pytestmark = pytest.mark.promise("sharp-tests")

A, B, C, D = (letter * SECTOR for letter in (b"a", b"b", b"c", b"d"))
FLUSH = Entry(is_flush=True)


def mark(text: str) -> Entry:
    return Entry(data=text.encode(), is_mark=True)


LOG = Log(
    [
        mark("now=100"),
        Entry(1, A),
        mark("storing=1"),
        Entry(2, B),
        FLUSH,
        Entry(3, C, is_durable=True),
        mark("stored=1"),
        mark("now=200"),
        Entry(4, D),
        Entry(5, A),
        FLUSH,
        mark("now=300"),
    ]
)


def record(sector: int, count: int, flags: int, data: bytes = b"", length: int = 0) -> bytes:
    head = struct.pack("<QQQQ", sector, count, flags, length)
    return (head + data).ljust(SECTOR, b"\0") if flags & 8 else head.ljust(SECTOR, b"\0") + data


def test_log_of_the_kernel_is_read_up_to_its_end() -> None:
    log = bytes(SECTOR)  # the head, which is written later
    log += record(8, 2, 0, A + B)
    log += record(0, 0, 8, b"now=7", 5)
    log += record(16, 2, 4)  # discarded
    log += record(0, 0, 1)
    log += record(24, 1, 3, C)  # a flush that carries data with FUA
    entries, at = read_entries(memoryview(log + bytes(2 * SECTOR)))
    assert entries == [
        Entry(8, A + B),
        mark("now=7"),
        Entry(16, bytes(2 * SECTOR)),
        FLUSH,
        FLUSH,
        Entry(24, C, is_durable=True),
    ]
    assert at == len(log)
    assert read_entries(memoryview(log + bytes(SECTOR)), at) == ([], at)


def test_entries_without_a_mark_behind_them_are_not_returned() -> None:
    log = record(8, 2, 0, A + B) + record(0, 0, 8, b"end=1", 5) + bytes(SECTOR)
    with memoryview(log) as view:
        assert entries_before(view, 0, mark("end=1")) == ([Entry(8, A + B)], 4 * SECTOR)
        assert entries_before(view, 0, mark("end=2")) is None


def test_content_that_is_written_after_its_head_is_read_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole = record(8, 2, 0, A + B) + record(0, 0, 8, b"end=1", 5) + bytes(SECTOR)
    log = bytearray(whole)
    log[SECTOR : 3 * SECTOR] = bytes(2 * SECTOR)

    def read_while_the_kernel_writes(view: memoryview, at: int) -> tuple[list[Entry], int]:
        found = read_entries(view, at)
        log[:] = whole
        return found

    monkeypatch.setattr(block_log, "read_entries", read_while_the_kernel_writes)
    with memoryview(log) as view:
        assert entries_before(view, 0, mark("end=1")) == ([Entry(8, A + B)], 4 * SECTOR)


@pytest.mark.parametrize(
    ("at", "base", "writes"),
    [
        (0, 0, []),
        (2, 0, [(1, A)]),
        (4, 0, [(1, A), (2, B)]),
        (6, 5, [(3, C)]),
        (9, 5, [(3, C), (4, D)]),
        (11, 11, []),
    ],
)
def test_prefix_has_the_flushed_writes_as_its_base(at: int, base: int, writes: list[Write]) -> None:
    assert LOG.prefix(at) == State(base, at, tuple(writes))


@pytest.mark.parametrize(
    ("at", "latest_ns", "stored", "requested"),
    [
        (0, 200, 0, 1),  # the flush has ended by 200, while 1 is being stored
        (5, 200, 0, 1),  # FUA: neither durable nor confirmed
        (6, 300, 0, 1),
        (8, 300, 1, 1),
        (11, 300, 1, 1),
    ],
)
def test_times_and_numbers_of_a_position_follow_from_the_marks(
    at: int, latest_ns: int, stored: int, requested: int
) -> None:
    assert LOG.latest_ns(at) == latest_ns
    assert LOG.stored(at) == stored
    assert LOG.requested(at) == requested


def test_variants_lose_only_writes_that_are_not_durable() -> None:
    generator = random.Random(1)
    seen = {LOG.variant(10, generator).writes for _ in range(300)}
    assert {writes[0] for writes in seen} == {(3, C)}
    rest = {writes[1:] for writes in seen}
    assert rest == {(), ((4, D),), ((5, A),), ((4, D), (5, A))}


def test_durable_write_under_way_may_be_missing_and_counts_as_before_it() -> None:
    generator = random.Random(1)
    states = {LOG.variant(6, generator)[:3] for _ in range(100)}
    assert states == {(5, 5, ()), (5, 5, ((3, C),))}


@pytest.mark.parametrize("unit", [SECTOR, 2 * SECTOR])
def test_torn_write_reaches_the_device_in_whole_units(unit: int) -> None:
    entry = Entry(10, A + B + C + D)
    generator = random.Random(1)
    seen = {tuple(torn(entry, unit, generator)) for _ in range(500)}
    parts = [(10 + at // SECTOR, entry.data[at : at + unit]) for at in range(0, 4 * SECTOR, unit)]
    assert len(seen) == 2 ** len(parts)
    assert {part for found in seen for part in found} == set(parts)


@pytest.mark.parametrize("count", [2, 6, 40])
def test_states_come_in_the_order_of_the_log_each_base_first(count: int) -> None:
    states = LOG.states(count, random.Random(1))
    assert [state.base for state in states] == sorted(state.base for state in states)
    for base in {state.base for state in states}:
        first = next(state for state in states if state.base == base)
        assert (first.at, first.writes) == (base, ())
    prefixes = {state.at for state in states if state.kind == "prefix"}
    assert count < 40 or prefixes >= set(LOG.positions())
    assert len(states) >= count
    assert states == LOG.states(count, random.Random(1))
