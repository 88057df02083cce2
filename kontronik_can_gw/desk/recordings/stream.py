"""Reads a recording from a pipe as its data arrive. A pipe can be read only once."""

import io
import os
import select
import stat
from collections.abc import Callable
from pathlib import Path

from kontronik_can_gw.errors import RunError, UserError

HEAD = 1 << 16
"""Bytes of a recording in which its format is looked for."""
_STANDARD_INPUT = ("-", "/dev/stdin", "/dev/fd/0", "/proc/self/fd/0")
_LAST_MS = 100
"""Time for which each read after ``end`` waits for data that are still on their way."""
_LAST_BYTES = 1 << 20
"""Number of bytes that are read after ``end``, at most."""


class Stream(io.RawIOBase):
    """The data of a pipe.

    1. A read returns the available data, at least one byte. It waits only if there are no data.
       b"" is the end.
    2. ``before_wait`` is called each time before a read waits.
    3. ``end`` may be called at any time, also by a signal handler. After it, reads return the rest
       of the data in the pipe, at most 1 MB, and then b"".
    """

    def __init__(self, fd: int, name: str) -> None:
        super().__init__()
        self.name = name
        self.head = b""
        """The beginning that ``look`` has read. Reads return it first."""
        self.before_wait: Callable[[], object] = lambda: None
        self.is_ended = False
        """True after ``end``."""
        self._fd = fd
        self._wake = os.eventfd(0)
        self._data = select.poll()
        self._data.register(fd, select.POLLIN)
        self._data_or_wake = select.poll()
        self._data_or_wake.register(fd, select.POLLIN)
        self._data_or_wake.register(self._wake, select.POLLIN)
        self._left = _LAST_BYTES

    def end(self) -> None:
        """End the stream after the data that are in the pipe."""
        self.is_ended = True
        os.eventfd_write(self._wake, 1)

    def look(self) -> bool:
        """Read more of the head without consuming it. Return False at the end of the stream."""
        more = self._receive(HEAD)
        self.head += more
        return bool(more)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer) -> int:  # type: ignore[no-untyped-def]
        data = self.head[: len(buffer)] or self._receive(len(buffer))
        self.head = self.head[len(data) :]
        buffer[: len(data)] = data
        return len(data)

    def close(self) -> None:
        if not self.closed:
            os.close(self._fd)
            os.close(self._wake)
        super().close()

    def _receive(self, size: int) -> bytes:
        try:
            while self._has_data():
                try:
                    data = os.read(self._fd, min(size, self._left))
                except BlockingIOError:
                    continue  # another reader of a non-blocking pipe was faster
                if self.is_ended:
                    self._left -= len(data)
                return data
        except OSError as error:
            raise RunError(f"{self.name}: cannot be read: {error.strerror}.") from None
        return b""

    def _has_data(self) -> bool:
        """Wait for data or the end of the pipe. Return False after ``end`` if no data are left."""
        if not self.is_ended and not self._data.poll(0):
            self.before_wait()
            while not self.is_ended and not self._data.poll(0):
                self._data_or_wake.poll()
        if not self.is_ended:
            return True
        return self._left > 0 and bool(self._data.poll(_LAST_MS))


class StreamReader(io.BufferedReader):
    """A buffered reader of a stream.

    If the stream was ended, ``readline`` leaves out an incomplete line.
    """

    def __init__(self, stream: Stream) -> None:
        super().__init__(stream, HEAD)
        self._stream = stream

    def readline(self, size: int | None = -1, /) -> bytes:
        line = super().readline(size)
        is_cut = self._stream.is_ended and len(line) != size and not line.endswith(b"\n")
        return b"" if is_cut else line


def open_stream(path: Path) -> Stream | None:
    """Open a pipe, or standard input if the path is ``-``.

    Returns None for files, folders and paths that do not exist. Raises UserError for devices, which
    are not opened, because a device may be the port of an ESC.
    """
    if is_standard_input(path):
        kind = stat.S_IFMT(os.fstat(0).st_mode)
        if kind in (stat.S_IFCHR, stat.S_IFBLK, stat.S_IFDIR):
            raise UserError(
                f"{name_of(path)}: is a terminal or another device. "
                "Send the data through a pipe: COMMAND | kontronik-can-gw …"
            )
        return Stream(os.dup(0), name_of(path))
    try:
        is_stream = path.exists() and not path.is_file() and not path.is_dir()
    except OSError as error:  # a folder of the path is not accessible, or the name is too long
        raise UserError(f"{path}: cannot be opened: {error.strerror}.") from None
    if not is_stream:
        return None
    if not path.is_fifo():
        raise UserError(
            f"{path}: is a device or socket. Give a file, a pipe, or - for standard input."
        )
    try:
        return Stream(os.open(path, os.O_RDONLY), str(path))
    except OSError as error:
        raise UserError(f"{path}: cannot be opened: {error.strerror}.") from None


def is_standard_input(path: Path) -> bool:
    """Return True for ``-`` and the device files of standard input."""
    return str(path) in _STANDARD_INPUT


def name_of(path: Path) -> str:
    """Return the path as messages show it."""
    return "standard input" if is_standard_input(path) else str(path)
