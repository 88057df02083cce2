"""The recorder: what it is given is in the files, whatever the disk does, and nobody ever waits for it."""

import errno
import os
import stat
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from capture_bench import START, Bench, made

from kontronik_can_gw.capture.format import Entry, Kind, read_number
from kontronik_can_gw.desk.recordings.inputs import CaptureInput, open_input
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.runtime import recorder
from kontronik_can_gw.runtime.capture_folder import is_ours
from kontronik_can_gw.runtime.recorder import CAPACITY, Recorder, RecordSettings

HEADER = made(1)[0].header()
RETRY = 6 * SECOND
"""After this time a disk is tried again."""


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder, "PERIOD_S", 0.005)
    monkeypatch.setattr(recorder, "_CLOSE_S", 20)


class Bed:
    """A recorder on a clock that the test moves."""

    def __init__(
        self,
        folder: Path,
        clock: Callable[[], int] | None = None,
        wait: bool = False,
        header: dict[str, Any] = HEADER,
        **settings: int,
    ) -> None:
        self.folder = folder
        self.now = 10 * SECOND
        self.it = Recorder(
            RecordSettings(**{"folder": folder, "min_free_bytes": 0} | settings),  # type: ignore[arg-type]
            clock or (lambda: self.now),
        )
        self.it.header = header
        self.it.start(wait)

    def put(self, count: int, since: int = 0) -> None:
        for entry in entries(count, since):
            self.it.put(*entry)

    def written(self) -> None:
        """Wait until everything that was put is in the file."""
        until(lambda: self.it.facts.bytes > 0 and not self.it._entries)

    def again(self) -> None:
        """Let the time pass after which the disk is tried again, and wait for the new part."""
        self.now += RETRY
        until(lambda: self.it._file is not None)

    def closed(self) -> tuple[list[Entry], int, list[bool]]:
        """At the end: the bytes in the files, how many entries they say are lost, beginnings and ends of problems."""
        self.it.close()
        found = recorded(self.folder)
        lost = sum(read_number(e.data) for e in found if e.kind == Kind.LOST)
        begins = [report.begins for report in self.it.reports(0)]
        return [e for e in found if e.kind == Kind.BYTES], lost, begins


def entries(count: int, since: int = 0) -> list[Entry]:
    return [
        Entry(1000 + n, Kind.BYTES, n % 3, bytes((n & 255,)) * (n % 50), n % 2, 900 + n)
        for n in range(since, since + count)
    ]


def recorded(path: Path, damage: str = "") -> list[Entry]:
    """What is in a folder or file. ``damage``: words that must be said of it."""
    with open_input(path) as found:
        assert isinstance(found, CaptureInput)
        every = [entry for entry in found.entries() if entry.kind not in (Kind.CLOCK, Kind.STATE)]
        assert damage in "\n".join(found.damage)
        return every


