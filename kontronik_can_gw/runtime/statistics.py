"""The gateway's document of itself (snapshot.py), once a second, to a file that is replaced.

What may touch what: everything is called by the loop's thread; only ``_work``, ``_fail``, ``_write`` and ``_end`` run in the worker's. What
the newest document is made of goes from one to the other by a single assignment, so that neither a disk nor the making holds the loop up.
"""

import contextlib
import errno
import os
from pathlib import Path

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.runtime.disk import reason_of, write_new
from kontronik_can_gw.runtime.locks import Locks
from kontronik_can_gw.runtime.snapshot import STALE_NS, Moment, snapshot
from kontronik_can_gw.runtime.worker import Report, Worker

PERIOD_NS = SECOND
_CLOSE_S = 0.2


def default_file() -> Path | None:
    """Where the statistics go if the configuration does not say: into what systemd gives the service, else nowhere."""
    given = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    return Path(given) / "status.json" if given else None


class Statistics:
    """The thread that writes the file. ``due``: when the next document is wanted. RunError where another gateway writes it."""

    def __init__(self, file: Path) -> None:
        self.due = 0
        self._path, self._what = file, f"statistics file {file}"
        self._temporary = file.with_name(f".{file.name}.tmp")
        self._newest: Moment | None = None
        self._written: Moment | None = None
        """What the last document was made of; of the worker's thread."""
        self._is_ours = False
        """The file is what was written here."""
        self._locks = Locks()
        if self._locks.hold([f"{os.path.realpath(file)}/statistics/0"]):
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
            self._is_ours = True
            self._faults.note(name, False, f"{self._what}: is written again")

    def _fail(self, error: Exception) -> None:
        """A mistake of ours in here must not go unsaid."""
        self._faults.note("statistics", True, f"the statistics fail: {error!r}. Trying again.")

    def _end(self) -> None:
        if self._is_ours:
            with contextlib.suppress(OSError):
                self._path.unlink()
