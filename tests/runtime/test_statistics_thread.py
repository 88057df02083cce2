"""The thread that writes the status file.

It never delays the loop, always writes a complete document, and reports a fault once. The file
is removed when it is closed.
"""

import errno
import json
import os
import stat
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from statistics_bench import moment_of

from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.status import statistics as statistics_module
from kontronik_can_gw.runtime.status.snapshot import STALE_NS, Moment
from kontronik_can_gw.runtime.status.statistics import Statistics
from kontronik_can_gw.runtime.system.worker import Report
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.times import SECOND

pytestmark = pytest.mark.promise("status")

PATIENCE = 60.0
"""Seconds that something may take on a busy machine before a test fails."""


def numbered(number: int) -> Moment:
    """Return the Moment of a gateway that has sent this number of frames."""
    gateway = Gateway(CoreSettings([EscSettings("esc1")], MessageLayout("", "", ())), 0)
    gateway.status.sent_frames = number
    gateway.status.received_frames = 3 * number
    return moment_of(gateway, number * SECOND)


def until(condition: Callable[[], object]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "it did not come about"
        time.sleep(0.002)


def number_in(file: Path) -> int:
    """Return the number of the document in a file, or 0 without a file."""
    if not file.exists():
        return 0
    document = json.loads(file.read_bytes())
    return int(document["monotonic_ns"]) // SECOND


def put(statistics: Statistics, number: int) -> list[Report]:
    """Publish a document and wait until the thread has tried to write it. Return its reports."""
    statistics.publish(numbered(number))
    until(lambda: statistics._written is statistics._newest and not statistics._worker.busy_since)
    return statistics.reports(0)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "status.json"


@pytest.fixture
def statistics(file: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Statistics]:
    monkeypatch.setattr(statistics_module, "_CLOSE_S", PATIENCE)
    made = Statistics(file)
    yield made
    made.close()


def test_content_is_on_the_disk_before_it_replaces_the_old_one(
    file: Path,
    statistics: Statistics,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    steps = []
    for name in ("fsync", "replace"):
        real = getattr(os, name)

        def noted(*given: object, name: str = name, real: Callable[..., object] = real) -> None:
            steps.append(name)
            real(*given)

        monkeypatch.setattr(os, name, noted)
    put(statistics, 1)
    put(statistics, 2)
    assert steps == ["fsync", "replace"] * 2
    assert number_in(file) == 2


def test_file_is_complete_readable_by_all_and_removed_at_the_end(
    file: Path,
    statistics: Statistics,
) -> None:
    (file.parent / ".status.json.tmp").write_text('{"half')  # left by a process that was killed
    for number in (1, 3):
        assert put(statistics, number) == []
        assert number_in(file) == number
    assert stat.S_IMODE(file.stat().st_mode) == 0o644
    assert os.listdir(file.parent) == ["status.json"]
    rates = json.loads(file.read_text(encoding="utf-8"))["rates"]
    assert rates["sent_frames_per_s"] == 1.0
    assert rates["received_frames_per_s"] == 3.0
    with pytest.raises(RunError, match="another gateway writes it"):
        Statistics(file)
    for _ in range(2):
        statistics.close()
        statistics.publish(numbered(4))  # too late, so it has no effect
    assert os.listdir(file.parent) == []
    before = os.listdir("/proc/self/fd")
    threads = threading.active_count()
    Statistics(file).close()
    assert os.listdir("/proc/self/fd") == before
    assert threading.active_count() == threads


def test_file_of_the_user_is_neither_replaced_nor_removed(
    file: Path, statistics: Statistics
) -> None:
    file.write_text("mine")
    [report] = put(statistics, 1)
    assert report.text == (
        f"statistics file {file}: cannot be written: it exists and is not a status file. "
        "Remove it, or choose another name. Trying again."
    )
    assert put(statistics, 2) == []
    statistics.close()
    assert file.read_text() == "mine"


@pytest.mark.parametrize("left_over", ["of a gateway", ""])
def test_file_that_a_killed_gateway_left_is_replaced(
    file: Path, statistics: Statistics, left_over: str
) -> None:
    put(statistics, 1)
    document = file.read_text() if left_over else ""
    statistics.close()
    after = Statistics(file)
    file.write_text(document)
    assert put(after, 2) == []
    assert number_in(file) == 2
    after.close()
    assert not file.exists()


def test_disk_that_does_not_answer_is_reported_once_until_it_does(
    file: Path,
    statistics: Statistics,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    free = threading.Event()
    stuck = threading.Event()
    real = os.write

    def write(fd: int, data: bytes) -> int:
        stuck.set()
        assert free.wait(PATIENCE)
        return real(fd, data)

    monkeypatch.setattr(os, "write", write)
    statistics.publish(numbered(1))
    assert stuck.wait(PATIENCE)
    since = statistics._worker.busy_since
    assert since is not None
    for number in range(2, 502):
        statistics.publish(numbered(number))  # never waits
    assert statistics.reports(since + STALE_NS) == []
    (report,) = statistics.reports(since + STALE_NS + 1)
    assert report.begins
    assert str(file) in report.text
    assert "disk does not answer" in report.text
    assert statistics.reports(since + 2 * STALE_NS) == []
    free.set()
    until(lambda: number_in(file) == 501)  # only the newest is written
    until(lambda: [each.begins for each in statistics.reports(0)] == [False])


@pytest.mark.promise("full-disk")
@pytest.mark.parametrize(
    ("trouble", "said"),
    [("no folder", "No such file"), ("no file", "not a regular file"), ("full", "No space left")],
)
def test_file_that_cannot_be_written_is_reported_once_until_it_can(
    trouble: str,
    said: str,
    file: Path,
    statistics: Statistics,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    moved = file.parent.with_name("moved")
    real = os.write

    def full(fd: int, data: bytes) -> int:
        if len(data) > 10:
            return real(fd, data[:10])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    assert put(statistics, 1) == []
    with monkeypatch.context() as patch:
        if trouble == "no folder":
            file.parent.rename(moved)
        elif trouble == "no file":
            file.unlink()
            os.mkfifo(file)
        else:
            patch.setattr(os, "write", full)
        (report,) = put(statistics, 2)
        assert report.begins
        assert said in report.text
        assert put(statistics, 3) == []
        if trouble == "full":
            assert number_in(file) == 1
            assert os.listdir(file.parent) == ["status.json"]
    if trouble == "no folder":
        moved.rename(file.parent)
    if trouble == "no file":
        assert stat.S_ISFIFO(file.stat().st_mode)
        file.unlink()
    text = f"statistics file {file}: is written again"
    assert put(statistics, 4) == [Report("statistics: file", False, text)]
    assert number_in(file) == 4
