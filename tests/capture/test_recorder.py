"""The recorder: what it is given is in the files, whatever the disk does, and nobody ever waits for it."""

import errno
import os
import stat
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from capture_bench import START, Bench, made

from kontronik_can_gw.capture.format import Entry, Kind, read_number
from kontronik_can_gw.desk.recordings.inputs import CaptureInput, open_input
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.kontronik import InfoData
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.runtime import capture_part, recorder
from kontronik_can_gw.runtime.capture_folder import is_ours
from kontronik_can_gw.runtime.recorder import CAPACITY, Recorder, RecordSettings

HEADER = made(1)[0].header()


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder, "PERIOD_S", 0.005)
    monkeypatch.setattr(recorder, "_CLOSE_S", 20)


def begun(folder: Path, clock: Callable[[], int] = time.monotonic_ns, **more: object) -> Recorder:
    made_with = {"folder": folder, "min_free_bytes": 0} | more
    found = Recorder(RecordSettings(**made_with), clock)  # type: ignore[arg-type]
    found.header = HEADER
    found.start()
    return found


def entries(count: int, since: int = 0) -> list[Entry]:
    return [
        Entry(1000 + n, Kind.BYTES, n % 3, bytes((n & 255,)) * (n % 50), n % 2, 900 + n)
        for n in range(since, since + count)
    ]


def put(to: Recorder, listed: list[Entry]) -> None:
    for entry in listed:
        to.put(*entry)


def recorded(folder: Path) -> list[Entry]:
    with open_input(folder) as found:
        assert isinstance(found, CaptureInput)
        return [entry for entry in found.entries() if entry.kind not in (Kind.CLOCK, Kind.STATE)]


