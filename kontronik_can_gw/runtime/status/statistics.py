"""Writes the status document (snapshot.py) to a file once a second.

All methods are called by the loop's thread, except ``_work``, ``_fail``, ``_write`` and ``_end``,
which run in the worker's thread. The data for the newest document is handed over by a single
assignment. So neither the disk nor the making of the document delays the loop.
"""

import contextlib
import errno
import json
import os
import time
from collections.abc import Callable
from pathlib import Path

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.runtime.files.disk import reason_of, write_new
from kontronik_can_gw.runtime.status.snapshot import PROGRAM, STALE_NS, Moment, snapshot
from kontronik_can_gw.runtime.system.folders import STATUS_FILE, make_runtime_folder, status_name
from kontronik_can_gw.runtime.system.locks import Locks
from kontronik_can_gw.runtime.system.worker import Report, Worker
from kontronik_can_gw.times import SECOND

PERIOD_NS = SECOND
_CLOSE_S = 0.2
_LARGEST = 1 << 22
"""More bytes than a status file ever has."""


def open_statistics(
    configured: Path | None,
    configuration: Path,
    warn: Callable[[str], object],
) -> "Statistics | None":
    """Start to publish the status of the gateway with this configuration.

    ``configured`` is the file of ``statistics.file``, or None. The status is written to that file.
    It can also be found in the runtime folder, in which ``kontronik-can-gw status`` searches for
    gateways. If that fails, ``warn`` gets the reason, and None is returned if there is no
    ``statistics.file`` either. Raises RunError if another gateway writes the configured file.
    """
    published: Path | None = None
    problem = ""
    try:
        published = _published_file(configuration)
        if configured is None:
            return Statistics(published)
    except RunError as error:
        problem = str(error)
    except OSError as error:
        problem = reason_of(error)
    if problem:
        warn(f"`kontronik-can-gw status` cannot show this gateway: {problem}")
    return None if configured is None else Statistics(configured, link=published)


def _published_file(configuration: Path) -> Path:
    """Return this gateway's file in the runtime folder. OSError if the folder cannot be created."""
    given = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    if given:  # systemd sets it for the service
        return Path(given) / STATUS_FILE
    folder = make_runtime_folder("status")
    _remove_left_over(folder)
    return folder / status_name(configuration)


def _remove_left_over(folder: Path) -> None:
    """Remove the status files of gateways that were killed.

    A running gateway holds a lock on its file. A lock is not visible in other network namespaces,
    so a file that was written recently is kept, too.
    """
    for path in folder.glob("*.json"):
        locks = Locks(report=lambda _: None)
        if not _is_recent(path) and not locks.lock_only([_lock_name(path)]):
            with contextlib.suppress(OSError):
                path.unlink()
        locks.close()


def _is_recent(path: Path) -> bool:
    """Return True if the file, or the file that a link leads to, was written recently."""
    try:
        return abs(time.time_ns() - path.stat().st_mtime_ns) <= STALE_NS
    except OSError:
        return False


def _lock_name(file: Path) -> str:
    return f"{os.path.realpath(file)}/statistics/0"


NOT_OURS = "it exists and is not a status file. Remove it, or choose another name"
"""The reason why a file is not replaced."""


def has_other_content(path: Path) -> bool:
    """Return True if a file has content that no gateway has written as its status."""
    try:
        with path.open("rb") as file:
            content = file.read(_LARGEST)
    except FileNotFoundError:
        return False
    if not content:
        return False
    try:
        document = json.loads(content)
    except (ValueError, RecursionError):
        return True
    return not isinstance(document, dict) or document.get("program") != PROGRAM


