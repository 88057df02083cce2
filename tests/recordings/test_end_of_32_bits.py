"""Captures, tables and CAN logs whose wall clock passes the end of seconds of 32 bits.

A signed number ends in 2038, and an unsigned one in 2106.
"""

import csv
from datetime import UTC, datetime
from pathlib import Path

import pytest
from capture_bench import Bench, capture_file, made
from command_line import run
from log_files import SUFFIX, Item, at_wall, read_by_library, read_log, some_frames, write_log

from kontronik_can_gw.native.load import PURE, library
from kontronik_can_gw.times import SECOND

pytestmark = pytest.mark.promise("log-times")

ENDS = [1 << 31, 1 << 32]
"""Unix times in s."""
BEFORE_NS = SECOND // 2
MICROSECOND = 1000


def _crossing(end_s: int, fd: bool) -> tuple[list[Item], int]:
    """Return frames, half of them before the end, and the wall clock of the time 0."""
    items = some_frames(100, fd=fd)
    middle_ns, *_ = items[50]
    return items, end_s * SECOND - middle_ns


@pytest.mark.parametrize("end_s", ENDS)
@pytest.mark.parametrize("format_", sorted(SUFFIX))
def test_can_log_is_read_by_us_as_it_was_written(tmp_path: Path, format_: str, end_s: int) -> None:
    """python-can must agree, except about fractions of a microsecond. Its times are floats."""
    items, start_ns = _crossing(end_s, fd=format_ != "trc")
    path = tmp_path / f"log{SUFFIX[format_]}"
    write_log(path, format_, items, start_ns)
    wanted = at_wall(items, start_ns)
    found, damage = read_log(path)
    assert damage == []
    for readings in (found, read_by_library(path, format_)):
        assert len(readings) == len(wanted)
        for one, other in zip(readings, wanted, strict=True):
            assert one[1:] == other[1:]
            assert abs(one[0] - other[0]) <= MICROSECOND


@pytest.mark.parametrize("end_s", ENDS)
@pytest.mark.parametrize("pure", ["0", "1"])
def test_table_of_a_capture_has_the_right_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pure: str, end_s: int
) -> None:
    """``pure`` is 1 for the conversion in Python, and 0 for the one in C."""
    monkeypatch.setenv(PURE, pure)
    library.cache_clear()
    bench = Bench(*made(1)).live(3, 2)
    start_ns = end_s * SECOND - BEFORE_NS
    source = tmp_path / "flight.kcap"
    source.write_bytes(capture_file(bench.setup, bench.entries, wall_ns=start_ns))
    table = tmp_path / "flight.csv"
    done = run("convert", source, table)
    library.cache_clear()
    assert done.code == 0, done.err
    with table.open() as file:
        rows = list(csv.DictReader(file))
    walls = [datetime.fromisoformat(row["Utc"]) for row in rows]
    end = datetime.fromtimestamp(end_s, UTC)
    assert walls[0] < end < walls[-1]
    first_s = float(rows[0]["Time [s]"])
    for wall, row in zip(walls, rows, strict=True):
        since_first_s = float(row["Time [s]"]) - first_s
        assert (wall - walls[0]).total_seconds() == pytest.approx(since_first_s, abs=2e-6)
    assert 0 <= (walls[0] - end).total_seconds() + BEFORE_NS / SECOND < 0.2
