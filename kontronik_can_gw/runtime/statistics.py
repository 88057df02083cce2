"""The gateway's document of itself (snapshot.py), once a second, to a file that is replaced.

What may touch what: everything is called by the loop's thread; only ``_work``, ``_fail``, ``_end`` and what they call run in the worker's.
The newest document, the reports and the mark of a write in progress go from one to the other by single assignments and a deque, so that no
disk holds the loop up.
"""

import contextlib
import errno
import json
import os
import stat
import time
from collections import deque
from itertools import count
from pathlib import Path
from typing import NamedTuple

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.runtime.locks import Locks
from kontronik_can_gw.runtime.snapshot import STALE_NS, Document, with_rates
from kontronik_can_gw.runtime.worker import Worker

PERIOD_NS = SECOND
_CLOSE_S = 0.2


class Report(NamedTuple):
    """A fault of the statistics themselves that begins, or is over."""

    begins: bool
    text: str


def default_file() -> Path | None:
    """Where the statistics go if the configuration does not say: into what systemd gives the service, else nowhere."""
    given = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    return Path(given) / "status.json" if given else None


class Statistics:
    """The thread that writes the file. Without a file there is no thread, and nothing is wanted."""

    def __init__(self, file: Path | None) -> None:
        self._file = None if file is None else _StatusFile(file)
        self._locks = Locks()
        if file is not None and self._locks.hold([f"{os.path.realpath(file)}/statistics/0"]):
            raise RunError(
                f"statistics.file {file}: another gateway writes it. Give this one its own."
            )
        self._newest: Document | None = None
        self._written: Document | None = None
        """The last document; of the worker's thread."""
        self._failed = False
        self._reports: deque[Report] = deque()
        self._writing_since: int | None = None
        self._reported_slow = False
        self._due: int | None = None
        self._worker: Worker[None] | None = None
        if self._file is not None:
            try:
                self._start()
            except (OSError, RuntimeError) as error:
                raise RunError(f"statistics: cannot be begun: {error}") from None
            self._due = 0

    @property
    def due(self) -> int | None:
        """When the next document is wanted; None for never."""
        return self._due

    def wanted(self, now: int) -> bool:
        """True once a second, where anybody wants a document."""
        return self._due is not None and now >= self._due

    def publish(self, document: Document) -> None:
        """Let this be the newest document; never blocks. It is not to be changed any more."""
        if self._worker is None or self._worker.is_ending:
            return
        self._due = document["monotonic_ns"] + PERIOD_NS
        self._newest = document
        self._worker.put(None)  # without room it is awake already

    def reports(self, now: int) -> list[Report]:
        """Take what went wrong, or is right again, since the last call."""
        taken: list[Report] = []
        while self._reports:
            taken.append(self._reports.popleft())
        since = self._writing_since
        if since is not None and now - since > STALE_NS and not self._reported_slow:
            self._reported_slow = True
            taken.append(
                Report(True, f"{self._file}: the disk does not answer; the gateway is not held up.")
            )
        elif since is None and self._reported_slow:
            self._reported_slow = False
            taken.append(Report(False, f"{self._file}: the disk answers again"))
        return taken

    def close(self) -> None:
        """Remove the file and end the thread; a disk that does not answer is waited for 0.2 s and no longer."""
        if self._worker is None:
            return
        self._locks.close()
        self._worker.stop(_CLOSE_S)

    def _start(self) -> None:
        worker: Worker[None] = Worker(
            "statistics", self._work, failed=self._fail, ended=self._end, capacity=1
        )
        if not worker.start():
            raise RuntimeError("no thread can be started")
        self._worker = worker

    def _work(self, _items: list[None]) -> None:
        """Write the newest document."""
        document, before = self._newest, self._written
        if document is not None and document is not before:
            self._written = document
            if self._file is not None and self._worker is not None and not self._worker.is_ending:
                self._write(self._file, with_rates(document, before))
            if self._failed:
                self._failed = False
                self._reports.append(Report(False, "the statistics work again"))

    def _fail(self, error: Exception) -> None:
        """A mistake of ours in here must not go unsaid."""
        self._failed = True
        self._reports.append(Report(True, f"the statistics fail: {error!r}. Trying again."))

    def _end(self) -> None:
        if self._file is not None:
            self._file.remove()

    def _write(self, file: "_StatusFile", document: Document) -> None:
        data = (
            json.dumps(document, ensure_ascii=False, separators=(",", ":")).encode(
                "utf-8", "replace"
            )
            + b"\n"
        )
        self._writing_since = time.monotonic_ns()
        try:
            report = file.write(data)
        finally:
            self._writing_since = None
        if report is not None:
            self._reports.append(report)


_numbers = count()


class _StatusFile:
    """A file that is replaced, never changed: a reader sees the old content or the new one, whole."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._temporary = path.with_name(f".{path.name}.{os.getpid()}-{next(_numbers)}.tmp")
        self._failures = 0
        self._ours: tuple[int, int] | None = None

    def __str__(self) -> str:
        return f"statistics file {self._path}"

    def write(self, data: bytes) -> Report | None:
        """Replace the file; returns what there is to report. It is not forced to the disk: after a loss of power nobody wants it."""
        try:
            self._replace(data)
        except OSError as error:
            with contextlib.suppress(OSError):
                self._temporary.unlink()
            self._failures += 1
            reason = error.strerror or str(error)
            return (
                None
                if self._failures > 1
                else Report(True, f"{self}: cannot be written: {reason}. Trying again.")
            )
        failures, self._failures = self._failures, 0
        return (
            Report(False, f"{self}: is written again ({failures} times it could not be)")
            if failures
            else None
        )

    def tidy(self) -> None:
        """Remove what killed writers left half."""
        with contextlib.suppress(OSError):
            for entry in self._path.parent.iterdir():
                if entry.name.startswith(f".{self._path.name}.") and entry.name.endswith(".tmp"):
                    entry.unlink()

    def remove(self) -> None:
        """Remove the file if it is still ours."""
        with contextlib.suppress(OSError):
            found = self._path.lstat()
            if (found.st_dev, found.st_ino) == self._ours:
                self._path.unlink()

    def _replace(self, data: bytes) -> None:
        if self._ours is None:
            self.tidy()
        with contextlib.suppress(FileNotFoundError):
            if not stat.S_ISREG(self._path.lstat().st_mode):
                # /dev/null would be gone, for everybody
                raise OSError(errno.EINVAL, "what is there is no plain file")
        fd = os.open(self._temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        try:
            os.fchmod(fd, 0o644)
            rest = memoryview(data)
            while rest:
                rest = rest[os.write(fd, rest) :]
            found = os.fstat(fd)
        finally:
            os.close(fd)
        self._temporary.replace(self._path)
        self._ours = (found.st_dev, found.st_ino)