def until(condition: Callable[[], bool], seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it does not come"
        time.sleep(0.002)


def test_entries_are_in_the_file_in_order(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "captures"
    it = begun(folder)
    listed = entries(3000)
    put(it, listed)
    it.close()
    assert recorded(folder) == listed
    [file] = folder.iterdir()
    assert stat.S_IMODE(file.stat().st_mode) == 0o640
    assert stat.S_IMODE(folder.stat().st_mode) == 0o750
    assert is_ours(file.name)
    assert it.facts.bytes == file.stat().st_size
    assert not it.reports(0)


def test_parts_by_size_go_on_from_each_other(tmp_path: Path) -> None:
    it = begun(tmp_path, part_bytes=3000)
    listed = entries(2000)
    for at in range(0, 2000, 100):
        before = it.facts.bytes
        put(it, listed[at : at + 100])
        until(lambda before=before: it.facts.bytes > before)  # type: ignore[misc]
    it.close()
    files = sorted(tmp_path.iterdir())
    assert len(files) > 3
    assert [f.stem.rpartition("-")[2] for f in files] == [f"{n:05d}" for n in range(len(files))]
    assert recorded(tmp_path) == listed
    with open_input(tmp_path) as found:
        assert isinstance(found, CaptureInput)
        assert sum(1 for _ in found.entries()) >= 2000
        assert found.damage == []
        assert found.position == found.size == sum(f.stat().st_size for f in files)
    prefix = tmp_path / files[0].name.rpartition("-")[0]
    with open_input(prefix) as found:
        assert isinstance(found, CaptureInput)
        assert len(list(found.entries())) >= 2000
    files[1].unlink()
    with open_input(tmp_path) as found:
        assert isinstance(found, CaptureInput)
        assert len(list(found.entries())) < 2000
        assert any(
            "1 parts of the run in front of it are not given" in line for line in found.damage
        )


def test_a_new_part_begins_after_its_time(tmp_path: Path) -> None:
    now = 10 * SECOND
    it = begun(tmp_path, clock=lambda: now, part_ns=60 * SECOND)
    put(it, entries(1))
    until(lambda: bool(it.facts.file))
    now += 61 * SECOND
    put(it, entries(1, 1))
    until(lambda: it.facts.file == "")
    put(it, entries(1, 2))
    it.close()
    assert len(list(tmp_path.iterdir())) == 2


def test_the_header_shows_where_it_comes_from(tmp_path: Path) -> None:
    it = begun(tmp_path)
    bench = Bench(*made(1))
    it.note(bench.gateway, 0)
    put(it, entries(1))
    until(lambda: it.facts.bytes > 0)
    bench.gateway.escs[0].last_info = InfoData(
        device_and_variant=1 << 10 | 160, firmware_word=4 << 8 | 17
    )
    bench.gateway.escs[0].layout = 1
    it.note(bench.gateway, 1)
    until(lambda: it._recorded_devices == it._devices)
    it.close()
    with open_input(tmp_path) as found:
        assert isinstance(found, CaptureInput)
        list(found.entries())
        assert found.provenance["e0"] == "KOSMIK 160, firmware 4.17, V4 layout, at /dev/ttyUSB0"
        assert found.provenance["DBC"] == "kontronik_esc.dbc"
        assert "port" in found.setup.configuration
        now = time.time_ns()
        assert abs((found.wall_ns(time.monotonic_ns()) or 0) - now) < 60 * SECOND


def test_room_again_and_it_goes_on_and_the_loss_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 10 * SECOND
    free = 0
    real = os.statvfs(tmp_path)

    def statvfs(_path: object) -> os.statvfs_result:
        values = list(real)
        values[4] = free // real.f_frsize
        return os.statvfs_result(values)

    monkeypatch.setattr(os, "statvfs", statvfs)
    it = begun(tmp_path, clock=lambda: now, min_free_bytes=1000 * real.f_frsize)
    put(it, entries(10))
    until(lambda: it._unwritten == 10)
    free = 2000 * real.f_frsize
    now += 6 * SECOND
    until(lambda: it._file is not None)
    put(it, entries(10, 10))
    it.close()
    found = recorded(tmp_path)
    assert [e for e in found if e.kind == Kind.BYTES] == entries(10, 10)
    assert [read_number(e.data) for e in found if e.kind == Kind.LOST] == [10]
    assert [r.begins for r in it.reports(0)] == [True, False]


def test_the_oldest_captures_go_and_nothing_else(tmp_path: Path) -> None:
    """Logs that 0.5.0 wrote beside captures go with them."""
    names = [f"2025010{n}T000000Z-abcdef-0000.kcap" for n in range(1, 6)]
    for name in names:
        (tmp_path / name).write_bytes(bytes(1000))
        (tmp_path / name.replace(".kcap", ".log")).write_bytes(bytes(500))
    (tmp_path / "flight.kcap").write_bytes(bytes(9000))
    (tmp_path / "20250101T000000Z-abcdef-0000.txt").write_bytes(bytes(9000))
    it = begun(tmp_path, keep_bytes=60_000)
    put(it, entries(5))
    it.close()
    assert len(list(tmp_path.iterdir())) == 13
    it = begun(tmp_path, keep_bytes=20_000)
    put(it, entries(5))
    it.close()
    left = {p.name for p in tmp_path.iterdir()}
    assert "flight.kcap" in left
    assert "20250101T000000Z-abcdef-0000.txt" in left
    assert [name for name in left if "abcdef" in name] == ["20250101T000000Z-abcdef-0000.txt"]


def test_what_somebody_else_is_writing_stays(tmp_path: Path) -> None:
    """Two gateways, one folder: the older file is in use."""
    first = begun(tmp_path)
    put(first, entries(5))
    until(lambda: first.facts.bytes > 0 and not first._entries)
    [in_use] = tmp_path.iterdir()
    # a clock that was wrong: newest by name, oldest by age
    closed = tmp_path / "20990101T000000Z-abcdef-00000.kcap"
    closed.write_bytes(bytes(30_000))
    os.utime(closed, (1, 1))
    second = begun(tmp_path, keep_bytes=1)
    put(second, entries(5))
    until(lambda: second.facts.bytes > 0 and not closed.exists())
    assert in_use.exists()
    second.close()
    first.close()


def test_a_disk_that_fails_costs_what_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 10 * SECOND
    broken = threading.Event()
    real = os.write

    def write(fd: int, data: bytes) -> int:
        if broken.is_set():
            real(fd, bytes(data)[:7])  # half a block is left
            raise OSError(errno.EIO, "Input/output error")
        return real(fd, data)

    monkeypatch.setattr(os, "write", write)
    it = begun(tmp_path, clock=lambda: now)
    put(it, entries(10))
    until(lambda: it.facts.bytes > 0 and not it._entries)
    broken.set()
    put(it, entries(10, 10))
    until(lambda: it.facts.problem != "")
    put(it, entries(5, 20))
    until(lambda: not it._entries)
    broken.clear()
    now += 6 * SECOND
    until(lambda: it._file is not None)
    put(it, entries(10, 30))
    it.close()
    found = recorded(tmp_path)
    assert [e for e in found if e.kind == Kind.BYTES] == entries(10) + entries(10, 30)
    assert sum(read_number(e.data) for e in found if e.kind == Kind.LOST) == 15
    assert [r.begins for r in it.reports(0)] == [True, False]
    with open_input(tmp_path) as capture:
        assert isinstance(capture, CaptureInput)
        list(capture.entries())
        assert any("are damaged" in line for line in capture.damage)
        assert any("was not closed" in line for line in capture.damage)


def test_a_disk_that_stands_still_holds_nobody_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stuck, go_on = threading.Event(), threading.Event()
    real = os.fdatasync

    def fdatasync(fd: int) -> None:
        if stuck.is_set():
            go_on.wait(600)
        real(fd)

    monkeypatch.setattr(os, "fdatasync", fdatasync)
    it = begun(tmp_path)
    put(it, entries(10))
    until(lambda: it.facts.bytes > 0)
    stuck.set()
    put(it, entries(1, 10))
    until(lambda: it._busy_since is not None and not it._entries)
    put(it, entries(CAPACITY + 500, 11))
    assert it._busy_since is not None, "all this while it stood still"
    assert len(it._entries) == CAPACITY
    reports = it.reports(time.monotonic_ns() + 6 * SECOND)
    assert [r.begins for r in reports] == [True, True]
    assert "500 entries" in reports[0].text
    assert "does not answer" in reports[1].text
    stuck.clear()
    go_on.set()
    until(lambda: not it._entries and it._busy_since is None)
    assert [r.begins for r in it.reports(time.monotonic_ns())] == [False]
    it.close()
    found = recorded(tmp_path)
    assert len([e for e in found if e.kind == Kind.BYTES]) == 11 + CAPACITY
    assert sum(read_number(e.data) for e in found if e.kind == Kind.LOST) == 500


def test_the_end_waits_for_a_stuck_disk_but_not_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "_CLOSE_S", 0.1)
    go_on = threading.Event()
    monkeypatch.setattr(os, "fdatasync", lambda _fd: go_on.wait(600))
    it = begun(tmp_path)
    put(it, entries(3))
    until(lambda: it._busy_since is not None)
    it.close()
    assert it._busy_since is not None, "the disk has not answered yet"
    go_on.set()


def test_a_part_that_could_not_be_begun_does_not_stand_in_the_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 10 * SECOND
    full = True
    real = os.write

    def write(fd: int, data: bytes) -> int:
        if full:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(fd, data)

    monkeypatch.setattr(os, "write", write)
    it = begun(tmp_path, clock=lambda: now)
    put(it, entries(3))
    until(lambda: it._unwritten == 3)
    assert list(tmp_path.iterdir()) == []
    full = False
    now += 6 * SECOND
    until(lambda: it._file is not None)
    put(it, entries(3, 3))
    it.close()
    assert [e for e in recorded(tmp_path) if e.kind == Kind.BYTES] == entries(3, 3)


def test_a_folder_that_cannot_be_used_is_said_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match=r"record\.directory"):
        begun(tmp_path / "file" / "captures")


