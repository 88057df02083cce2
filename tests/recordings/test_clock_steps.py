"""The spacing of frames does not change if the clock was set during the recording."""

import csv
import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import can
import pytest
from capture_bench import Bench, capture_file, made
from command_line import run
from log_files import SUFFIX, Item, message_of, opened, write_log
from recordings import WALL_NS, candump_log

from kontronik_can_gw.capture.format import Entry, EntryKind, numbers_data
from kontronik_can_gw.desk.recordings.inputs import open_input
from kontronik_can_gw.desk.recordings.log_clock import LogClock
from kontronik_can_gw.desk.recordings.recording import ClockStep, LogFrame
from kontronik_can_gw.frames import CanFrame

pytestmark = pytest.mark.promise("log-times")

MS = 1_000_000
HOUR_NS = 3_600_000 * MS
SET_BACK = "the clock was set back by 1 h 00 min 00 s after {} s; times continue without the step"


def _cyclic(count: int, period_ns: int = 10 * MS) -> list[Item]:
    """Return two messages for each period, the second one 2 ms after the first."""
    items: list[Item] = []
    for number in range(count):
        now = number * period_ns
        data = bytes((number & 255,) * 8)
        items.append((now, CanFrame(0x688, data), True))
        items.append((now + 2 * MS, CanFrame(0x690, data), True))
    return items


def _moved(items: list[Item], by_ns: Callable[[int], int]) -> list[Item]:
    """Return the same frames, each delayed by ``by_ns`` of its time."""
    return [(time_ns + by_ns(time_ns), *rest) for time_ns, *rest in items]  # type: ignore[misc]


def _write_by_library(path: Path, items: list[Item]) -> None:
    with can.Logger(path) as writer:
        for item in items:
            writer(message_of(item))


@pytest.mark.parametrize("format_", ["candump", "asc", "trc", "blf", "mf4"])
def test_spacing_continues_when_the_clock_is_set_back(tmp_path: Path, format_: str) -> None:
    even = _cyclic(100)
    stepped = _moved(even, lambda time_ns: HOUR_NS * (time_ns < 500 * MS))
    path = tmp_path / f"log{SUFFIX[format_]}"
    if format_ == "mf4":  # our writer only writes rising times
        start_ns = 1_700_000_000 * 1000 * MS
        _write_by_library(path, _moved(stepped, lambda _: start_ns))
    else:
        write_log(path, format_, stepped)
    with opened(path) as log:
        found = list(log.frames())
        first_ns = found[0].time_ns
        log.begin_ns = first_ns
        assert log.damage == []
        assert log.clock_notes == [SET_BACK.format("0.5")]
        first_wall_ns = log.wall_ns(first_ns)
        last_wall_ns = log.wall_ns(found[-1].time_ns)
    assert [item.frame for item in found] == [frame for _, frame, _ in even]
    slack_ns = 2000 if format_ == "mf4" else 0  # MF4 has floats
    for item, (time_ns, _, _) in zip(found, even, strict=True):
        assert abs(item.time_ns - first_ns - time_ns) <= slack_ns
    assert first_wall_ns is not None
    assert last_wall_ns is not None
    passed_ns = last_wall_ns - first_wall_ns  # the time of day continues, too
    assert abs(passed_ns - even[-1][0]) < 2000


def _with_clock_set_back(log: Path, path: Path) -> Path:
    """Write a copy of a candump log whose clock was set back by an hour after 1.5 s."""
    first: list[float] = []

    def moved(found: "re.Match[str]") -> str:
        seconds = float(found[1])
        first.append(seconds)
        if seconds >= first[0] + 1.5:
            seconds -= 3600
        return f"({seconds:.6f})"

    path.write_text(re.sub(r"\((\d+\.\d+)\)", moved, log.read_text()))
    return path


def test_tables_reports_and_logs_are_as_with_a_steady_clock(tmp_path: Path) -> None:
    even = candump_log(tmp_path / "even.log")
    back = _with_clock_set_back(even, tmp_path / "back.log")
    note = f"{back}: {SET_BACK.format('1.5')}"

    def result(suffix: str, *words: object) -> list[bytes]:
        """Return the outputs of a command for both logs."""
        found = []
        out = tmp_path / f"out{suffix}"
        for log in (even, back):
            done = run(words[0], *words[1:], log, "-o", out, "--force")
            assert (note in done.err) == (log is back), done.err
            found.append(out.read_bytes())
        return found

    table, table_of_back = result(".csv", "convert")
    assert table.count(b"\n") > 250
    assert table == table_of_back
    for suffix in (".log", ".asc", ".blf", ".trc"):
        log_of_even, log_of_back = result(suffix, "convert", "-q")
        assert log_of_even == log_of_back
        again = tmp_path / "again.csv"
        run("convert", "-q", tmp_path / f"out{suffix}", again, "--force")
        assert again.read_bytes() == table, suffix
    page, page_of_back = result(".html", "report")
    clock = f"<div><dt>Clock</dt><dd>{SET_BACK.format('1.5')}</dd></div>"
    page_of_back = page_of_back.replace(back.name.encode(), even.name.encode())
    assert page == page_of_back.replace(clock.encode(), b"")
    assert f"warning: {SET_BACK.format('1.5')}" in run("monitor", "--once", back).err


