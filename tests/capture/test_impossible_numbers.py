"""Numbers in a capture that are impossible for a gateway are rejected by both cores.

They never exceed 64 bits in the C core.
"""

import struct
from pathlib import Path
from typing import Any

import pytest
from capture_bench import START, Bench, capture, made, samples

from kontronik_can_gw.capture.format import (
    RECORDED_COUNTERS,
    Entry,
    EntryKind,
    json_payload,
    numbers_data,
)
from kontronik_can_gw.capture.limits import check_state
from kontronik_can_gw.desk.recordings.inputs import open_input
from kontronik_can_gw.desk.recordings.replay import Replay
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import MAX_COUNT, MAX_ENERGY
from kontronik_can_gw.times import END_OF_TIME

pytestmark = pytest.mark.promise("damaged-captures")

GOOD = {
    "escs": [{"energy": 5, "run_time": 6, "losses": 7}],
    "can_state": 1,
    "started_ns": START,
}


def _with(name: str, number: int) -> dict[str, Any]:
    if name in ("energy", "run_time", "losses"):
        return GOOD | {"escs": [GOOD["escs"][0] | {name: number}]}  # type: ignore[index]
    return GOOD | {name: number}


LIMITS = {
    "energy": MAX_ENERGY * 10**9,
    "run_time": END_OF_TIME - 1,
    "losses": MAX_COUNT - 1,
    "started_ns": END_OF_TIME - 1,
    "can_state": 5,
}


@pytest.mark.parametrize("name", LIMITS)
def test_impossible_state_is_refused_in_header_and_entry(name: str, tmp_path: Path) -> None:
    check_state(_with(name, LIMITS[name]))
    for number in (LIMITS[name] + 1, 1 << 100, -1):
        with pytest.raises(ValueError, match="is not a whole number"):
            check_state(_with(name, number))
    bench = Bench(*made(1)).live(1, 0.5)
    bad = capture(tmp_path / "bad.kcap", bench.setup, bench.entries, state=_with(name, 1 << 100))
    with pytest.raises(UserError), open_input(bad):
        pass


STREAM = {"counters": [1] * 14, "held": 3, "window": [4, 1, 1, 1, 1, -1, 5]}


@pytest.mark.parametrize(
    "bad",
    [
        {"counters": [-1] * 14},
        {"counters": [1 << 64]},
        {"held": 256},
        {"window": [4, 1, 1, 1, 1, -2, 5]},
        {"window": [4, 1, 1, 1, 1, 1 << 31, 5]},
        {"window": [4]},
        {"late_frames": -1},
    ],
)
def test_impossible_state_of_a_stream_is_refused(bad: dict[str, Any]) -> None:
    def with_stream(stream: dict[str, Any]) -> dict[str, Any]:
        return GOOD | {"escs": [GOOD["escs"][0] | stream]}  # type: ignore[index]

    check_state(with_stream(STREAM))
    with pytest.raises(ValueError):
        check_state(with_stream(STREAM | bad))


@pytest.mark.parametrize(
    ("key", "bad"),
    [
        ("messages", [[1 << 16, 0, 0, -1, 0]]),
        ("messages", [[0, 256, 0, -1, 0]]),
        ("messages", [[0, 0, END_OF_TIME, -1, 0]]),
        ("messages", [[0, 0, 0, -2, 0]]),
        ("messages", [[0, 0, 0, -1, 2]]),
        ("messages", [[0, 0]]),
        ("counters", [-1] * len(RECORDED_COUNTERS)),
    ],
)
def test_impossible_counters_of_messages_and_gateway_are_refused(key: str, bad: object) -> None:
    check_state(
        GOOD | {"messages": [[3, 0, START, -1, 0]], "counters": [1] * len(RECORDED_COUNTERS)}
    )
    with pytest.raises(ValueError):
        check_state(GOOD | {key: bad})


