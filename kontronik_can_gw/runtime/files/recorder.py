"""Captures a running gateway: a thread writes .kcap files (capture/format.py) to a folder.

``put``, ``note`` and ``reports`` are called by the loop's thread and never wait. Only ``_work``, in
the recorder's thread, and the functions that it calls access the disk. Entries are handed over by a
bounded deque. Entries that do not fit are counted, and the count is recorded as soon as there is
room again.

Every half second, the entries are written as one block and forced to the disk, so a power loss
costs no more than that. A fault of the disk is reported once and the disk is tried again every five
seconds. It ends neither the gateway nor the recorder.
"""

import contextlib
import errno
import fcntl
import os
import re
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kontronik_can_gw.capture.format import (
    CLOCK_FLAGS,
    SUFFIX,
    EntryKind,
    Packed,
    block_of,
    data_payload,
    json_payload,
    numbers_data,
    packed,
)
from kontronik_can_gw.capture.recorded_gateway import RecordedGateway, devices_of, state_of
from kontronik_can_gw.config.keys import RecordConfig
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.runtime.files.disk import (
    is_locked,
    open_regular,
    reason_of,
    sync_folder,
    write_all,
)
from kontronik_can_gw.runtime.system.clock import ClockFacts
from kontronik_can_gw.runtime.system.worker import Report, Worker
from kontronik_can_gw.times import MS, SECOND

CAPACITY = 50_000
"""Maximum number of waiting entries: about two minutes of one ESC, or 15 seconds of eight."""
PERIOD_S = 0.5
_AT_ONCE = 5000
"""Number of entries processed together. Other threads can run between two such batches."""
_CLOSE_S = 0.35
_CHECK_NS = 5 * SECOND
"""Interval between checks of the folder, and between attempts after a failure of the disk."""
_CLOCK_NS = 10 * SECOND
"""Interval between comparisons of the wall clock with the monotonic clock."""
STATE_NS = 2 * SECOND
"""Interval between records of the gateway's state."""
_STEP_NS = MS
"""A larger change of the wall clock is recorded."""
_SLOW_NS = 5 * SECOND
"""A disk that takes longer is reported."""
_MB = 1_000_000
_OURS = re.compile(rf"[0-9]{{8}}T[0-9]{{6}}Z-[0-9a-f]{{6}}-[0-9]+{SUFFIX}")
Item = tuple[int, int, int, bytes, int, int | None]
"""(time, kind, ESC, data, flags, time of arrival), as in ``capture.Entry``."""


@dataclass
class RecorderFacts:
    """The state of the recording, for the status document."""

    file: str = ""
    """The capture that is being written. Empty if there is none."""
    bytes: int = 0
    """Number of bytes written since the start."""
    lost: int = 0
    """Number of entries that were not recorded."""
    problem: str = ""