class Statistics:
    """The thread that writes the file.

    ``link`` is a symbolic link to the file that is created together with it. Raises RunError if
    another gateway writes the file.
    """

    def __init__(self, file: Path, link: Path | None = None) -> None:
        self.due = 0
        """Time of the next document."""
        self._link = link
        self._path = file
        self._target = f"statistics file {file}"
        self._temporary = file.with_name(f".{file.name}.tmp")
        self._newest: Moment | None = None
        """Data for the next document."""
        self._written: Moment | None = None
        """Data of the last document. Only the worker's thread uses it."""
        self._is_ours = False
        """True if this gateway has written the file."""
        self._locks = Locks()
        if self._locks.lock_only([_lock_name(file)]):
            raise RunError(
                f"statistics.file {file}: another gateway writes it. "
                "Give each gateway its own file."
            )
        self._worker: Worker[None] = Worker(
            "statistics", self._work, failed=self._fail, ended=self._end, capacity=1
        )
        self._faults = self._worker.faults
        if not self._worker.start():
            raise RunError(
                "statistics: cannot be written, because the system cannot start a thread"
            )

    def publish(self, moment: Moment) -> None:
        """Let the thread write a document from this data. Never blocks."""
        self.due = moment.now + PERIOD_NS
        self._newest = moment
        self._worker.put(None)  # if the queue is full, the thread is already awake

    def reports(self, now: int) -> list[Report]:
        """Return the begins and ends of faults since the last call."""
        return self._worker.reports(self._target, STALE_NS, now)

    def close(self) -> None:
        """Remove the file and end the thread. Waits at most 0.2 s for the disk."""
        self._worker.stop(_CLOSE_S)
        self._locks.close()

    def _work(self, _items: list[None]) -> None:
        """Write the newest document."""
        moment = self._newest
        before = self._written
        if moment is None or moment is before or self._worker.is_ending:
            return
        self._written = moment
        self._write(f"{snapshot(moment, before)}\n".encode("utf-8", "replace"))
        self._faults.note("statistics", False, "statistics: written again")

    def _write(self, data: bytes) -> None:
        """Replace the file, so that a reader always finds the whole old or new content.

        The content is forced to the disk first. Otherwise the file may be empty or full of zeros
        after a power loss.
        """
        path = self._path
        temporary = self._temporary
        condition = "statistics: file"
        try:
            # os.path and os.replace are cheaper than pathlib, and this runs every second.
            if not os.path.isfile(path) and path.exists():  # noqa: PTH113
                raise OSError(errno.EINVAL, "it is not a regular file")  # e.g. /dev/null
            if not self._is_ours and has_other_content(path):
                raise OSError(errno.EEXIST, NOT_OURS)
            write_new(temporary, data, 0o644)
            os.replace(temporary, path)  # noqa: PTH105
        except OSError as error:
            with contextlib.suppress(OSError):
                temporary.unlink()
            text = f"{self._target}: cannot be written: {reason_of(error)}. Trying again."
            self._faults.note(condition, True, text)
        else:
            if self._link is not None and not (self._is_ours and self._link.is_symlink()):
                self._make_link(self._link)
            self._is_ours = True
            self._faults.note(condition, False, f"{self._target}: is written again")

    def _make_link(self, link: Path) -> None:
        """Create the link to the file, or replace an earlier gateway's link.

        A failure is not reported, because only the command `status` uses the link.
        """
        if os.path.realpath(link) == os.path.realpath(self._path):
            return  # also if statistics.file is the published file itself
        temporary = link.with_name(f".{link.name}.{os.getpid()}")
        with contextlib.suppress(OSError):
            temporary.symlink_to(self._path.absolute())
            temporary.replace(link)

    def _fail(self, error: Exception) -> None:
        """Report a bug in the making of the document."""
        self._faults.note(
            "statistics", True, f"statistics: internal error {error!r}. Trying again."
        )

    def _end(self) -> None:
        if not self._is_ours:
            return
        if self._link is not None and self._link.is_symlink():
            with contextlib.suppress(OSError):
                self._link.unlink()
        with contextlib.suppress(OSError):
            self._path.unlink()
