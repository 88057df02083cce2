"""The gateway's document of itself (snapshot.py), once a second: to a file that is replaced, and for Prometheus.

What may touch what: everything is called by the loop's thread; only ``_work`` and what it calls run in the worker. The newest document,
the reports and the marks of a write in progress go from one to the other by single assignments and a deque: no lock, so that no disk and
no reader of the statistics, be it slow or hostile, holds the loop up. The worker writes and answers in turn: a disk that does not answer
holds up Prometheus too, nothing else.
"""

import contextlib
import errno
import json
import os
import selectors
import stat
import threading
import time
from collections import deque
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.runtime.locks import Locks
from kontronik_can_gw.runtime.snapshot import STALE_NS, Document, with_rates
from kontronik_can_gw.runtime.threads import start_beside_the_loop

if TYPE_CHECKING:
    from kontronik_can_gw.runtime.prometheus import MetricsServer

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
    """The thread that writes the file and answers Prometheus. RunError at once where the address cannot be had.

    With neither of them there is no thread, and nothing is wanted.
    """

    def __init__(self, file: Path | None, prometheus: tuple[str, int] | None) -> None:
        self._file = None if file is None else _StatusFile(file)
        self._server = None if prometheus is None else _server_at(prometheus)
        self._locks = Locks()
        if file is not None and self._locks.hold([f"{os.path.realpath(file)}/statistics/0"]):
            if self._server is not None:
                self._server.stop_listening()
            raise RunError(
                f"statistics.file {file}: another gateway writes it. Give this one its own."
            )
        self._newest: Document | None = None
        self._reports: deque[Report] = deque()
        self._writing_since: int | None = None
        self._told_slow = False
        self._closed = False
        self._thread: threading.Thread | None = None
        self._due: int | None = None
        self._wake = -1
        if self._file is not None or self._server is not None:
            try:
                self._start()
            except (OSError, RuntimeError) as error:
                if self._server is not None:
                    self._server.stop_listening()
                raise RunError(f"statistics: cannot be begun: {error}") from None
            self._due = 0

    @property
    def address(self) -> tuple[str, int] | None:
        """Where Prometheus may ask."""
        return None if self._server is None else self._server.address

    @property
    def due(self) -> int | None:
        """When the next document is wanted; None for never."""
        return self._due

    def wanted(self, now: int) -> bool:
        """True once a second, where anybody wants a document."""
        return self._due is not None and now >= self._due

    def publish(self, document: Document) -> None:
        """Let this be the newest document; never blocks. It is not to be changed any more."""
        if self._thread is None or self._closed:
            return
        self._due = document["monotonic_ns"] + PERIOD_NS
        self._newest = document
        os.eventfd_write(self._wake, 1)

    def reports(self, now: int) -> list[Report]:
        """Take what went wrong, or is right again, since the last call."""
        taken: list[Report] = []
        while self._reports:
            taken.append(self._reports.popleft())
        since = self._writing_since
        if since is not None and now - since > STALE_NS and not self._told_slow:
            self._told_slow = True
            taken.append(
                Report(True, f"{self._file}: the disk does not answer; the gateway is not held up.")
            )
        elif since is None and self._told_slow:
            self._told_slow = False
            taken.append(Report(False, f"{self._file}: the disk answers again"))
        return taken

    def close(self) -> None:
        """Remove the file and end the thread; a disk that does not answer is waited for 0.2 s and no longer."""
        if self._thread is None or self._closed:
            return
        self._closed = True
        self._locks.close()
        os.eventfd_write(self._wake, 1)
        self._thread.join(_CLOSE_S)
        if self._server is not None:
            self._server.stop_listening()
        if not self._thread.is_alive():
            os.close(self._wake)
            self._wake = -1

    def _start(self) -> None:
        selector = selectors.DefaultSelector()
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        selector.register(self._wake, selectors.EVENT_READ)
        thread = threading.Thread(
            target=self._run, args=(selector,), name="statistics", daemon=True
        )
        if not start_beside_the_loop(thread):
            raise RuntimeError("no thread can be started")
        self._thread = thread

    def _run(self, selector: selectors.BaseSelector) -> None:
        try:
            self._work(selector)
        except Exception as error:  # a mistake of ours in here must not go unsaid
            self._reports.append(Report(True, f"the statistics have ended: {error!r}"))

    def _work(self, selector: selectors.BaseSelector) -> None:
        file, server = self._file, self._server
        done: Document | None = None
        if file is not None:
            file.tidy()
        with selector:
            if server is not None:
                server.listen(selector)
            while not self._closed:
                now = time.monotonic_ns()
                ready = selector.select(None if server is None else server.pause_s(now))
                now = time.monotonic_ns()
                for key, _ in ready:
                    if key.fd == self._wake:
                        with contextlib.suppress(BlockingIOError):
                            os.eventfd_read(self._wake)
                    elif server is not None:
                        server.serve(key.fileobj, now)
                if server is not None:
                    server.advance(now)
                document = self._newest
                if document is not done and document is not None:
                    if server is not None:
                        server.document = document
                    if file is not None and not self._closed:
                        self._write(file, with_rates(document, done))
                    done = document
            if server is not None:
                server.close()
        if file is not None:
            file.remove()

    def _write(self, file: "_StatusFile", document: Document) -> None:
        data = (
            json.dumps(document, ensure_ascii=False, separators=(",", ":")).encode(
                "utf-8", "replace"
            )
            + b"\n"
        )
        self._writing_since = time.monotonic_ns()
        if (report := file.write(data)) is not None:
            self._reports.append(report)
        self._writing_since = None


def _server_at(address: tuple[str, int]) -> "MetricsServer":
    from kontronik_can_gw.runtime.prometheus import MetricsServer

    return MetricsServer(address)


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
        """Replace the file; what there is to tell of it. It is not forced to the disk: after a loss of power nobody wants it."""
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
        with contextlib.suppress(FileNotFoundError):
            if not stat.S_ISREG(self._path.lstat().st_mode):
                # /dev/null would be gone, for everybody
                raise OSError(errno.EINVAL, "what is there is no plain file")
        self._temporary.unlink(missing_ok=True)
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
