"""The parameter files of all nodes in one folder: read at start, written by a thread of its own.

What may touch what: everything is called by the loop's thread; only ``_write_all`` and what it calls run in the worker's. Savings and
results are handed over without waiting, so no disk, be it full, read-only or slow, holds the loop up.

A file is replaced, never changed: temporary file in the same folder, write, fsync, rename, fsync of the folder. After a loss of power at
any instant the old content is there or the new one; once a saving is reported as on disk, it is the new one. After a failed saving it is
the old one (the new one, if only the last step failed).
"""

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.runtime.files.disk import reason_of, sync_folder, write_new
from kontronik_can_gw.runtime.system.locks import Taken, lock_file
from kontronik_can_gw.runtime.system.worker import Handover, Worker

_Content = TypeVar("_Content")


class ParameterStore:
    """One file ``NAME.params`` for each node in one folder (mode 0700, made when it is first needed), readable by the owner only (0600)."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._worker: Worker[tuple[str, bytes]] = Worker("parameter-store", self._write_all)
        self._results: Handover[tuple[str, str | None]] = Handover()
        self._lock_files: list[int] = []

    def lock(self, name: str) -> str | None:
        """Keep other gateways from a node's file until ``close``: RunError where one has it.

        Where no lock can be made nothing can be saved either: returns the reason.
        """
        path = parameter_file(self._folder, name)
        try:
            _make_folder(path.parent)
            self._lock_files.append(lock_file(path.with_suffix(".lock")))
        except Taken:
            raise RunError(
                f"{path}: is in use by another gateway. Give this one its own canopen.store, or its ESC another name."
            ) from None
        except OSError as error:
            return f"{path}: {reason_of(error)}"
        return None

    def load(
        self, name: str, decode: Callable[[bytes], _Content]
    ) -> tuple[_Content | None, str | None]:
        """Read the parameters of a node. Must be called before the first ``save`` for it.

        Returns the content, and the reason if it cannot be read. Both are None if there is no file.
        A damaged file, for which ``decode`` raises ValueError, is renamed to
        ``NAME.params.damaged`` and replaces an older one of that name. A file that cannot be read
        now stays until parameters are saved. A file that a killed writer left is removed.
        """
        path = parameter_file(self._folder, name)
        with contextlib.suppress(OSError):
            _temporary(path).unlink()
        try:
            return decode(path.read_bytes()), None
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
        """Let ``data`` become the file's content; never blocks. True: exactly one result follows; results come in the order of the savings.

        False: the system gives no thread, or the store is closed; no result follows.
        """
        return self._worker.start() and self._worker.put((name, data))

    def fileno(self) -> int:
        """Give a descriptor that is readable while results wait; -1 after ``close``."""
        return self._results.fileno()

    def results(self) -> list[tuple[str, str | None]]:
        """Take the results since the last call: the name, and None if the content is on disk, else the reason."""
        return self._results.take()

    def close(self, timeout: float) -> bool:
        """Take no more, and wait for what is queued, at most ``timeout`` seconds. False: that was not enough.

        ``results`` may be called once more after it.
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
            except Exception as error:  # a mistake of ours: the saving has its result all the same
                problem = repr(error)
            self._results.put((name, problem))

    def _write(self, name: str, data: bytes) -> str | None:
        path = parameter_file(self._folder, name)
        temporary = _temporary(path)
        try:
            _make_folder(self._folder)
            write_new(temporary, data, 0o600, is_synced=True)
            temporary.replace(path)
            sync_folder(self._folder)
        except OSError as error:
            with contextlib.suppress(OSError):
                temporary.unlink()
            return f"{path}: {reason_of(error)}"
        return None


def parameter_file(folder: Path, name: str) -> Path:
    """Where the parameters of a node are."""
    return folder / f"{name}.params"


def _temporary(path: Path) -> Path:
    return path.with_name(path.name + ".tmp")


def _make_folder(folder: Path) -> None:
    """Make the folder with those above it, and put each one's entry on disk."""
    if folder.is_dir():
        return
    _make_folder(folder.parent)
    folder.mkdir(mode=0o700, exist_ok=True)
    sync_folder(folder.parent)
