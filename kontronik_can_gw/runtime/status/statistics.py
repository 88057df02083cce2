"""The gateway's document of itself (snapshot.py), once a second, to a file that is replaced.

What may touch what: everything is called by the loop's thread; only ``_work``, ``_fail``, ``_write`` and ``_end`` run in the worker's. What
the newest document is made of goes from one to the other by a single assignment, so that neither a disk nor the making holds the loop up.
"""

import contextlib
import errno
import logging
import os
import time
from pathlib import Path

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.runtime.files.disk import reason_of, write_new
from kontronik_can_gw.runtime.status.snapshot import STALE_NS, Moment, snapshot
from kontronik_can_gw.runtime.system.folders import STATUS_FILE, make_runtime_folder, status_name
from kontronik_can_gw.runtime.system.locks import Locks
from kontronik_can_gw.runtime.system.worker import Report, Worker
from kontronik_can_gw.times import SECOND

log = logging.getLogger("kontronik_can_gw")

PERIOD_NS = SECOND
_CLOSE_S = 0.2


def open_statistics(configured: Path | None, configuration: Path) -> "Statistics | None":
    """Start to publish the status of the gateway with this configuration.

    ``configured`` is the file of ``statistics.file``, or None. The status goes to that file, and can also be found
    in the runtime folder, in which ``kontronik-can-gw status`` looks for gateways. Without ``statistics.file`` a
    failure is logged and None is returned. RunError if another gateway writes the configured file.
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
        log.warning("`kontronik-can-gw status` cannot show this gateway: %s", problem)
    return None if configured is None else Statistics(configured, link=published)


def _published_file(configuration: Path) -> Path:
    """Return the file in the runtime folder for this gateway. OSError if there can be no such folder."""
    given = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    if given:  # by systemd, for the service alone
        return Path(given) / STATUS_FILE
    folder = make_runtime_folder("status")
    _remove_left_over(folder)
    return folder / status_name(configuration)


def _remove_left_over(folder: Path) -> None:
    """Remove the status files of gateways that were killed.

    A running gateway holds a lock on its file. It also has just written the file, which counts if the gateway runs
    in another network namespace, because locks hold only within one.
    """
    for path in folder.glob("*.json"):
        locks = Locks(report=lambda _: None)
        if not _is_recent(path) and not locks.hold([_lock_name(path)]):
            with contextlib.suppress(OSError):
                path.unlink()
        locks.close()


def _is_recent(path: Path) -> bool:
    """Return True if the file, or the file that a link leads to, was written a moment ago."""
    try:
        return abs(time.time_ns() - path.stat().st_mtime_ns) <= STALE_NS
    except OSError:
        return False


def _lock_name(file: Path) -> str:
    return f"{os.path.realpath(file)}/statistics/0"


class Statistics:
    """The thread that writes the file.

    ``due`` is the time of the next document. ``link`` is a symbolic link to the file, made along with it. RunError if
    another gateway writes the file.
    """

    def __init__(self, file: Path, link: Path | None = None) -> None:
        self.due = 0
        self._link = link
        self._path, self._what = file, f"statistics file {file}"
        self._temporary = file.with_name(f".{file.name}.tmp")
        self._newest: Moment | None = None
        self._written: Moment | None = None
        """What the last document was made of; of the worker's thread."""
        self._is_ours = False
        """The file is what was written here."""
        self._locks = Locks()
        if self._locks.hold([_lock_name(file)]):
            raise RunError(
                f"statistics.file {file}: another gateway writes it. Give this one its own."
            )
        self._worker: Worker[None] = Worker(
            "statistics", self._work, failed=self._fail, ended=self._end, capacity=1
        )
        self._faults = self._worker.faults
        if not self._worker.start():
            raise RunError("statistics: cannot be begun: no thread can be started")

    def publish(self, moment: Moment) -> None:
        """Let this be what the newest document is made of; never blocks."""
        self.due = moment.now + PERIOD_NS
        self._newest = moment
        self._worker.put(None)  # without room it is awake already

    def reports(self, now: int) -> list[Report]:
        """Take what went wrong, or is right again, since the last call."""
        return self._worker.reports(self._what, STALE_NS, now)

    def close(self) -> None:
        """Remove the file and end the thread; a disk that does not answer is waited for 0.2 s and no longer."""
        self._worker.stop(_CLOSE_S)
        self._locks.close()

    def _work(self, _items: list[None]) -> None:
        """Write the newest document."""
        moment, before = self._newest, self._written
        if moment is None or moment is before or self._worker.is_ending:
            return
        self._written = moment
        self._write(f"{snapshot(moment, before)}\n".encode("utf-8", "replace"))
        self._faults.note("statistics", False, "the statistics work again")

    def _write(self, data: bytes) -> None:
        """Replace the file: a reader sees the old content or the new one, whole. After a loss of power nobody wants it."""
        path, temporary, name = self._path, self._temporary, "statistics: file"
        try:
            if not os.path.isfile(path) and path.exists():  # noqa: PTH113  each second: as cheaply as it can be
                raise OSError(errno.EINVAL, "what is there is no plain file")  # as /dev/null
            write_new(temporary, data, 0o644)
            os.replace(temporary, path)  # noqa: PTH105
        except OSError as error:
            with contextlib.suppress(OSError):
                temporary.unlink()
            text = f"{self._what}: cannot be written: {reason_of(error)}. Trying again."
            self._faults.note(name, True, text)
        else:
            if self._link is not None and not (self._is_ours and self._link.is_symlink()):
                self._make_link(self._link)
            self._is_ours = True
            self._faults.note(name, False, f"{self._what}: is written again")

    def _make_link(self, link: Path) -> None:
        """Link to the file, in place of an earlier gateway's link. Only `status` uses it, so failure is no fault."""
        if os.path.realpath(link) == os.path.realpath(self._path):
            return  # also if statistics.file names the published file itself
        temporary = link.with_name(f".{link.name}.{os.getpid()}")
        with contextlib.suppress(OSError):
            temporary.symlink_to(self._path.absolute())
            temporary.replace(link)

    def _fail(self, error: Exception) -> None:
        """A mistake of ours in here must not go unsaid."""
        self._faults.note("statistics", True, f"the statistics fail: {error!r}. Trying again.")

    def _end(self) -> None:
        if not self._is_ours:
            return
        if self._link is not None and self._link.is_symlink():
            with contextlib.suppress(OSError):
                self._link.unlink()
        with contextlib.suppress(OSError):
            self._path.unlink()
