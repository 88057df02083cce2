"""The folder of captures: which files are captures, the oldest are removed."""

import contextlib
import fcntl
import os
import re
from pathlib import Path

from kontronik_can_gw.capture.format import SUFFIX

_OURS = re.compile(rf"[0-9]{{8}}T[0-9]{{6}}Z-[0-9a-f]{{6}}-[0-9]+({SUFFIX}|\.(log|asc|blf|trc))")
"""Names of captures, and of logs of CAN frames beside them, which 0.5.0 wrote."""


def is_ours(name: str) -> bool:
    """True for the name of a capture, or of a log beside one."""
    return _OURS.fullmatch(name) is not None


def remove_oldest(folder: Path, keep_bytes: int) -> None:
    """Keep the folder below a size, 0: any; what is being written, by any process, stays."""
    if not keep_bytes:
        return
    found: list[tuple[int, str, int, Path]] = []
    for path in folder.iterdir():
        with contextlib.suppress(FileNotFoundError):  # another gateway has removed it
            if is_ours(path.name) and not path.is_symlink() and path.is_file():
                status = path.stat()
                found.append((status.st_mtime_ns, path.name, status.st_size, path))
    total = sum(size for _, _, size, _ in found)
    for _, _, size, path in sorted(found):
        if total <= keep_bytes:
            return
        if not _is_being_written(path):
            with contextlib.suppress(OSError):
                path.unlink()
                total -= size


def make_folder(folder: Path) -> None:
    folder.mkdir(mode=0o750, parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError(1, "may not be written to")


def _is_being_written(path: Path) -> bool:
    """True for a capture that a recorder has open, here or in another process, and for the log beside it."""
    try:
        fd = os.open(path.with_suffix(SUFFIX), os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:  # a log whose capture has gone
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(fd)
    return False
