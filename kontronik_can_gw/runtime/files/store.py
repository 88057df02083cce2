"""Reads the parameter files of all nodes at the start, and writes them in a thread.

All methods are called by the loop's thread, except ``_write_all`` and the functions that it calls,
which run in the worker's thread. Savings and results are handed over without waiting. So a full,
read-only or slow disk does not delay the loop.

A file is never changed, but replaced: write a temporary file in the same folder, fsync, rename,
fsync of the folder. This guarantees:

1. After a power loss at any instant, the file has either the old or the new content.
2. After a successful result of a saving, it has the new content.
3. After a failed saving, it has the old content, or the new one if only the last step failed.
"""

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.runtime.files.disk import open_regular, reason_of, sync_folder, write_new
from kontronik_can_gw.runtime.system.locks import Taken, lock_file
from kontronik_can_gw.runtime.system.worker import Handover, Worker

_Content = TypeVar("_Content")


class ParameterStore:
    """Keeps one file ``NAME.params`` for each node in one folder.

    The folder is created when it is first needed, with mode 0700. The files have mode 0600.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._worker: Worker[tuple[str, bytes]] = Worker("parameter-store", self._write_all)
        self._results: Handover[tuple[str, str | None]] = Handover()
        self._lock_files: list[int] = []

    def lock(self, name: str) -> str | None:
        """Lock a node's file against other gateways until ``close``.

        Raises RunError if another gateway uses it. Returns the reason if no lock can be created,
        in which case no parameters can be saved either.
        """
        path = parameter_file(self._folder, name)
        try:
            _make_folder(path.parent)
            self._lock_files.append(lock_file(path.with_suffix(".lock")))
        except Taken:
            raise RunError(
                f"{path}: is in use by another gateway. "
                "Give this gateway its own canopen.store, or rename its ESC."
            ) from None
        except OSError as error:
            return f"{path}: {reason_of(error)}"
        return None

    def load(
        self, name: str, decode: Callable[[bytes], _Content]
    ) -> tuple[_Content | None, str | None]:
        """Return the stored parameters of a node. Call it before the node's first saving.

        1. If the file is missing, the result is None twice.
        2. If it is damaged, because ``decode`` raises ValueError, the result is None and the
           reason. The file is kept as ``NAME.params.damaged``, which replaces an older file of
           that name.
        3. If it cannot be read, the result is None and the reason. The file stays until parameters
           are saved, because it may be readable again later.

        The unfinished file of a killed gateway is removed.
        """
        path = parameter_file(self._folder, name)
        with contextlib.suppress(OSError):
            _temporary(path).unlink()
        try:
            with os.fdopen(open_regular(path, os.O_RDONLY), "rb") as file:
                data = file.read()
            return decode(data), None
        except FileNotFoundError:
            return None, None
        except OSError as error:
            return None, f"{path}: {reason_of(error)}"
        except ValueError as error:
            with contextlib.suppress(OSError):
                path.replace(path.with_name(path.name + ".damaged"))
                sync_folder(path.parent)
            return None, f"{path}: {error}"

    def save(self, name: str, data: bytes) -> bool:
        """Replace the file's content by ``data``. Never blocks.

        1. Returns True if exactly one result follows. Results have the order of the savings.
        2. Returns False if the system provides no thread, or the store is closed. Then no result
           follows.
        """
        return self._worker.start() and self._worker.put((name, data))

    def fileno(self) -> int:
        """Return a descriptor that is readable while there are results. -1 after ``close``."""
        return self._results.fileno()

    def results(self) -> list[tuple[str, str | None]]:
        """Return the results since the last call: the node's name, and the reason of a failure.

        The reason is None if the content is on disk.
        """
        return self._results.take()

    def close(self, timeout: float) -> bool:
        """Accept no more savings, and wait at most ``timeout`` seconds for the queued ones.

        Returns False if some are not finished. ``results`` may be called once afterwards.
        """
        has_ended = self._worker.stop(timeout)
        self._results.close()
        for lock in self._lock_files:
            os.close(lock)
        self._lock_files = []
        return has_ended

    def _write_all(self, savings: list[tuple[str, bytes]]) -> None:
        for name, data in savings:
            try:
                problem = self._write(name, data)
            except Exception as error:  # a bug; each saving must have a result nevertheless
                problem = repr(error)
            self._results.put((name, problem))

    def _write(self, name: str, data: bytes) -> str | None:
        path = parameter_file(self._folder, name)
        temporary = _temporary(path)
        try:
            _make_folder(self._folder)
            write_new(temporary, data, 0o600)
            temporary.replace(path)
            sync_folder(self._folder)
        except OSError as error:
            with contextlib.suppress(OSError):
                temporary.unlink()
            return f"{path}: {reason_of(error)}"
        return None


def parameter_file(folder: Path, name: str) -> Path:
    """Return the path of a node's parameter file."""
    return folder / f"{name}.params"


def _temporary(path: Path) -> Path:
    return path.with_name(path.name + ".tmp")


def _make_folder(folder: Path) -> None:
    """Create the folder and its parents, and force the entry of each to the disk."""
    if folder.is_dir():
        return
    _make_folder(folder.parent)
    folder.mkdir(mode=0o700, exist_ok=True)
    sync_folder(folder.parent)
