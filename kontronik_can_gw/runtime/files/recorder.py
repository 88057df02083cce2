"""Captures of a running gateway: a folder of .kcap files (capture/format.py), written by a thread.

What may touch what: ``put``, ``note`` and ``reports`` are called by the loop's thread and never wait; only ``_work`` and
what it calls touch the disk. Entries go from one to the other by a deque with a bound: what finds no room is counted, and the count is
recorded when there is room again. Each half second what has come is one block, forced to the disk: a loss of power costs that and no more.
A fault of the disk is reported once, tried again each five seconds, and never ends the gateway nor the recorder.
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
    SUFFIX,
    Kind,
    block,
    data_payload,
    json_payload,
    numbers_data,
)
from kontronik_can_gw.capture.recorded_gateway import devices_of, state_of
from kontronik_can_gw.config.keys import RecordConfig
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.files.disk import is_locked, reason_of, sync_folder, write_all
from kontronik_can_gw.runtime.system.worker import Report, Worker
from kontronik_can_gw.times import MS, SECOND

CAPACITY = 50_000
"""Entries that may wait to be written: about two minutes of one ESC, 15 seconds of eight."""
PERIOD_S = 0.5
_AT_ONCE = 5000
"""Entries taken together, so that other threads have their turn between."""
_CLOSE_S = 0.35
_CHECK_NS = 5 * SECOND
"""How often the folder is looked at, and a disk tried again that failed."""
_CLOCK_NS = 10 * SECOND
_STATE_NS = 2 * SECOND
_STEP_NS = MS
_SLOW_NS = 5 * SECOND
_MB = 1_000_000
_OURS = re.compile(rf"[0-9]{{8}}T[0-9]{{6}}Z-[0-9a-f]{{6}}-[0-9]+{SUFFIX}")
Item = tuple[int, int, int, bytes, int, int | None]
"""(time, kind, ESC, data, flags, time of arrival), as of ``capture.Entry``."""


@dataclass
class RecorderFacts:
    """How recording goes, for the statistics."""

    file: str = ""
    """The capture that is being written; empty while none is."""
    bytes: int = 0
    """Written since the start."""
    lost: int = 0
    """Entries that were not recorded."""
    problem: str = ""


class Recorder:
    """Writes what it is given from ``start`` until ``close``."""

    def __init__(
        self, folder: Path, config: RecordConfig, clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.facts = RecorderFacts()
        self.header: Mapping[str, Any] = {}
        """What is known of gateway and ESCs, set before ``start``; a part's own numbers are added."""
        self.words = str(folder)
        """What is logged when it begins."""
        self._folder, self._config = folder, config
        self._clock = clock
        self._entries: deque[Item] = deque()
        self._overflowed = self._reported_overflow = 0
        """Entries that found no room: the loop's count."""
        self._unwritten = self._recorded_losses = 0
        """Entries that could not be written: the thread's count."""
        self._state_ns = self._check_ns = self._clock_ns = self._offset = 0
        self._devices: list[Any] = []
        self._recorded_devices: list[Any] = []
        self._worker: Worker[None] = Worker(
            "recorder", self._work, wait=self._wait, ended=self._end_part, clock=clock
        )
        self._is_usable = False
        """The folder was, when it was last looked at."""
        self._file: CapturePart | None = None
        self._run = os.urandom(8).hex()
        self._stamp = ""
        self._part = 0

    # --- the loop's side

    def start(self, wait: bool = False) -> None:
        """Begin to write. RunError where the folder cannot be used, unless ``wait``: then it is tried again and again."""
        try:
            self._make_folder()
        except OSError as error:
            if not wait:
                raise RunError(
                    f"captures: {self._folder}: {error.strerror}. Give another folder (record.directory, --record)."
                ) from None
        if not self._worker.start():
            raise RunError("captures: the system gives no thread to write them")

    def put(
        self, time_ns: int, kind: int, esc: int, data: bytes, flags: int, came_ns: int | None = None
    ) -> None:
        """Record an entry, as of ``capture.Entry``. Never waits."""
        if len(self._entries) >= CAPACITY:
            self._overflowed += 1
        else:
            self._entries.append((time_ns, kind, esc, data, flags, came_ns))

    def note(self, gateway: Gateway, now: int) -> None:
        """How the gateway is now: what a replay of a later part begins with, and what is known of the devices."""
        self._devices = devices_of(gateway)
        if now - self._state_ns >= _STATE_NS:
            self._state_ns = now
            self.put(now, Kind.STATE, 0, json_payload(state_of(gateway)), 0)

    def reports(self, now: int) -> list[Report]:
        """Take what went wrong, or is right again, since the last call."""
        taken = self._worker.reports(f"captures: {self._folder}", _SLOW_NS, now)
        if self._overflowed >= max(1, 2 * self._reported_overflow):
            self._reported_overflow = self._overflowed
            text = f"captures: {self._overflowed} entries could not be recorded so far: the disk is too slow"
            taken.append(Report("captures: losses", True, text))
        self.facts.lost = self._overflowed + self._unwritten
        return taken

    def close(self) -> None:
        """Write what waits and end the thread; a disk that does not answer is waited for 0.35 s and no longer."""
        self._worker.stop(_CLOSE_S)

    # --- the thread's side

    def _wait(self) -> None:
        self._worker.pause(PERIOD_S)

    def _work(self, _items: list[None]) -> None:
        """Write what has come."""
        entries = self._entries
        while True:
            items = [entries.popleft() for _ in range(min(_AT_ONCE, len(entries)))]
            now = self._clock()
            try:
                self._write(items, now)
            except Exception as error:  # a mistake of ours is no reason to end either
                self._unwritten += len(items)
                self._fail(error, now)
            if not entries or self._file is None:
                break

    def _write(self, items: list[Item], now: int) -> None:
        if now >= self._check_ns:
            self._check(now)
        if not self._is_usable:
            self._unwritten += len(items)
            return
        file = self._file = self._file or self._new_part(items[0][0] if items else now)
        if self._devices != self._recorded_devices:
            self._recorded_devices = self._devices
            file.write(b"I", json_payload({"devices": self._recorded_devices}))
        if items:
            self._remark(items, now)
            file.take(items)
        self.facts.bytes += file.sync()
        self.facts.file = str(file.path)
        if self.facts.problem:
            self._note_problem("", f"{file.path} is written")
        is_old = now - file.begun >= self._config.part_minutes * 60 * SECOND
        if is_old or file.size >= self._config.part_mb * _MB:
            self._end_part()

    def _check(self, now: int) -> None:
        """Whether something may be written to the folder from now on. OSError where it cannot be used."""
        self._check_ns, self._is_usable = now + _CHECK_NS, False
        self._make_folder()
        remove_oldest(self._folder, self._config.keep_mb * _MB)
        found, minimum = os.statvfs(self._folder), self._config.min_free_mb
        self._is_usable = found.f_bavail * found.f_frsize >= minimum * _MB
        if not self._is_usable:
            self._end_part()
            text = f"{self._folder}: less than {minimum} MB are free: nothing is recorded"
            self._note_problem(text)

    def _make_folder(self) -> None:
        self._folder.mkdir(mode=0o750, parents=True, exist_ok=True)
        if not os.access(self._folder, os.W_OK | os.X_OK):
            raise PermissionError(1, "may not be written to")

    def _remark(self, items: list[Item], now: int) -> None:
        """Add what only the recorder knows, at the time of the last entry: times do not decrease."""
        last = items[-1][0]
        if (lost := self._overflowed + self._unwritten - self._recorded_losses) > 0:
            self._recorded_losses += lost
            items.append((last, Kind.LOST, 0, numbers_data(lost), 0, None))
        if now - self._clock_ns >= _CLOCK_NS:
            self._clock_ns = now
            offset = time.time_ns() - self._clock()
            if abs(offset - self._offset) > _STEP_NS:
                self._offset = offset
                items.append((last, Kind.CLOCK, 0, numbers_data(last + offset), 0, None))

    def _fail(self, error: Exception, now: int) -> None:
        file, self._file = self._file, None
        if file is not None:
            file.abandon()
        self.facts.file = ""
        self._check_ns, self._is_usable = now + _CHECK_NS, False
        reason = reason_of(error)
        self._note_problem(f"{self._folder}: cannot be written: {reason}. Trying again.")

    def _note_problem(self, problem: str, over: str = "") -> None:
        """Nothing is recorded now because of a problem, or it is again."""
        self.facts.problem = problem
        self._worker.faults.note("captures: folder", bool(problem), f"captures: {problem or over}")

    def _new_part(self, since: int) -> "CapturePart":
        """``since``: time of its first entry."""
        now = self._clock()
        self._offset = time.time_ns() - now
        self._clock_ns = now
        wall = since + self._offset
        if not self._stamp:
            self._stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(wall // SECOND))
        part, self._part = self._part, self._part + 1  # a name is tried once
        self._recorded_devices = self._devices
        header = dict(self.header) | {
            "run": self._run,
            "part": part,
            "monotonic_ns": since,
            "wall_ns": wall,
            "devices": self._recorded_devices,
        }
        name = f"{self._stamp}-{self._run[:6]}-{part:05d}{SUFFIX}"
        return CapturePart(self._folder / name, json_payload(header), now)

    def _end_part(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            self.facts.file = ""
            self.facts.bytes += file.close()


class CapturePart:
    """One file of a capture, locked while it is written."""

    def __init__(self, path: Path, header: bytes, now: int) -> None:
        self.path = path
        self.begun = now
        self.size = 0
        self._number = 0
        self._new = 0
        self._header: bytes | None = header
        self._fd = os.open(
            self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o640
        )
        try:
            with contextlib.suppress(OSError):  # a file system without locks
                fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self.write(b"H", header)
            with contextlib.suppress(OSError):  # a file system that cannot
                sync_folder(path.parent)
        except BaseException:  # nothing is in there yet
            os.close(self._fd)
            with contextlib.suppress(OSError):
                self.path.unlink()
            raise

    def write(self, kind: bytes, payload: bytes) -> None:
        """Append a block."""
        data = block(kind, self._number, payload)
        self._number += 1
        self.size += len(data)
        self._new += len(data)
        write_all(self._fd, data)

    def take(self, items: list[Item]) -> None:
        """Append what came."""
        self.write(b"D", data_payload(items))
        if self._header is not None:
            # once more, elsewhere: without it nothing can be made of the rest
            self.write(b"H", self._header)
            self._header = None

    def sync(self) -> int:
        """Force to the disk what was written; how many bytes since the last call. OSError where somebody removed a file."""
        if os.fstat(self._fd).st_nlink == 0:
            raise OSError(errno.ENOENT, "what was being written was removed")
        if self._new:
            os.fdatasync(self._fd)
        new, self._new = self._new, 0
        return new

    def close(self) -> int:
        """Close in good order; how many bytes since the last ``sync``."""
        try:
            self.write(b"E", b"")
            os.fdatasync(self._fd)
        finally:
            os.close(self._fd)
        return self._new

    def abandon(self) -> None:
        """Close without writing any more."""
        with contextlib.suppress(OSError):
            os.close(self._fd)


def remove_oldest(folder: Path, keep_bytes: int) -> None:
    """Keep the folder below a size, 0: any; what is being written, by any process, stays."""
    if not keep_bytes:
        return
    found: list[tuple[int, str, int, Path]] = []
    for path in folder.iterdir():
        with contextlib.suppress(FileNotFoundError):  # another gateway has removed it
            if _OURS.fullmatch(path.name) and not path.is_symlink() and path.is_file():
                status = path.stat()
                found.append((status.st_mtime_ns, path.name, status.st_size, path))
    total = sum(size for _, _, size, _ in found)
    for _, _, size, path in sorted(found):
        if total <= keep_bytes:
            return
        if not is_locked(path):  # it is being written
            with contextlib.suppress(OSError):
                path.unlink()
                total -= size