def _read(
    times: list[int], ids: Callable[[int], int] = lambda _: 0x100
) -> tuple[list[int], LogClock]:
    """Read frames with these times in ms, and return their continuous times in ms."""
    frames = []
    for number, time_ms in enumerate(times):
        frames.append(LogFrame(time_ms * MS, CanFrame(ids(number), b"")))
    clock = LogClock(frames)
    return [item.time_ns // MS for item in clock.frames()], clock


@pytest.mark.parametrize(
    ("count", "by_ms", "is_step"), [(10, 111, True), (9, 111, False), (10, 110, False)]
)
def test_ten_frames_that_go_back_by_more_than_100_ms_are_a_step(
    count: int,
    by_ms: int,
    is_step: bool,
) -> None:
    """The frames have a period of 1 ms and follow a frame at 100 ms."""
    before = list(range(101))
    back = [101 + number - by_ms for number in range(count)]
    found, clock = _read([*before, *back, 200])
    if is_step:
        assert found == [*before, *range(101, 111), 200 + by_ms]
        assert clock.steps == [ClockStep(101 * MS, -by_ms * MS)]
    else:
        assert found == [*before, *back, 200]
        assert clock.steps == []
    assert clock.impossible == 0


def test_second_step_adds_to_the_first() -> None:
    times = [*range(1000, 1200), *range(500, 700), *range(100, 300)]
    found, clock = _read(times)
    assert found == [*range(1000, 1600)]
    assert [step.by_ns // MS for step in clock.steps] == [-700, -600]


def test_gap_at_a_step_is_taken_from_the_periods_of_the_ids() -> None:
    """Frame 0x200 is sent every 100 ms and 0x100 every 10 ms. The step is before a frame 0x200."""
    fast = [(ms, 0x100) for ms in range(0, 1000, 10)]
    slow = [(ms, 0x200) for ms in range(3, 1000, 100)]
    frames = sorted([*fast, *slow])
    even = [ms for ms, _ in frames]
    times = [ms if ms < 503 else ms - 400 for ms in even]
    found, clock = _read(times, lambda number: frames[number][1])
    assert found == even
    assert clock.steps == [ClockStep(503 * MS, -400 * MS)]


@pytest.mark.parametrize("ahead_ms", [3000, 40_000])
def test_one_frame_ahead_of_the_others_is_not_a_step(ahead_ms: int) -> None:
    times = [*range(500), 500 + ahead_ms, *range(501, 1000)]
    found, clock = _read(times)
    assert clock.steps == []
    if ahead_ms > 10_000:  # its time is damaged
        del times[500]
    assert found == times
    assert clock.impossible == (ahead_ms > 10_000)


def test_jump_ahead_is_kept_and_reported(tmp_path: Path) -> None:
    items = _moved(_cyclic(100), lambda time_ns: HOUR_NS * (time_ns >= 500 * MS))
    path = tmp_path / "ahead.log"
    write_log(path, "candump", items)
    done = run("convert", path, tmp_path / "out.blf")
    jump = "by 1 h 00 min 00 s after 0.5 s: a pause, or the clock was set; the jump is kept"
    assert f"{path}: times jump ahead {jump}" in done.err
    with opened(tmp_path / "out.blf") as log:
        times = [item.time_ns for item in log.frames()]
    assert [time_ns - times[0] for time_ns in times] == [time_ns for time_ns, *_ in items]


@pytest.mark.parametrize(
    ("by_s", "words"), [(-3600, "back by 1 h 00 min 00 s"), (7200, "ahead by 2 h 00 min 00 s")]
)
def test_clock_set_during_a_capture_is_reported(tmp_path: Path, by_s: int, words: str) -> None:
    bench = Bench(*made()).live(3, 4)
    paths = []
    for name in ("steady", "set"):
        entries = list(bench.entries)
        if name == "set":
            middle = len(entries) // 2
            now = entries[middle].time_ns
            wall_ns = WALL_NS + now - entries[0].time_ns + by_s * 1000 * MS
            entries.insert(middle + 1, Entry(now, EntryKind.CLOCK, 0, numbers_data(wall_ns)))
        paths.append(tmp_path / f"{name}.kcap")
        paths[-1].write_bytes(capture_file(bench.setup, entries, wall_ns=WALL_NS))
    note = f"set.kcap: the clock was set {words} after "
    tables = []
    for path in paths:
        done = run("convert", path, tmp_path / "out.csv", "--force")
        assert (note in done.err) == (path is paths[1]), done.err
        with (tmp_path / "out.csv").open() as file:
            tables.append([row[:1] + row[2:] for row in csv.reader(file)])
    assert tables[0] == tables[1]
    done = run("convert", "-q", paths[1], tmp_path / "out.asc")
    assert note in done.err
    with open_input(tmp_path / "out.asc") as log:
        times = [item.time_ns for item in log.frames()]
    assert max(b - a for a, b in pairwise(times)) < 1000 * MS