def test_another_file_is_never_overwritten_nor_a_link_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "urandom", lambda n: bytes(n))
    monkeypatch.setattr(time, "strftime", lambda *_: "20260101T000000Z")
    target = tmp_path / "precious"
    target.write_text("precious")
    folder = tmp_path / "captures"
    folder.mkdir()
    (folder / "20260101T000000Z-000000-00000.kcap").symlink_to(target)
    it = begun(folder)
    put(it, entries(3))
    until(lambda: it.facts.problem != "")
    it.close()
    assert target.read_text() == "precious"
    assert "cannot be written" in it.reports(0)[0].text


def test_the_wall_clock_that_is_set_is_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, shift = 10 * SECOND, 0
    it = begun(tmp_path, clock=lambda: now)
    monkeypatch.setattr(time, "time_ns", lambda: now + 1_700_000_000 * SECOND + shift)
    it.put(now, Kind.BYTES, 0, b"a", 0)
    until(lambda: it._file is not None and not it._entries)
    now += 11 * SECOND
    shift = 3600 * SECOND
    it.put(now, Kind.BYTES, 0, b"x", 0)
    until(lambda: it._offset == 1_700_000_000 * SECOND + shift)
    now += SECOND
    it.put(now, Kind.BYTES, 0, b"b", 0)
    it.close()
    with open_input(tmp_path) as found:
        assert isinstance(found, CaptureInput)
        walls = {e.data: found.wall_ns(e.time_ns) for e in found.entries() if e.kind == Kind.BYTES}
    first, second = walls[b"a"], walls[b"b"]
    assert first is not None
    assert second is not None
    assert second - first == 3612 * SECOND


