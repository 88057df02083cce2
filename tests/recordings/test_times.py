"""Times of a log count from its earliest frame, and the time of day is right wherever the log has it."""

import csv
import json
from datetime import UTC, datetime
from pathlib import Path

import can
import pytest
from command_line import run
from log_files import opened

from kontronik_can_gw.frames import CanFrame

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


def _mf4(path: Path, times_ms: tuple[int, ...], start_s: float, base_s: float = 0.0) -> Path:
    """An MF4 log with ``start_s`` in its header, and times that count from ``start_s - base_s``."""
    writer = can.MF4Writer(path)
    writer._mdf.header.start_time = datetime.fromtimestamp(start_s, UTC)
    writer._start_time = 0.0
    for ms in times_ms:
        writer.on_message_received(
            can.Message(base_s + ms / 1000, 0x688, False, data=DATA, channel=1, is_rx=True)
        )
    writer.stop()
    return path


def _check(log: Path, times_ms: tuple[int, ...], start_s: float | None = START_S) -> None:
    """The log as a table, a report, a screen and another log."""
    begin_ms = times_ms[0]
    done = run("convert", log, log.with_suffix(".csv"), "--signals", "battery_voltage")
    assert (done.code, "damaged" in done.err) == (0, False), done.err
    with log.with_suffix(".csv").open() as file:
        rows = list(csv.DictReader(file))
    found = [round(float(row["Time [s]"]) * 1000) for row in rows if row["battery_voltage [V]"]]
    assert found == [ms - begin_ms for ms in times_ms]
    assert ("Utc" in rows[0]) == (start_s is not None)
    if start_s is not None:
        first = datetime.fromisoformat(rows[0]["Utc"])
        assert abs(first.timestamp() - (start_s + begin_ms / 1000)) <= 2e-6
    length = (times_ms[-1] - begin_ms) / 1000
    done = run("report", log, "-o", log.with_suffix(".html"))
    assert f"<dt>Length</dt><dd>{length:.1f} s" in log.with_suffix(".html").read_text(), done.err
    shown = json.loads(run("monitor", "--once", log).out)
    assert shown["escs"][0]["values"]["battery_voltage"] == 25
    if start_s is not None:
        shown_s = datetime.fromisoformat(shown["time"]).timestamp()
        assert abs(shown_s - (start_s + times_ms[-1] / 1000)) <= 0.001
    assert run("convert", log, log.with_suffix(".blf")).code == 0
    with opened(log.with_suffix(".blf")) as copy:
        frames = list(copy.frames())
        wall_ns = copy.wall_ns(frames[0].time_ns)
    found = [round((item.time_ns - frames[0].time_ns) / MS) for item in frames]
    assert found == [ms - begin_ms for ms in times_ms]
    assert [item.frame for item in frames] == [CanFrame(0x688, DATA)] * len(times_ms)
    if start_s is not None:
        assert wall_ns is not None
        assert abs(wall_ns / 1e9 - start_s - begin_ms / 1000) < 1e-5


def test_frames_before_the_trigger_of_an_asc_log_are_read(tmp_path: Path) -> None:
    _check(_asc(tmp_path / "trigger.asc", TIMES_MS), TIMES_MS)


@pytest.mark.parametrize("years", [0, 3])
def test_frames_before_the_start_of_an_mf4_log_are_read(tmp_path: Path, years: int) -> None:
    """python-can starts its MF4 files now, so that frames of older logs have times far below 0."""
    later_s = years * 365 * 86_400
    _check(_mf4(tmp_path / "log.mf4", TIMES_MS, START_S + later_s, -later_s), TIMES_MS)


@pytest.mark.parametrize("start_s", [0, START_S + 1e8])
def test_unix_times_in_an_mf4_log_are_the_time_of_day(tmp_path: Path, start_s: float) -> None:
    _check(_mf4(tmp_path / "log.mf4", TIMES_MS, start_s, START_S), TIMES_MS)


def test_unix_times_in_an_asc_log_are_the_time_of_day(tmp_path: Path) -> None:
    times = tuple(START_S * 1000 + ms for ms in TIMES_MS)
    _check(_asc(tmp_path / "unix.asc", times), times, 0)


@pytest.mark.parametrize("moved", [[0], [0, 1, 2], [5], [0, 20, 39]])
def test_an_unordered_mf4_log_is_read_in_order(tmp_path: Path, moved: list[int]) -> None:
    """``moved``: frames that stand in front of earlier ones."""
    times = tuple(range(0, 400, 10))
    rest = [ms for n, ms in enumerate(times) if n not in moved]
    stored = [*(times[-1] + 5000 + n for n in moved), *rest]
    if moved == [5]:  # in the middle
        stored = [*rest[:20], stored[0], *rest[20:]]
    _check(_mf4(tmp_path / "log.mf4", tuple(stored), START_S), tuple(sorted(stored)))


def test_an_mf4_log_without_a_date_has_no_time_of_day(tmp_path: Path) -> None:
    _check(_mf4(tmp_path / "log.mf4", TIMES_MS, 0), TIMES_MS, None)


def test_an_asc_log_unordered_at_its_start_keeps_all_times(tmp_path: Path) -> None:
    log = _asc(tmp_path / "order.asc", (5, 0, 10, 20))
    assert run("convert", log, tmp_path / "copy.asc").code == 0
    with opened(tmp_path / "copy.asc") as copy:
        assert [item.time_ns // MS for item in copy.frames()] == [5, 0, 10, 20]
        assert (copy.wall_ns(0) or 0) // MS == START_S * 1000