class Recorder:
    """Writes the given entries to files, from ``start`` until ``close``."""

    _keeps_items = False
    """True if entries that could not be written are kept."""

    def __init__(
        self,
        folder: Path,
        config: RecordConfig,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.facts = RecorderFacts()
        self.header: Mapping[str, Any] = {}
        """Description of the gateway and its ESCs. Set it before ``start``.

        Each part of the capture adds its own numbers.
        """
        self.words = str(folder)
        """Text for the log line at the start."""
        self._folder = folder
        self._config = config
        self._clock = clock
        self._entries: deque[Item] = deque()
        self._overflowed = 0
        """Number of entries that did not fit into the deque. Only the loop's thread counts them."""
        self._reported_overflow = 0
        self._unwritten = 0
        """Number of entries that could not be written. Only the recorder's thread counts them."""
        self._recorded_losses = 0
        """Number of lost entries that the capture mentions."""
        self._state_ns = 0
        """Time of the last record of the gateway's state."""
        self._check_ns = 0
        """Time of the next check of the folder."""
        self._clock_ns = 0
        """Time of the last comparison of the clocks."""
        self.clock_facts = ClockFacts()
        """The state of the wall clock. Only the loop's thread sets it."""
        self._recorded_clock = ClockFacts()
        self._offset = 0
        """The wall clock's time minus the monotonic clock's, in ns, as last recorded."""
        self._devices: list[Any] = []
        self._recorded_devices: list[Any] = []
        self._worker: Worker[None] = Worker(
            "recorder", self._work, wait=self._wait, ended=self._end, clock=clock
        )
        self._is_usable = False
        """True if the last check found that the folder can be used."""
        self._file: CapturePart | None = None
        self._spared: Path | None = None
        """A file that is not removed to make room."""
        self._run = os.urandom(8).hex()
        self._stamp = ""
        self._part = 0

    # --- in the loop's thread

    def start(self, wait: bool = False) -> None:
        """Start to write.

        Raises RunError if the folder cannot be used. With ``wait``, the folder is instead tried
        again every five seconds. Raises RunError if the system provides no thread.
        """
        try:
            self._make_folder()
        except OSError as error:
            if not wait:
                raise RunError(
                    f"captures: {self._folder}: {error.strerror}. "
                    "Give another folder (record.directory, --record)."
                ) from None
        if not self._worker.start():
            raise RunError("captures: cannot be written, because the system cannot start a thread")

    def put(
        self,
        time_ns: int,
        kind: int,
        esc: int,
        data: bytes,
        flags: int,
        came_ns: int | None = None,
    ) -> None:
        """Record an entry with the fields of ``capture.Entry``. Never waits."""
        if len(self._entries) >= CAPACITY:
            self._overflowed += 1
        else:
            self._entries.append((time_ns, kind, esc, data, flags, came_ns))

    def note(self, gateway: RecordedGateway, now: int) -> None:
        """Record the gateway's state and devices. A replay of a later part begins with them."""
        self._devices = devices_of(gateway)
        if now - self._state_ns >= STATE_NS:
            self._state_ns = now
            self.put(now, EntryKind.STATE, 0, json_payload(state_of(gateway)), 0)

    def reports(self, now: int) -> list[Report]:
        """Return the begins and ends of faults since the last call."""
        taken = self._worker.reports(f"captures: {self._folder}", _SLOW_NS, now)
        if self._overflowed >= max(1, 2 * self._reported_overflow):
            self._reported_overflow = self._overflowed
            text = (
                f"captures: {self._overflowed} entries could not be recorded so far, "
                "because the disk is too slow"
            )
            taken.append(Report("captures: losses", True, text))
        self.facts.lost = self._overflowed + self._unwritten
        return taken

    def mark(self) -> None:
        """Report an event that the user has noticed. Only an EventRecorder follows it.

        A signal handler may call it, so it must not use a lock.
        """

    def take_events(self) -> list[tuple[str, str]]:
        """Return name and line for the log of each new event. Only an EventRecorder has events."""
        return []

    def close(self) -> None:
        """Write the waiting entries and end the thread. Waits at most 0.35 s for the disk."""
        self._worker.stop(_CLOSE_S)

    # --- in the recorder's thread

    def _wait(self) -> None:
        self._worker.pause(PERIOD_S)

    def _work(self, _items: list[None]) -> None:
        """Write the waiting entries."""
        entries = self._entries
        while True:
            items = [entries.popleft() for _ in range(min(_AT_ONCE, len(entries)))]
            now = self._clock()
            given = len(items)
            remarked = self._recorded_losses
            try:
                self._write(items, now)
            except Exception as error:  # a bug must not end the recorder either
                if not self._keeps_items:
                    self._unwritten += given
                    self._recorded_losses = remarked  # a remark was not written either
                self._fail(error, now)
                break
            if not entries:
                break

    def _write(self, items: list[Item], now: int) -> None:
        if now >= self._check_ns:
            self._check(now)
        if not self._is_usable:
            self._unwritten += len(items)
            return
        if self._file is None:
            self._file = self._new_part(items[0][0] if items else now)
        file = self._file
        if self._devices != self._recorded_devices:
            self._recorded_devices = self._devices
            file.write(b"I", json_payload({"devices": self._recorded_devices}))
        if items:
            self._append_remarks(items, now)
            file.append(packed(data_payload(items)))
        self._complete_block(file, now)

    def _complete_block(self, file: "CapturePart", now: int) -> None:
        """Force the file to the disk. End the part if it is old or large enough."""
        self.facts.bytes += file.sync()
        self.facts.file = str(file.path)
        if self.facts.problem:
            self._note_problem("", f"recording to {file.path}")
        is_old = now - file.begun >= self._config.part_minutes * 60 * SECOND
        if is_old or file.size >= self._config.part_mb * _MB:
            self._end_part()

    def _check(self, now: int) -> None:
        """Check if the folder can be used and has enough free space.

        Also removes the oldest captures. Raises OSError if the folder cannot be used.
        """
        self._check_ns = now + _CHECK_NS
        self._is_usable = False
        self._make_folder()
        remove_oldest(self._folder, self._config.keep_mb * _MB, self._spared)
        status = os.statvfs(self._folder)
        free_bytes = status.f_bavail * status.f_frsize
        minimum = self._config.min_free_mb
        self._is_usable = free_bytes >= minimum * _MB
        if not self._is_usable:
            self._end_part()
            text = f"{self._folder}: less than {minimum} MB are free, so nothing is recorded"
            self._note_problem(text)

    def _make_folder(self) -> None:
        self._folder.mkdir(mode=0o750, parents=True, exist_ok=True)
        if not os.access(self._folder, os.W_OK | os.X_OK):
            raise PermissionError(1, "the folder is not writable")

    def _append_remarks(self, items: list[Item], now: int) -> None:
        """Append entries about losses and the wall clock.

        They have the time of the last entry, because times must not decrease.
        """
        last = items[-1][0]
        lost = self._overflowed + self._unwritten - self._recorded_losses
        if lost > 0:
            self._recorded_losses += lost
            items.append(remark_of_losses(last, lost))
        clock = self.clock_facts
        recorded = self._recorded_clock
        is_changed = (clock.synchronized, clock.steps) != (recorded.synchronized, recorded.steps)
        if is_changed or now - self._clock_ns >= _CLOCK_NS:
            self._clock_ns = now
            self._recorded_clock = clock
            offset = time.time_ns() - self._clock()
            if is_changed or abs(offset - self._offset) > _STEP_NS:
                self._offset = offset
                flags = CLOCK_FLAGS[clock.synchronized]
                items.append((last, EntryKind.CLOCK, 0, numbers_data(last + offset), flags, None))

    def _fail(self, error: Exception, now: int) -> None:
        file = self._file
        self._file = None
        if file is not None:
            file.abandon()
        self.facts.file = ""
        self._check_ns = now + _CHECK_NS
        self._is_usable = False
        reason = reason_of(error)
        self._note_problem(f"{self._folder}: cannot be written: {reason}. Trying again.")

    def _note_problem(self, problem: str, end: str = "") -> None:
        """Report the problem that prevents recording. An empty problem reports ``end`` instead."""
        self.facts.problem = problem
        self._worker.faults.note("captures: folder", bool(problem), f"captures: {problem or end}")

    def _new_part(self, since: int) -> "CapturePart":
        """Create the next part of the capture. ``since`` is the time of its first entry."""
        now = self._clock()
        self._offset = time.time_ns() - now
        self._clock_ns = now
        self._recorded_clock = self.clock_facts
        return self._open_part(since, self._offset, self.clock_facts, self.header)

    def _open_part(
        self,
        since: int,
        offset: int,
        clock: ClockFacts,
        known: Mapping[str, Any],
    ) -> "CapturePart":
        """Create the next part of the capture.

        ``offset`` and ``clock`` are the state of the wall clock at ``since``. ``known`` has the
        keys of the header that are the same in all parts.
        """
        wall = since + offset
        if not self._stamp:
            self._stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(wall // SECOND))
        part = self._part
        self._part += 1  # also after a failure, so that no name is tried twice
        self._recorded_devices = self._devices
        header = dict(known) | {
            "run": self._run,
            "part": part,
            "monotonic_ns": since,
            "wall_ns": wall,
            "devices": self._recorded_devices,
            "clock": clock._asdict(),
        }
        name = f"{self._stamp}-{self._run[:6]}-{part:05d}{SUFFIX}"
        return CapturePart(self._folder / name, json_payload(header), self._clock())

    def _end(self) -> None:
        """End the recording."""
        self._end_part()

    def _end_part(self) -> None:
        file = self._file
        self._file = None
        if file is not None:
            self.facts.file = ""
            self.facts.bytes += file.close()


def remark_of_losses(time_ns: int, lost: int) -> Item:
    """Return the entry about entries that could not be recorded."""
    return time_ns, EntryKind.LOST, 0, numbers_data(lost), 0, None


class CapturePart:
    """One file of a capture. It is locked while it is written."""

    def __init__(self, path: Path, header: bytes, now: int) -> None:
        self.path = path
        self.begun = now
        self.size = 0
        self._number = 0
        self._new = 0
        """Number of bytes written since the last ``sync``."""
        self._header: bytes | None = header
        """The header until it has been written a second time."""
        self._fd = open_regular(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o640)
        try:
            with contextlib.suppress(OSError):  # some file systems have no locks
                fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self.write(b"H", header)
            with contextlib.suppress(OSError):  # some file systems cannot sync a folder
                sync_folder(path.parent)
        except BaseException:
            os.close(self._fd)
            with contextlib.suppress(OSError):
                self.path.unlink()
            raise

    def write(self, kind: bytes, payload: bytes) -> None:
        """Append a block."""
        self._write(kind, packed(payload))

    def _write(self, kind: bytes, payload: Packed) -> None:
        data = block_of(kind, self._number, payload)
        self._number += 1
        self.size += len(data)
        self._new += len(data)
        write_all(self._fd, data)

    def append(self, payload: Packed) -> None:
        """Append a block with entries (``data_payload``)."""
        self._write(b"D", payload)
        if self._header is not None:
            # The header is written twice, because without it the file cannot be read.
            self.write(b"H", self._header)
            self._header = None

    def sync(self) -> int:
        """Force the file to the disk. Returns the number of bytes written since the last call.

        Raises OSError if the file was removed.
        """
        if os.fstat(self._fd).st_nlink == 0:
            raise OSError(errno.ENOENT, "the file was removed while it was being written")
        if self._new:
            self._force()
        new = self._new
        self._new = 0
        return new

    def _force(self) -> None:
        """Force content and size to the disk.

        f2fs (Linux 6.1) may flush the disk before it has written the new size. A second call then
        flushes the size, too. Otherwise the block is lost if power fails before the next one.
        """
        os.fsync(self._fd)
        os.fsync(self._fd)

    def close(self) -> int:
        """Write the end and close. Returns the number of bytes since the last ``sync``."""
        try:
            self.write(b"E", b"")
            self._force()
        finally:
            os.close(self._fd)
        return self._new

    def abandon(self) -> None:
        """Close without writing the end."""
        with contextlib.suppress(OSError):
            os.close(self._fd)


def remove_oldest(folder: Path, keep_bytes: int, spared: Path | None = None) -> None:
    """Remove the oldest captures until the folder has at most ``keep_bytes``.

    0 means no limit. ``spared`` and files that any process is writing are kept.
    """
    if not keep_bytes:
        return
    found: list[tuple[int, str, int, Path]] = []
    for entry in os.scandir(folder):
        with contextlib.suppress(FileNotFoundError):  # another gateway has removed it
            if _OURS.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
                status = entry.stat()
                found.append((status.st_mtime_ns, entry.name, status.st_size, Path(entry.path)))
    total = sum(size for _, _, size, _ in found)
    for _, _, size, path in sorted(found):
        if total <= keep_bytes:
            return
        if path != spared and not is_locked(path):
            with contextlib.suppress(OSError):
                path.unlink()
                total -= size
