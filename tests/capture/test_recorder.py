"""The recorder never delays its caller, and continues when a failed disk works again."""

import errno
import os
import stat
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from capture_bench import START, Bench, made

from kontronik_can_gw.capture.format import Entry, EntryKind, read_numbers
from kontronik_can_gw.config.keys import RecordConfig
from kontronik_can_gw.desk.recordings.inputs import CaptureInput, open_input
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.runtime.files import recorder
from kontronik_can_gw.runtime.files.recorder import CAPACITY, Recorder
from kontronik_can_gw.times import SECOND

pytestmark = pytest.mark.promise("captures")

HEADER = made(1)[0].header()


class Bed:
    """A recorder whose thread sleeps until the end. ``step`` does its work at the test's time."""

    def __init__(
        self,
        folder: Path,
        wait: bool = False,
        header: dict[str, Any] = HEADER,
        **settings: float,
    ) -> None:
        self.folder = folder
        self.now = 10 * SECOND
        config = RecordConfig(**{"min_free_mb": 0} | settings)  # type: ignore[arg-type]
        self.it = Recorder(folder, config, lambda: self.now)
        self.it.header = header
        self.it.start(wait)

    def step(self, *puts: Entry, after_s: int = 0) -> str:
        """Write these entries at a later time. Return the recorder's problem after that."""
        self.now += after_s * SECOND
        for entry in puts:
            self.it.put(*entry)
        self.it._work([])
        return self.it.facts.problem

    def closed(self) -> tuple[list[Entry], int, list[bool]]:
        """Close the recorder. Return the entries with bytes, the number of lost ones, the reports.

        A report is True if a problem begins, and False if it ends.
        """
        self.it.close()
        found = recorded(self.folder)
        with_bytes = [entry for entry in found if entry.kind == EntryKind.BYTES]
        losses = [sum(read_numbers(entry.data)) for entry in found if entry.kind == EntryKind.LOST]
        begins = [report.begins for report in self.it.reports(0)]
        return with_bytes, sum(losses), begins


@pytest.fixture(autouse=True)
def asleep(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder, "PERIOD_S", 10_000)
    monkeypatch.setattr(recorder, "_CLOSE_S", 60)


def entries(count: int, since: int = 0) -> list[Entry]:
    found = []
    for number in range(since, since + count):
        data = bytes((number & 255,)) * (number % 50)
        entry = Entry(
            time_ns=1000 + number,
            kind=EntryKind.BYTES,
            esc=number % 3,
            data=data,
            flags=number % 2,
            came_ns=900 + number,
        )
        found.append(entry)
    return found


def recorded(path: Path, damage: str = "") -> list[Entry]:
    """Return the entries of a folder or file. Its damage must be reported with ``damage``."""
    with open_input(path) as found:
        assert isinstance(found, CaptureInput)
        every = [
            entry
            for entry in found.entries()
            if entry.kind not in (EntryKind.CLOCK, EntryKind.STATE)
        ]
        assert damage in "\n".join(found.damage)
        return every


