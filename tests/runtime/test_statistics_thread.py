"""The thread that writes the file: never in the loop's way, always a whole document, faults told once, gone when closed."""

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

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.telemetry import SECOND, EscSettings
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.runtime import statistics as statistics_module
from kontronik_can_gw.runtime.snapshot import STALE_NS, Moment
from kontronik_can_gw.runtime.statistics import Statistics
from kontronik_can_gw.runtime.worker import Report
from kontronik_can_gw.signals.plan import Layout

PATIENCE = 60.0
"""Seconds that something may take on a busy machine before a test fails."""


def numbered(number: int) -> Moment:
    """A moment of a gateway that has sent so many frames."""
    gateway = Gateway([EscSettings("esc1")], Layout("", "", ()), 0)
    gateway.status.sent_frames, gateway.status.received_frames = number, 3 * number
    return moment_of(gateway, number * SECOND)


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "it did not come about"
        time.sleep(0.002)


def number_in(file: Path) -> int:
    """The number of the document in a file, 0 without one."""
    try:
        return int(json.loads(file.read_bytes())["monotonic_ns"]) // SECOND
    except FileNotFoundError:
        return 0


def put(statistics: Statistics, file: Path, number: int) -> None:
    statistics.publish(numbered(number))
    until(lambda: number_in(file) == number)


def reports(statistics: Statistics, count: int) -> list[Report]:
    found: list[Report] = []

    def come() -> bool:
        found.extend(statistics.reports(0))
        return len(found) >= count

    until(come)
    return found


@pytest.fixture(autouse=True)
def no_hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """The end waits for the thread, however loaded the machine is."""
    monkeypatch.setattr(statistics_module, "_CLOSE_S", PATIENCE)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "status.json"


@pytest.fixture
def statistics(file: Path) -> Iterator[Statistics]:
    made = Statistics(file)
    yield made
    made.close()


def test_the_file_is_readable_for_all_whole_and_alone(file: Path) -> None:
    (file.parent / ".status.json.tmp").write_text('{"half')  # of a process that was killed
    statistics = Statistics(file)
    put(statistics, file, 1)
    put(statistics, file, 3)
    assert stat.S_IMODE(file.stat().st_mode) == 0o644
    assert os.listdir(file.parent) == ["status.json"]
    rates = json.loads(file.read_text(encoding="utf-8"))["rates"]
    assert (rates["sent_frames_per_s"], rates["received_frames_per_s"]) == (1.0, 3.0)
    statistics.close()


def test_a_disk_that_does_not_answer_is_told_once_and_when_it_answers_again(
    file: Path, statistics: Statistics, monkeypatch: pytest.MonkeyPatch
) -> None:
    free, stuck, real = threading.Event(), threading.Event(), os.write

    def write(fd: int, data: bytes) -> int:
        if threading.current_thread().name == "statistics" and not free.is_set():
            stuck.set()
            assert free.wait(PATIENCE)
        return real(fd, data)

    monkeypatch.setattr(os, "write", write)
    statistics.publish(numbered(1))
    assert stuck.wait(PATIENCE)
    since = statistics._worker.busy_since
    assert since is not None
    for number in range(2, 502):
        statistics.publish(numbered(number))  # which never waits
    assert statistics.reports(since + STALE_NS) == []
    (report,) = statistics.reports(since + STALE_NS + 1)
    assert report.begins and str(file) in report.text and "disk does not answer" in report.text
    assert statistics.reports(since + 2 * STALE_NS) == []
    free.set()
    (report,) = reports(statistics, 1)
    assert not report.begins and "answers again" in report.text
    until(lambda: number_in(file) == 501)  # the newest, and none of those between


def test_the_end_removes_the_file_ends_the_thread_and_closes_what_was_opened(file: Path) -> None:
    def descriptors() -> set[str]:
        return set(os.listdir("/proc/self/fd"))

    before, threads = descriptors(), threading.active_count()
    for _ in range(5):
        statistics = Statistics(file)
        put(statistics, file, 1)
        statistics.close()
        assert os.listdir(file.parent) == []
        statistics.close()
        statistics.publish(numbered(2))  # too late, and nothing happens
    assert descriptors() == before
    assert threading.active_count() == threads
    assert os.listdir(file.parent) == []


def test_a_file_that_another_gateway_writes_is_refused(file: Path) -> None:
    first = Statistics(file)
    with pytest.raises(RunError, match="another gateway writes it"):
        Statistics(file)
    first.close()
    Statistics(file).close()


def test_a_folder_that_is_missing_is_told_once_and_the_file_comes_with_it(tmp_path: Path) -> None:
    file = tmp_path / "run" / "status.json"
    statistics = Statistics(file)
    statistics.publish(numbered(1))
    (report,) = reports(statistics, 1)
    statistics.publish(numbered(2))
    text = f"statistics file {file}: cannot be written: No such file or directory. Trying again."
    assert report == Report("statistics: file", True, text)
    file.parent.mkdir()
    put(statistics, file, 4)
    text = f"statistics file {file}: is written again"
    assert reports(statistics, 1) == [Report("statistics: file", False, text)]
    statistics.close()


def test_what_is_no_plain_file_is_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "device")
    statistics = Statistics(tmp_path / "device")
    statistics.publish(numbered(1))
    assert "no plain file" in reports(statistics, 1)[0].text
    statistics.close()
    assert stat.S_ISFIFO((tmp_path / "device").stat().st_mode)


def test_a_full_disk_leaves_the_old_document_and_no_half_one(
    file: Path, statistics: Statistics, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(statistics, file, 1)
    real = os.write

    def full(fd: int, data: bytes) -> int:
        if threading.current_thread().name == "statistics":
            if len(data) > 10:
                return real(fd, data[:10])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(fd, data)

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        statistics.publish(numbered(2))
        (report,) = reports(statistics, 1)
        assert report.begins and "No space left on device" in report.text
        assert number_in(file) == 1
        assert os.listdir(file.parent) == ["status.json"]
    put(statistics, file, 3)
