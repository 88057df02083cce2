"""Functions for the threads that write files."""

import fcntl
import os
from pathlib import Path


def write_all(fd: int, data: bytes) -> None:
    """Write all the data, in as many steps as the system needs."""
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(fd, rest) :]


def write_new(path: Path, data: bytes, mode: int, is_synced: bool = False) -> None:
    """Write a new file with these permissions. An old file of that name is replaced.

    With ``is_synced``, the content is forced to the disk. Raises OSError if that fails.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
    try:
        fd = os.open(path, flags, mode)
    except FileExistsError:
        path.unlink()
        fd = os.open(path, flags, mode)
    try:
        os.fchmod(fd, mode)  # os.open applies the umask to the mode
        write_all(fd, data)
        if is_synced:
            os.fsync(fd)
    finally:
        os.close(fd)


def sync_folder(folder: Path) -> None:
    """Force the names in a folder to the disk.

    Raises OSError if that fails, for example if the file system does not support it.
    """
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def reason_of(error: Exception) -> str:
    """Return the reason of a failure as text for a log line."""
    if isinstance(error, OSError):
        return error.strerror or str(error)
    return repr(error)


def is_locked(path: Path) -> bool:
    """Return True if this or another process has locked the file with flock."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:  # the file was removed
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(fd)
    return False