def test_entries_are_written_in_order(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "captures"
    bed = Bed(folder)
    bed.step(*entries(3000))
    assert bed.closed() == (entries(3000), 0, [])
    [file] = folder.iterdir()
    assert stat.S_IMODE(file.stat().st_mode) == 0o640
    assert stat.S_IMODE(folder.stat().st_mode) == 0o750
    assert bed.it.facts.bytes == file.stat().st_size


def test_name_of_a_capture_has_the_utc_of_its_first_entry(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The recorder's clock is at 10 s, and the entry is nearly 10 s older."""
    clocks = {name: getattr(time, name) for name in ("strftime", "gmtime", "localtime")}
    at = SimpleNamespace(**clocks, time_ns=lambda: 1_700_000_010 * SECOND)
    monkeypatch.setattr(recorder, "time", at)
    bed = Bed(tmp_path)
    bed.step(*entries(1))
    bed.it.close()
    [file] = tmp_path.iterdir()
    assert file.name.startswith("20231114T221320Z-")


def test_all_parts_of_a_run_together_replay_the_run(tmp_path: Path) -> None:
    bench = Bench(*made(2, canopen=True)).live(4, 12)
    header = bench.setup.header() | {"created_ns": START, "state": {}}
    bed = Bed(tmp_path, header=header, part_mb=0.04)
    for at in range(0, len(bench.entries), 1000):
        bed.step(*bench.entries[at : at + 1000])
    bed.it.close()
    files = sorted(tmp_path.iterdir())
    assert len(files) > 2
    assert [f.stem.rpartition("-")[2] for f in files] == [f"{n:05d}" for n in range(len(files))]
    for path in (tmp_path, tmp_path / files[0].name.rpartition("-")[0]):
        with open_input(path) as found:
            frames = [frame for frame in found.frames() if not frame.received]
            assert found.damage == []
        assert frames == bench.sent
    files[1].unlink()
    recorded(tmp_path, "1 earlier parts of the run are not given")


def test_new_part_begins_after_the_configured_time(tmp_path: Path) -> None:
    bed = Bed(tmp_path, part_minutes=1)
    for n in range(3):
        bed.step(*entries(1, n), after_s=31)
    bed.step(*entries(1, 3))
    assert bed.closed()[0] == entries(4)
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.promise("full-disk")
@pytest.mark.parametrize("trouble", ["full", "broken", "removed", "no folder"])
def test_writing_to_a_failed_disk_is_tried_again(
    trouble: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Entries meanwhile are counted as lost, and earlier entries are kept.

    The problem is reported when it begins and when it ends.
    """
    folder = tmp_path / "captures"
    bed = Bed(folder, min_free_mb=10)
    assert bed.step(*entries(10)) == ""
    before = entries(10)
    with monkeypatch.context() as patch:
        if trouble == "full":
            free = os.statvfs_result([*os.statvfs(folder)[:4], 0, *os.statvfs(folder)[5:]])
            patch.setattr(os, "statvfs", lambda _path: free)
        elif trouble == "broken":
            write = os.write

            def half_a_block(fd: int, data: bytes) -> int:
                write(fd, bytes(data)[:7])
                raise OSError(errno.EIO, "Input/output error")

            patch.setattr(os, "write", half_a_block)
        else:
            [file] = folder.iterdir()
            file.unlink()
            before = []
            if trouble == "no folder":
                folder.rmdir()
                folder.touch()
        assert bed.step(*entries(10, 10), after_s=6) != ""
        assert bed.step(*entries(5, 20), after_s=1) != ""
    if trouble == "no folder":
        folder.unlink()
    assert bed.step(*entries(10, 30), after_s=6) == ""
    assert bed.closed() == (before + entries(10, 30), 15, [True, False])
    if trouble == "broken":
        recorded(folder, "damaged bytes left out")
        recorded(folder, "was not closed")


def test_remark_that_is_not_written_is_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk fails again in the block that has the number of lost entries."""
    bed = Bed(tmp_path)
    assert bed.step(*entries(10)) == ""

    def fail(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    for since in (10, 20, 30):
        with monkeypatch.context() as patch:
            patch.setattr(recorder.CapturePart, "append", fail)
            assert bed.step(*entries(10, since), after_s=6) != ""
    assert bed.step(*entries(10, 40), after_s=6) == ""
    kept, lost, _ = bed.closed()
    assert kept == entries(10) + entries(10, 40)
    assert lost == 30


def test_capture_that_is_being_written_is_not_damaged(tmp_path: Path) -> None:
    bed = Bed(tmp_path)
    assert bed.step(*entries(10)) == ""
    [path] = tmp_path.iterdir()
    with path.open("ab") as file:
        file.write(b"KCB1 a block that is not complete yet")
    with open_input(path) as found:
        assert isinstance(found, CaptureInput)
        kept = [entry for entry in found.entries() if entry.kind == EntryKind.BYTES]
        assert kept == entries(10)
        assert found.damage == []
        assert found.notes[0] == f"{path.name}: is still being written, up to here"
    bed.closed()


def test_unusable_folder_is_refused_or_waited_for(tmp_path: Path) -> None:
    """With ``wait``, the recorder waits for the folder as it does for devices."""
    (tmp_path / "place").touch()
    with pytest.raises(RunError, match=r"record\.directory"):
        Bed(tmp_path / "place" / "captures")
    bed = Bed(tmp_path / "place" / "captures", wait=True)
    assert "cannot be written" in bed.step(*entries(3))
    (tmp_path / "place").unlink()
    bed.step(*entries(3, 3), after_s=6)
    assert bed.closed() == (entries(3, 3), 3, [True, False])


def test_only_the_oldest_captures_are_removed(tmp_path: Path) -> None:
    for n in range(1, 6):
        (tmp_path / f"2025010{n}T000000Z-abcdef-0000.kcap").write_bytes(bytes(1000))
    others = {"flight.kcap", "20250101T000000Z-abcdef-0000.txt"}
    for name in others:
        (tmp_path / name).write_bytes(bytes(9000))
    # Each recorder leaves its own capture, which is closed when the next one runs.
    for keep_mb, left in ((0.0025, 5), (0.00001, 3)):
        bed = Bed(tmp_path, keep_mb=keep_mb)
        bed.step(*entries(5))
        bed.it.close()
        assert len(list(tmp_path.iterdir())) == left
    assert all((tmp_path / name).exists() for name in others)


def test_capture_that_another_gateway_writes_is_kept(tmp_path: Path) -> None:
    """Two gateways use one folder, and the older file is still open."""
    first = Bed(tmp_path)
    first.step(*entries(5))
    [in_use] = tmp_path.iterdir()
    # The clock was wrong: this file is the newest by name, but the oldest by age.
    closed = tmp_path / "20990101T000000Z-abcdef-00000.kcap"
    closed.write_bytes(bytes(30_000))
    os.utime(closed, (1, 1))
    second = Bed(tmp_path, keep_mb=0.000001)
    second.step(*entries(5))
    assert in_use.exists()
    assert not closed.exists()
    second.it.close()
    first.it.close()


def test_blocked_disk_is_reported_and_lost_entries_are_counted(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    is_blocked = threading.Event()
    may_continue = threading.Event()

    def fsync(_fd: int) -> None:
        is_blocked.set()
        assert may_continue.wait(60)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(recorder, "PERIOD_S", 0)
    bed = Bed(tmp_path)
    assert is_blocked.wait(60)
    for entry in entries(CAPACITY + 500):
        bed.it.put(*entry)
    reports = bed.it.reports(bed.now + 6 * SECOND)
    assert [r.begins for r in reports] == [True, True]
    assert "500 entries" in reports[1].text
    assert "does not answer" in reports[0].text
    may_continue.set()
    found, lost, begins = bed.closed()
    assert len(found) == CAPACITY
    assert lost == 500
    assert begins == [False]


@pytest.mark.promise("captures")
def test_each_block_is_forced_to_the_disk_twice(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """f2fs may force the content with the first call, and the new size with the second one."""
    monkeypatch.setattr(recorder, "PERIOD_S", 60)
    bed = Bed(tmp_path)
    bed.step(*entries(1))
    forced = []
    real = os.fsync

    def fsync(fd: int) -> None:
        forced.append(os.fstat(fd).st_size)
        real(fd)

    monkeypatch.setattr(os, "fsync", fsync)
    sizes = []
    for _ in range(2):
        bed.step(*entries(1))
        bed.step()
        sizes += [bed.it._file.size] * 2 if bed.it._file else []
    assert forced == sizes
    assert sizes[0] < sizes[2]
    bed.closed()
    assert forced[4:] == [forced[-1]] * 2


def test_no_file_is_overwritten_and_no_link_is_followed(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "urandom", lambda n: bytes(n))
    monkeypatch.setattr(time, "strftime", lambda *_: "20260101T000000Z")
    target = tmp_path / "precious"
    target.write_text("precious")
    folder = tmp_path / "captures"
    folder.mkdir()
    (folder / "20260101T000000Z-000000-00000.kcap").symlink_to(target)
    bed = Bed(folder)
    assert "cannot be written" in bed.step(*entries(3))
    bed.it.close()
    assert target.read_text() == "precious"


def test_changed_wall_clock_is_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shift = 1_700_000_000 * SECOND
    bed = Bed(tmp_path)
    monkeypatch.setattr(time, "time_ns", lambda: bed.now + shift)
    for data, forward in ((b"a", 0), (b"x", 3600 * SECOND), (b"b", 0)):
        shift += forward
        bed.step(Entry(bed.now, EntryKind.BYTES, 0, data))
        bed.now += 11 * SECOND
    bed.it.close()
    with open_input(tmp_path) as found:
        assert isinstance(found, CaptureInput)
        walls = [found.wall_ns(e.time_ns) or 0 for e in found.entries() if e.data in (b"a", b"b")]
    assert walls[1] - walls[0] == 3622 * SECOND


def test_damaged_header_is_replaced_by_its_copy(tmp_path: Path) -> None:
    bed = Bed(tmp_path)
    bed.step(*entries(50))
    bed.step(*entries(50, 50))
    bed.it.close()
    [file] = tmp_path.iterdir()
    whole = file.read_bytes()
    for place in (0, 100, 5000):
        file.write_bytes(whole[:place] + bytes((whole[place] ^ 0x10,)) + whole[place + 1 :])
        assert recorded(tmp_path, "damaged bytes left out") == entries(100)
