"""What can be read only once (a pipe, standard input) as a file that can be read again.

It is kept in a temporary file that has no name, so nothing is left of it, however the program ends.
"""

import os
import shutil
import stat
import tempfile
from pathlib import Path, PosixPath
from typing import IO

from kontronik_can_gw.errors import RunError, UserError

STREAM = "-"


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


def spooled(path: Path) -> Path:
    """All that comes of ``-`` or of a pipe, as a file; any other path as it is. UserError for a device, RunError."""
    is_input = str(path) == STREAM
    shown = "standard input" if is_input else str(path)
    try:
        about = os.fstat(0) if is_input else path.stat()
    except (OSError, ValueError):
        return path
    kind = stat.S_IFMT(about.st_mode)
    if not is_input and kind in (stat.S_IFREG, stat.S_IFDIR):
        return path
    is_pipe = kind in (stat.S_IFIFO, stat.S_IFREG, stat.S_IFSOCK)
    if not is_pipe and about.st_rdev != Path(os.devnull).stat().st_rdev:
        # it is not opened: it might be the port of an ESC
        raise UserError(
            f"{shown}: is a terminal or another device. Give a file, or a pipe that brings a recording."
        )
    file = tempfile.TemporaryFile()  # noqa: SIM115  as long as its path
    try:
        with open(0 if is_input else path, "rb", closefd=not is_input) as stream:
            shutil.copyfileobj(stream, file)
        file.flush()
    except OSError as error:
        raise RunError(
            f"{shown}: cannot be read into {tempfile.gettempdir()} (TMPDIR): {error.strerror}."
        ) from None
    made = SpooledPath(f"/proc/self/fd/{file.fileno()}")
    made.shown, made.kept = shown, file
    return made
