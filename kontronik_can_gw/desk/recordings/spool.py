"""What can be read only once (a pipe, standard input) as a file that can be read again.

It is kept in a temporary file that has no name, so nothing is left of it, however the program ends.
"""

import os
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path, PosixPath
from typing import IO

from kontronik_can_gw.errors import RunError, UserError

STREAM = "-"
_CHUNK = 1 << 16


class SpooledPath(PosixPath):
    """A path that is shown under another name. It keeps its file open: that exists no longer than this."""

    shown = ""
    kept: IO[bytes] | None = None

    def __str__(self) -> str:
        return self.shown or super().__str__()

    def __fspath__(self) -> str:
        return super().__str__()

    @property
    def name(self) -> str:
        return self.shown.rpartition("/")[2] or super().name


def is_stream(path: Path) -> bool:
    """True for ``-`` and for what is neither a file nor a folder."""
    if str(path) == STREAM:
        return True
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


def spooled(path: Path, reached: Callable[[int], None] | None = None) -> Path:
    """All that comes of a stream, as a file; ``reached`` is called with the bytes so far. UserError for a device, RunError."""
    shown = "standard input" if str(path) == STREAM else str(path)
    file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115  as long as its path
    count = 0
    try:
        source = _opened(path, shown)
        with open(source, "rb", buffering=0, closefd=source != 0) as stream:
            while data := stream.read(_CHUNK):
                _write(file, data)
                count += len(data)
                if reached is not None:
                    reached(count)
    except OSError as error:
        raise RunError(f"{shown}: cannot be read: {error.strerror}.") from None
    made = SpooledPath(f"/proc/self/fd/{file.fileno()}")
    made.shown, made.kept = shown, file
    return made


def _opened(path: Path, shown: str) -> int:
    """A file descriptor. A device is not opened: it might be the port of an ESC."""
    is_input = str(path) == STREAM
    about = os.fstat(0) if is_input else path.stat()
    kinds = (stat.S_ISFIFO, stat.S_ISREG, stat.S_ISSOCK)
    is_pipe = any(is_kind(about.st_mode) for is_kind in kinds)
    if not is_pipe and about.st_rdev != Path(os.devnull).stat().st_rdev:
        raise UserError(
            f"{shown}: is a terminal or another device. Give a file, or a pipe that brings a recording."
        )
    return 0 if is_input else os.open(path, os.O_RDONLY | os.O_CLOEXEC)


def _write(file: IO[bytes], data: bytes) -> None:
    try:
        while data:
            data = data[file.write(data) :]
    except OSError as error:
        raise RunError(
            f"{tempfile.gettempdir()}: cannot be written: {error.strerror}. What a pipe brings is kept there; TMPDIR names another folder."
        ) from None
