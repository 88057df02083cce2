"""What the threads that write files have in common."""

import fcntl
import os
from pathlib import Path


def write_all(fd: int, data: bytes) -> None:
    """Write all of it, however little the system takes at a time."""
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(fd, rest) :]


def write_new(path: Path, data: bytes, mode: int, is_synced: bool = False) -> None:
    """Write a new file with these permissions, in place of a left-over one; ``is_synced``: its content is on disk then. Or OSError."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
    try:
        fd = os.open(path, flags, mode)
    except FileExistsError:
        path.unlink()
        fd = os.open(path, flags, mode)
    try:
        os.fchmod(fd, mode)  # whatever the umask
        write_all(fd, data)
        if is_synced:
            os.fsync(fd)
    finally:
        os.close(fd)


def sync_folder(folder: Path) -> None:
    """Force the names in a folder to the disk. OSError where that fails, as on a file system that cannot."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def reason_of(error: Exception) -> str:
    """Why it failed, for a log line."""
    return error.strerror or str(error) if isinstance(error, OSError) else repr(error)


def is_locked(path: Path) -> bool:
    """True for a file that somebody has locked (flock), here or in another process."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:  # it has gone
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(fd)
    return False