@pytest.mark.parametrize("pure", [False, True])
def test_hostile_state_cannot_leave_the_ranges_of_the_core(
    pure: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if pure:
        monkeypatch.setenv("KONTRONIK_PURE", "1")
    bench = Bench(*made(1)).live(1, 3)
    stream = {"counters": [0] * 14, "held": 255, "window": [0, 9, 9, 9, 9, 7, END_OF_TIME - 1]}
    state = GOOD | {
        "escs": [GOOD["escs"][0] | stream],  # type: ignore[index]
        "messages": [[0xFFFF, 0xFF, 0, END_OF_TIME - 1, 1]] * 100,
        "counters": [1] * len(RECORDED_COUNTERS),
    }
    check_state(state)
    replay = Replay(bench.setup.gateway(bench.layout, START), state)
    data = json_payload(state)
    entries = [entry for entry in bench.entries if entry.kind != EntryKind.START]
    middle = len(entries) // 2
    entries.insert(middle, Entry(entries[middle].time_ns, EntryKind.STATE, data=data))
    assert len(list(replay.follow(entries))) > 100


@pytest.mark.parametrize(
    "started_ns",
    [END_OF_TIME, (1 << 63) - 1, 1 << 63, (1 << 64) - 1],
)
def test_impossible_counters_are_rejected_and_change_nothing(started_ns: int) -> None:
    bench = Bench(*made(1)).live(1, 0.5)
    counters = [3] * (len(RECORDED_COUNTERS) - 2)  # the last two are start and restarts
    good = numbers_data(*counters, START - 77, 4)
    now = bench.entries[-1].time_ns
    gateway = bench.setup.gateway(bench.layout, START)
    replay = Replay(gateway)
    late_start = numbers_data(*counters, started_ns, 4)
    high_count = numbers_data(*counters[1:], MAX_COUNT, START, 4)
    many_restarts = numbers_data(*counters, START, MAX_COUNT)
    for bad in (late_start, high_count, many_restarts):
        entries = [Entry(now, EntryKind.COUNTERS, 0, data) for data in (good, bad)]
        list(replay.follow(entries))
    assert replay.rejected == 3
    assert gateway.status.started_ns == START - 77
    assert gateway.status.sent_frames == 3
    assert gateway.status.can_restarts == 4


def test_counters_of_version_0_5_are_read() -> None:
    bench = Bench(*made(1)).live(1, 0.5)
    now = bench.entries[-1].time_ns
    replay = Replay(bench.setup.gateway(bench.layout, START))
    counters = numbers_data(*[3] * (len(RECORDED_COUNTERS) - 2), START)
    list(replay.follow([*bench.entries, Entry(now, EntryKind.COUNTERS, 0, counters)]))
    assert replay.rejected == 0
    assert replay.gateway.status.sent_frames == 3


@pytest.mark.parametrize("time_ns", [END_OF_TIME, (1 << 63) - 1])
def test_impossible_time_is_rejected(time_ns: int) -> None:
    bench = Bench(*made(1)).live(1, 0.5)
    replay = Replay(bench.setup.gateway(bench.layout, START))
    list(replay.follow(bench.entries))
    impossible = [
        Entry(time_ns, EntryKind.ADVANCE),
        Entry(START, EntryKind.BYTES, data=b"K", came_ns=time_ns),
    ]
    list(replay.follow(impossible))
    assert replay.rejected == 2


def test_rows_of_a_capture_with_impossible_counters_are_equal_in_c(
    native_library: Any,
    tmp_path: Path,
) -> None:
    """A table's uptime is computed from ``started_ns``."""
    from offline_equality import core

    bench = Bench(*made(1)).live(1, 1)
    half = len(bench.entries) // 2
    now = bench.entries[half].time_ns
    data = struct.pack(
        "<8Q",
        9,
        9,
        9,
        9,
        9,
        9,
        9,
        (1 << 63) - 1,
    )
    entries = [
        *bench.entries[:half],
        Entry(now, EntryKind.COUNTERS, 0, data),
        *bench.entries[half:],
    ]
    path = capture(tmp_path / "far.kcap", bench.setup, entries)
    found = []
    for library in (native_library, None):
        with core(library), open_input(path) as recording:
            found.append([*samples(recording)])
            assert any("cannot be interpreted" in text for text in recording.damage)
    assert found[0] == found[1]
    assert len(found[0]) > 20
