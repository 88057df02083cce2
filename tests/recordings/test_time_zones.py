"""Times in tables and logs on a machine whose local time is not UTC.

All recordings start at 2023-11-14 22:13:20.250 UTC, which is 2023-11-15 03:43:20.250 there.
"""

import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest
from log_files import READERS, SUFFIX, at_wall, read_by_library, read_log, some_frames, write_log
from recordings import WALL_NS, capture_bytes, convert
from test_tables import Cells, read_csv, read_jsonl, read_parquet

pytestmark = pytest.mark.promise("log-times")


def test_local_time_is_not_utc() -> None:
    """Otherwise this file proves nothing: see tests/conftest.py."""
    assert time.localtime(0)[3:5] == (5, 30)


@pytest.mark.parametrize("core_language", ["C", "Python"], indirect=True)
@pytest.mark.parametrize(
    ("suffix", "read"), [(".csv", read_csv), (".jsonl", read_jsonl), (".parquet", read_parquet)]
)
def test_table_has_utc(tmp_path: Path, suffix: str, read: Callable[[Path], Cells]) -> None:
    source = tmp_path / "flight.kcap"
    target = tmp_path / f"flight{suffix}"
    source.write_bytes(capture_bytes(1, seconds=1.0))
    assert convert(source, target) == 0
    rows = read(target)
    assert len(rows) > 50
    begin = datetime(2023, 11, 14, 22, 13, 20, 250_000, tzinfo=UTC)
    for row in rows:
        assert row["Utc"].endswith("Z")
        since = (datetime.fromisoformat(row["Utc"]) - begin).total_seconds()
        # the first row is 8.5 ms after the start, and microseconds are cut, not rounded
        assert row["Time"] + 0.0084 < since < row["Time"] + 0.0086


@pytest.mark.parametrize("format_", sorted(READERS))
def test_log_has_the_same_unix_times_for_us_and_for_python_can(
    tmp_path: Path, format_: str
) -> None:
    path = tmp_path / f"log{SUFFIX[format_]}"
    items = some_frames(30)
    write_log(path, format_, items, WALL_NS)
    assert read_by_library(path, format_) == at_wall(items, WALL_NS)
    found, damage = read_log(path)
    assert damage == []
    for (time_ns, *rest), (expected_ns, *expected) in zip(
        found,
        at_wall(items, WALL_NS),
        strict=True,
    ):
        assert abs(time_ns - expected_ns) < 1000
        assert rest == expected


def test_head_of_asc_is_local_time_and_that_of_trc_is_utc(tmp_path: Path) -> None:
    write_log(tmp_path / "log.asc", "asc", some_frames(1), WALL_NS)
    head = (tmp_path / "log.asc").read_text().splitlines()
    assert head[0] == "date Wed Nov 15 03:43:20.250 2023"
    assert head[3] == "Begin Triggerblock Wed Nov 15 03:43:20.250 2023"
    write_log(tmp_path / "log.trc", "trc", some_frames(1), WALL_NS)
    text = (tmp_path / "log.trc").read_text()
    assert ";   Start time: 2023-11-14 22:13:20.250000+00:00\n" in text
