"""Functions for the threads that write files."""

import errno
import fcntl
import os
import stat
from pathlib import Path

_OTHER_FILES = (errno.ELOOP, errno.ENXIO, errno.EISDIR)
"""Errors of open for a symbolic link, a FIFO without a reader or a socket, and a folder."""


def open_regular(path: Path, flags: int, mode: int = 0o600) -> int:
    """Open a regular file, and return its descriptor. Never waits and never follows a link.

    Every file that the gateway writes, and that another user could replace, is opened by this
    function. Raises OSError if it is not a regular file. Intermediate folders may be links.
    """
    flags |= os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
    try:
        fd = os.open(path, flags, mode)
    except OSError as error:
        if error.errno in _OTHER_FILES:
            raise _not_regular(error.errno) from None
        raise
    if stat.S_ISREG(os.fstat(fd).st_mode):
        return fd
    os.close(fd)
    raise _not_regular(errno.EINVAL)


def _not_regular(number: int) -> OSError:
    return OSError(number, "it is not a regular file")


def write_all(fd: int, data: bytes) -> None:
    """Write all the data, in as many steps as the system needs."""
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(fd, rest) :]


def write_new(path: Path, data: bytes, mode: int) -> None:
    """Write a new file with these permissions. An old file of that name is replaced.

    The content is forced to the disk. Raises OSError if that fails.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
    try:
        fd = open_regular(path, flags, mode)
    except FileExistsError:
        path.unlink()
        fd = open_regular(path, flags, mode)
    try:
        os.fchmod(fd, mode)  # os.open applies the umask to the mode
        write_all(fd, data)
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
        fd = open_regular(path, os.O_RDONLY)
    except OSError:  # the file was removed, or it is not a file of a gateway
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(fd)
    return False
