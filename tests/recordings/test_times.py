"""Times of a log count from its earliest frame, and the time of day is right if the log has it."""

import csv
import json
from datetime import UTC, datetime
from pathlib import Path

import can
import pytest
from command_line import run
from log_files import opened

from kontronik_can_gw.frames import CanFrame

pytestmark = pytest.mark.promise("log-times")

MS = 1_000_000
START_S = 1_700_000_000
TIMES_MS = (-500, -490, -480, 0, 10, 20)
DATA = bytes.fromhex("000000C409001400")
LENGTH = TIMES_MS[-1] - TIMES_MS[0]


def _asc(path: Path, times_ms: tuple[int, ...]) -> Path:
    date = datetime.fromtimestamp(START_S).strftime("%a %b %d %H:%M:%S.000 %Y")  # noqa: DTZ006
    lines = [f"{ms / 1000: 9.6f} 1  688   Rx   d 8 {DATA.hex(' ')}\n" for ms in times_ms]
    path.write_text(f"date {date}\nbase hex  timestamps absolute\n{''.join(lines)}")
    return path


def _mf4(
    path: Path,
    times_ms: tuple[int, ...],
    start_s: float,
    base_s: float = 0.0,
) -> Path:
    """Write an MF4 log with ``start_s`` in its header.

    Its times count from ``start_s - base_s``.
    """
    writer = can.MF4Writer(path)
    writer._mdf.header.start_time = datetime.fromtimestamp(start_s, UTC)
    writer._start_time = 0.0
    for ms in times_ms:
        message = can.Message(
            base_s + ms / 1000,
            0x688,
            False,
            data=DATA,
            channel=1,
            is_rx=True,
        )
        writer.on_message_received(message)
    writer.stop()
    return path


def _check(log: Path, times_ms: tuple[int, ...], start_s: float | None = START_S) -> None:
    """Assert that all commands read a log with these times.

    ``start_s`` is the Unix time of the time 0, or None if the log has no time of day.
    """
    begin_ms = times_ms[0]
    begin_s = None
    end_s = None
    if start_s is not None:
        begin_s = start_s + begin_ms / 1000
        end_s = start_s + times_ms[-1] / 1000
    from_begin = [ms - begin_ms for ms in times_ms]
    _check_table(log, from_begin, begin_s)
    _check_report(log, from_begin[-1])
    _check_screen(log, end_s)
    _check_copy(log, from_begin, begin_s)


def _check_table(log: Path, times_ms: list[int], begin_s: float | None) -> None:
    table = log.with_suffix(".csv")
    done = run("convert", log, table, "--signals", "battery_voltage")
    assert done.code == 0, done.err
    assert "damaged" not in done.err
    with table.open() as file:
        rows = list(csv.DictReader(file))
    with_value = [row for row in rows if row["battery_voltage [V]"]]
    found = [round(float(row["Time [s]"]) * 1000) for row in with_value]
    assert found == times_ms
    assert ("Utc" in rows[0]) == (begin_s is not None)
    if begin_s is not None:
        first = datetime.fromisoformat(rows[0]["Utc"])
        assert abs(first.timestamp() - begin_s) <= 2e-6


def _check_report(log: Path, length_ms: int) -> None:
    page = log.with_suffix(".html")
    done = run("report", log, "-o", page)
    assert f"<dt>Length</dt><dd>{length_ms / 1000:.1f} s" in page.read_text(), done.err


def _check_screen(log: Path, end_s: float | None) -> None:
    shown = json.loads(run("monitor", "--once", log).out)
    assert shown["escs"][0]["values"]["battery_voltage"] == 25
    if end_s is not None:
        shown_s = datetime.fromisoformat(shown["time"]).timestamp()
        assert abs(shown_s - end_s) <= 0.001


def _check_copy(log: Path, times_ms: list[int], begin_s: float | None) -> None:
    path = log.with_suffix(".blf")
    assert run("convert", log, path).code == 0
    with opened(path) as copy:
        frames = list(copy.frames())
        first_ns = frames[0].time_ns
        wall_ns = copy.wall_ns(first_ns)
    found = [round((item.time_ns - first_ns) / MS) for item in frames]
    assert found == times_ms
    assert [item.frame for item in frames] == [CanFrame(0x688, DATA)] * len(times_ms)
    if begin_s is not None:
        assert wall_ns is not None
        assert abs(wall_ns / 1e9 - begin_s) < 1e-5


def test_frames_before_the_trigger_of_an_asc_log_are_read(tmp_path: Path) -> None:
    _check(_asc(tmp_path / "trigger.asc", TIMES_MS), TIMES_MS)


@pytest.mark.parametrize("years", [0, 3])
def test_frames_before_the_start_of_an_mf4_log_are_read(tmp_path: Path, years: int) -> None:
    """python-can starts its MF4 files at the present time.

    So the frames of older logs have times far below 0.
    """
    later_s = years * 365 * 86_400
    _check(_mf4(tmp_path / "log.mf4", TIMES_MS, START_S + later_s, -later_s), TIMES_MS)


@pytest.mark.parametrize("start_s", [0, START_S + 1e8])
def test_unix_times_in_an_mf4_log_are_the_time_of_day(tmp_path: Path, start_s: float) -> None:
    _check(_mf4(tmp_path / "log.mf4", TIMES_MS, start_s, START_S), TIMES_MS)


def test_unix_times_in_an_asc_log_are_the_time_of_day(tmp_path: Path) -> None:
    times = tuple(START_S * 1000 + ms for ms in TIMES_MS)
    _check(_asc(tmp_path / "unix.asc", times), times, 0)


@pytest.mark.parametrize(
    "moved",
    [
        [0],
        [0, 1, 2],
        [5],
        [0, 20, 39],
    ],
)
def test_unordered_mf4_log_is_read_in_order(tmp_path: Path, moved: list[int]) -> None:
    """``moved`` has the numbers of frames that are stored before earlier frames."""
    times = tuple(range(0, 400, 10))
    rest = [ms for n, ms in enumerate(times) if n not in moved]
    late = [times[-1] + 5000 + n for n in moved]
    stored = [*late, *rest]
    if moved == [5]:  # in the middle
        stored = [*rest[:20], *late, *rest[20:]]
    log = _mf4(tmp_path / "log.mf4", tuple(stored), START_S)
    _check(log, tuple(sorted(stored)))


def test_mf4_log_without_a_date_has_no_time_of_day(tmp_path: Path) -> None:
    _check(_mf4(tmp_path / "log.mf4", TIMES_MS, 0), TIMES_MS, None)


def test_asc_log_unordered_at_its_start_keeps_all_times(tmp_path: Path) -> None:
    log = _asc(tmp_path / "order.asc", (5, 0, 10, 20))
    assert run("convert", log, tmp_path / "copy.asc").code == 0
    with opened(tmp_path / "copy.asc") as copy:
        assert [item.time_ns // MS for item in copy.frames()] == [5, 0, 10, 20]
        assert (copy.wall_ns(0) or 0) // MS == START_S * 1000
