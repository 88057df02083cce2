"""The gateway's document of itself (snapshot.py), once a second, to a file that is replaced.

What may touch what: everything is called by the loop's thread; only ``_work``, ``_fail``, ``_end`` and the file's methods run in the
worker's. What the newest document is made of and the mark of a write in progress go from one to the other by single assignments, so that
neither a disk nor the making holds the loop up.
"""

import contextlib
import errno
import os
import stat
import time
from itertools import count
from pathlib import Path

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.runtime.disk import reason_of, write_all
from kontronik_can_gw.runtime.locks import Locks
from kontronik_can_gw.runtime.snapshot import STALE_NS, Moment, snapshot
from kontronik_can_gw.runtime.worker import Faults, Report, Worker

PERIOD_NS = SECOND
_CLOSE_S = 0.2


def default_file() -> Path | None:
    """Where the statistics go if the configuration does not say: into what systemd gives the service, else nowhere."""
    given = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    return Path(given) / "status.json" if given else None


class Statistics:
    """The thread that writes the file. Without a file there is no thread, and nothing is wanted."""

    def __init__(self, file: Path | None) -> None:
        self.due: int | None = None
        """When the next document is wanted; None: never."""
        self._faults = Faults()
        self._newest: Moment | None = None
        self._written: Moment | None = None
        """What the last document was made of; of the worker's thread."""
        self._writing_since: int | None = None
        self._locks = Locks()
        self._worker: Worker[None] | None = None
        if file is None:
            return
        if self._locks.hold([f"{os.path.realpath(file)}/statistics/0"]):
            raise RunError(
                f"statistics.file {file}: another gateway writes it. Give this one its own."
            )
        self.due = 0
        self._file = _StatusFile(file)
        try:
            self._worker = Worker(
                "statistics", self._work, failed=self._fail, ended=self._file.remove, capacity=1
            )
            if not self._worker.start():
                raise RunError("statistics: cannot be begun: no thread can be started")
        except OSError as error:
            raise RunError(f"statistics: cannot be begun: {error}") from None

    def wanted(self, now: int) -> bool:
        """True once a second, where anybody wants a document."""
        return self.due is not None and now >= self.due

    def publish(self, moment: Moment) -> None:
        """Let this be what the newest document is made of; never blocks."""
        if self._worker is not None and not self._worker.is_ending:
            self.due = moment.now + PERIOD_NS
            self._newest = moment
            self._worker.put(None)  # without room it is awake already

    def reports(self, now: int) -> list[Report]:
        """Take what went wrong, or is right again, since the last call."""
        if self._worker is not None:
            since = self._writing_since
            is_slow = since is not None and now - since > STALE_NS
            text = "does not answer; the gateway is not held up." if is_slow else "answers again"
            if is_slow or since is None:
                self._faults.note("statistics: disk", is_slow, f"{self._file}: the disk {text}")
        return self._faults.take()

    def close(self) -> None:
        """Remove the file and end the thread; a disk that does not answer is waited for 0.2 s and no longer."""
        if self._worker is not None:
            self._locks.close()
            self._worker.stop(_CLOSE_S)

    def _work(self, _items: list[None]) -> None:
        """Write the newest document."""
        moment, before = self._newest, self._written
        if moment is None or moment is before:
            return
        self._written = moment
        if self._worker is not None and not self._worker.is_ending:
            text = snapshot(moment, before)
            self._writing_since = time.monotonic_ns()
            try:
                self._write(f"{text}\n".encode("utf-8", "replace"))
            finally:
                self._writing_since = None
        self._faults.note("statistics", False, "the statistics work again")

    def _write(self, data: bytes) -> None:
        name, file = "statistics: file", self._file
        try:
            file.write(data)
        except OSError as error:
            text = f"{file}: cannot be written: {reason_of(error)}. Trying again."
            self._faults.note(name, True, text)
        else:
            self._faults.note(name, False, f"{file}: is written again")

    def _fail(self, error: Exception) -> None:
        """A mistake of ours in here must not go unsaid."""
        self._faults.note("statistics", True, f"the statistics fail: {error!r}. Trying again.")


_numbers = count()


class _StatusFile:
    """A file that is replaced, never changed: a reader sees the old content or the new one, whole."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._temporary = path.with_name(f".{path.name}.{os.getpid()}-{next(_numbers)}.tmp")
        self._ours: tuple[int, int] | None = None

    def __str__(self) -> str:
        return f"statistics file {self._path}"

    def write(self, data: bytes) -> None:
        """Replace the file. OSError where that fails. It is not forced to the disk: after a loss of power nobody wants it."""
        if self._ours is None:
            self._tidy()
        try:
            self._replace(data)
        except OSError:
            with contextlib.suppress(OSError):
                self._temporary.unlink()
            raise

    def remove(self) -> None:
        """Remove the file if it is still ours."""
        with contextlib.suppress(OSError):
            found = self._path.lstat()
            if (found.st_dev, found.st_ino) == self._ours:
                self._path.unlink()

    def _tidy(self) -> None:
        """Remove what killed writers left half."""
        with contextlib.suppress(OSError):
            for entry in self._path.parent.iterdir():
                if entry.name.startswith(f".{self._path.name}.") and entry.name.endswith(".tmp"):
                    entry.unlink()

    def _replace(self, data: bytes) -> None:
        with contextlib.suppress(FileNotFoundError):
            if not stat.S_ISREG(self._path.lstat().st_mode):
                # /dev/null would be gone, for everybody
                raise OSError(errno.EINVAL, "what is there is no plain file")
        fd = os.open(self._temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        try:
            os.fchmod(fd, 0o644)
            write_all(fd, data)
            found = os.fstat(fd)
        finally:
            os.close(fd)
        self._temporary.replace(self._path)
        self._ours = (found.st_dev, found.st_ino)
