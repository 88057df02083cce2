"""The files of captures: one while it is written, and the oldest, which are removed."""

import contextlib
import errno
import fcntl
import os
import re
from pathlib import Path

from kontronik_can_gw.capture.format import SUFFIX, block, data_payload
from kontronik_can_gw.runtime.disk import is_locked, sync_folder, write_all

_OURS = re.compile(rf"[0-9]{{8}}T[0-9]{{6}}Z-[0-9a-f]{{6}}-[0-9]+{SUFFIX}")
Item = tuple[int, int, int, bytes, int, int | None]
"""(time, kind, ESC, data, flags, time of arrival), as of ``capture.Entry``."""


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