def test_a_folder_that_is_not_there_yet_is_waited_for_where_devices_are(tmp_path: Path) -> None:
    now = 10 * SECOND
    place = tmp_path / "place"
    place.write_text("")
    it = Recorder(RecordSettings(place / "captures", min_free_bytes=0), lambda: now)
    it.header = HEADER
    it.start(wait=True)
    put(it, entries(3))
    until(lambda: it._unwritten == 3)
    place.unlink()
    now += 6 * SECOND
    until(lambda: it._file is not None)
    put(it, entries(3, 3))
    it.close()
    assert [r.begins for r in it.reports(0)] == [True, False]
    assert [e for e in recorded(place / "captures") if e.kind == Kind.BYTES] == entries(3, 3)


def test_a_mistake_in_what_writes_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 10 * SECOND

    def fail(*_: object) -> None:
        raise ValueError("a mistake of ours")

    it = begun(tmp_path, clock=lambda: now)
    with monkeypatch.context() as patch:
        patch.setattr(capture_part, "data_payload", fail)
        put(it, entries(2))
        until(lambda: it._unwritten == 2)
    assert "a mistake of ours" in it.reports(0)[0].text
    assert it.facts.lost == 2
    now += 6 * SECOND
    until(lambda: it._file is not None)
    put(it, entries(3))
    it.close()
    assert [e for e in recorded(tmp_path) if e.kind == Kind.BYTES] == entries(3)


def test_a_file_that_is_removed_while_it_is_written_is_noticed(tmp_path: Path) -> None:
    now = 10 * SECOND
    it = begun(tmp_path, clock=lambda: now)
    put(it, entries(3))
    until(lambda: it.facts.bytes > 0 and not it._entries)
    for file in tmp_path.iterdir():
        file.unlink()
    put(it, entries(3, 3))
    until(lambda: it.facts.problem != "")
    assert "what was being written was removed" in it.reports(0)[0].text
    now += 6 * SECOND
    until(lambda: it._file is not None)
    put(it, entries(3, 6))
    it.close()
    assert [r.begins for r in it.reports(0)] == [False]
    last = max(tmp_path.glob("*.kcap"))
    with open_input(last) as found:
        assert isinstance(found, CaptureInput)
        assert [e for e in found.entries() if e.kind == Kind.BYTES] == entries(3, 6)


def test_a_header_that_is_damaged_is_there_once_more(tmp_path: Path) -> None:
    it = begun(tmp_path)
    put(it, entries(50))
    until(lambda: it.facts.bytes > 0)
    put(it, entries(50, 50))
    it.close()
    [file] = tmp_path.iterdir()
    whole = file.read_bytes()
    for place in (0, 100, 5000):
        file.write_bytes(whole[:place] + bytes((whole[place] ^ 0x10,)) + whole[place + 1 :])
        assert recorded(tmp_path) == entries(100)
        with open_input(file) as found:
            list(found.frames())
            assert "are damaged" in found.damage[0]


def test_all_parts_of_a_run_together_replay_as_the_run(tmp_path: Path) -> None:
    bench = Bench(*made(2, canopen=True)).live(4, 12)
    it = Recorder(RecordSettings(tmp_path, min_free_bytes=0, part_bytes=40_000))
    it.header = bench.setup.header() | {"created_ns": START, "state": {}}
    it.start()
    for at in range(0, len(bench.entries), 1000):
        put(it, bench.entries[at : at + 1000])
        until(lambda: not it._entries and it._busy_since is None)
    it.close()
    assert len(list(tmp_path.iterdir())) > 2
    with open_input(tmp_path) as found:
        frames = [frame for frame in found.frames() if not frame.received]
        assert found.damage == []
    assert len(frames) > 1000
    assert frames == bench.sent