def until(condition: Callable[[], bool], seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it does not come"
        time.sleep(0.002)


def test_entries_are_in_the_file_in_order(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "captures"
    bed = Bed(folder)
    bed.put(3000)
    assert bed.closed() == (entries(3000), 0, [])
    [file] = folder.iterdir()
    assert stat.S_IMODE(file.stat().st_mode) == 0o640
    assert stat.S_IMODE(folder.stat().st_mode) == 0o750
    assert is_ours(file.name)
    assert bed.it.facts.bytes == file.stat().st_size


def test_all_parts_of_a_run_together_replay_as_the_run(tmp_path: Path) -> None:
    bench = Bench(*made(2, canopen=True)).live(4, 12)
    header = bench.setup.header() | {"created_ns": START, "state": {}}
    bed = Bed(tmp_path, time.monotonic_ns, header=header, part_bytes=40_000)
    for at in range(0, len(bench.entries), 1000):
        for entry in bench.entries[at : at + 1000]:
            bed.it.put(*entry)
        until(lambda: not bed.it._entries and bed.it._worker.busy_since is None)
    bed.it.close()
    files = sorted(tmp_path.iterdir())
    assert len(files) > 2
    assert [f.stem.rpartition("-")[2] for f in files] == [f"{n:05d}" for n in range(len(files))]
    for path in (tmp_path, tmp_path / files[0].name.rpartition("-")[0]):
        with open_input(path) as found:
            frames = [frame for frame in found.frames() if not frame.received]
            assert found.damage == []
        assert len(frames) > 1000
        assert frames == bench.sent
    files[1].unlink()
    recorded(tmp_path, "1 parts of the run in front of it are not given")


def test_a_new_part_begins_after_its_time(tmp_path: Path) -> None:
    bed = Bed(tmp_path, part_ns=60 * SECOND)
    bed.put(1)
    until(lambda: bool(bed.it.facts.file))
    bed.now += 61 * SECOND
    bed.put(1, 1)
    until(lambda: bed.it.facts.file == "")
    bed.put(1, 2)
    assert bed.closed()[0] == entries(3)
    assert len(list(tmp_path.iterdir())) == 2


def test_a_full_disk_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = 0
    real = os.statvfs(tmp_path)

    def statvfs(_path: object) -> os.statvfs_result:
        values = list(real)
        values[4] = free // real.f_frsize
        return os.statvfs_result(values)

    monkeypatch.setattr(os, "statvfs", statvfs)
    bed = Bed(tmp_path, min_free_bytes=1000 * real.f_frsize)
    bed.put(10)
    until(lambda: bed.it._unwritten == 10)
    free = 2000 * real.f_frsize
    bed.again()
    bed.put(10, 10)
    assert bed.closed() == (entries(10, 10), 10, [True, False])


def test_the_oldest_captures_go_and_nothing_else(tmp_path: Path) -> None:
    """Logs that 0.5.0 wrote beside captures go with them."""
    for n in range(1, 6):
        (tmp_path / f"2025010{n}T000000Z-abcdef-0000.kcap").write_bytes(bytes(1000))
        (tmp_path / f"2025010{n}T000000Z-abcdef-0000.log").write_bytes(bytes(500))
    others = {"flight.kcap", "20250101T000000Z-abcdef-0000.txt"}
    for name in others:
        (tmp_path / name).write_bytes(bytes(9000))
    for keep_bytes, left in ((60_000, 13), (20_000, 3)):  # the second leaves its own
        bed = Bed(tmp_path, keep_bytes=keep_bytes)
        bed.put(5)
        bed.it.close()
        assert len(list(tmp_path.iterdir())) == left
    assert all((tmp_path / name).exists() for name in others)


def test_what_somebody_else_is_writing_stays(tmp_path: Path) -> None:
    """Two gateways, one folder: the older file is in use."""
    first = Bed(tmp_path)
    first.put(5)
    first.written()
    [in_use] = tmp_path.iterdir()
    # a clock that was wrong: newest by name, oldest by age
    closed = tmp_path / "20990101T000000Z-abcdef-00000.kcap"
    closed.write_bytes(bytes(30_000))
    os.utime(closed, (1, 1))
    second = Bed(tmp_path, keep_bytes=1)
    second.put(5)
    until(lambda: second.it.facts.bytes > 0 and not closed.exists())
    assert in_use.exists()
    second.it.close()
    first.it.close()


def test_a_disk_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = threading.Event()
    real = os.write

    def write(fd: int, data: bytes) -> int:
        if broken.is_set():
            real(fd, bytes(data)[:7])  # half a block is left
            raise OSError(errno.EIO, "Input/output error")
        return real(fd, data)

    monkeypatch.setattr(os, "write", write)
    bed = Bed(tmp_path)
    bed.put(10)
    bed.written()
    broken.set()
    bed.put(10, 10)
    until(lambda: bed.it.facts.problem != "")
    bed.put(5, 20)
    until(lambda: not bed.it._entries)
    broken.clear()
    bed.again()
    bed.put(10, 30)
    assert bed.closed() == (entries(10) + entries(10, 30), 15, [True, False])
    recorded(tmp_path, "are damaged")
    recorded(tmp_path, "was not closed")


def test_a_disk_that_stands_still(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stuck, go_on = threading.Event(), threading.Event()
    real = os.fdatasync

    def fdatasync(fd: int) -> None:
        if stuck.is_set():
            go_on.wait(600)
        real(fd)

    monkeypatch.setattr(os, "fdatasync", fdatasync)
    bed = Bed(tmp_path, time.monotonic_ns)
    it = bed.it
    bed.put(10)
    bed.written()
    stuck.set()
    bed.put(1, 10)
    until(lambda: it._worker.busy_since is not None and not it._entries)
    bed.put(CAPACITY + 500, 11)
    assert it._worker.busy_since is not None, "all this while it stood still"
    assert len(it._entries) == CAPACITY
    reports = it.reports(time.monotonic_ns() + RETRY)
    assert [r.begins for r in reports] == [True, True]
    assert "500 entries" in reports[1].text
    assert "does not answer" in reports[0].text
    stuck.clear()
    go_on.set()
    until(lambda: not it._entries and it._worker.busy_since is None)
    assert [r.begins for r in it.reports(time.monotonic_ns())] == [False]
    found, lost, _ = bed.closed()
    assert (len(found), lost) == (11 + CAPACITY, 500)


def test_a_folder_that_cannot_be_used_is_said_at_once_or_waited_for(tmp_path: Path) -> None:
    """Waited for where devices are."""
    place = tmp_path / "place"
    place.write_text("")
    with pytest.raises(RunError, match=r"record\.directory"):
        Bed(place / "captures")
    bed = Bed(place / "captures", wait=True)
    bed.put(3)
    until(lambda: bed.it._unwritten == 3)
    place.unlink()
    bed.again()
    bed.put(3, 3)
    assert bed.closed() == (entries(3, 3), 3, [True, False])


def test_no_file_is_overwritten_nor_link_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "urandom", lambda n: bytes(n))
    monkeypatch.setattr(time, "strftime", lambda *_: "20260101T000000Z")
    target = tmp_path / "precious"
    target.write_text("precious")
    folder = tmp_path / "captures"
    folder.mkdir()
    (folder / "20260101T000000Z-000000-00000.kcap").symlink_to(target)
    bed = Bed(folder)
    bed.put(3)
    until(lambda: bed.it.facts.problem != "")
    bed.it.close()
    assert target.read_text() == "precious"
    assert "cannot be written" in bed.it.reports(0)[0].text


def test_a_wall_clock_that_is_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now, shift = 10 * SECOND, 1_700_000_000 * SECOND
    monkeypatch.setattr(time, "time_ns", lambda: now + shift)  # before the thread asks for it
    bed = Bed(tmp_path, lambda: now)
    bed.it.put(now, Kind.BYTES, 0, b"a", 0)
    until(lambda: bed.it._file is not None and not bed.it._entries)
    now += 11 * SECOND
    shift += 3600 * SECOND
    bed.it.put(now, Kind.BYTES, 0, b"x", 0)
    until(lambda: bed.it._offset == shift)
    now += SECOND
    bed.it.put(now, Kind.BYTES, 0, b"b", 0)
    bed.it.close()
    with open_input(tmp_path) as found:
        assert isinstance(found, CaptureInput)
        walls = [found.wall_ns(e.time_ns) or 0 for e in found.entries() if e.data in (b"a", b"b")]
    assert walls[1] - walls[0] == 3612 * SECOND


def test_a_file_that_is_removed_while_it_is_written_is_noticed(tmp_path: Path) -> None:
    bed = Bed(tmp_path)
    bed.put(3)
    bed.written()
    for file in tmp_path.iterdir():
        file.unlink()
    bed.put(3, 3)
    until(lambda: bed.it.facts.problem != "")
    assert "what was being written was removed" in bed.it.reports(0)[0].text
    bed.again()
    bed.put(3, 6)
    bed.it.close()
    assert [r.begins for r in bed.it.reports(0)] == [False]
    last = recorded(max(tmp_path.glob("*.kcap")))
    assert [e for e in last if e.kind == Kind.BYTES] == entries(3, 6)


def test_a_header_that_is_damaged_is_there_once_more(tmp_path: Path) -> None:
    bed = Bed(tmp_path)
    bed.put(50)
    bed.written()
    bed.put(50, 50)
    bed.it.close()
    [file] = tmp_path.iterdir()
    whole = file.read_bytes()
    for place in (0, 100, 5000):
        file.write_bytes(whole[:place] + bytes((whole[place] ^ 0x10,)) + whole[place + 1 :])
        assert recorded(tmp_path, "are damaged") == entries(100)
