"""A file that takes its name only when it is whole: written beside as ``NAME.part``, renamed at the end."""

import os
from contextlib import suppress
from pathlib import Path
from typing import IO

from kontronik_can_gw.errors import RunError


class PartFile:
    """Where a conversion goes: a file, or what is no plain file (a pipe, /dev/stdout), which is written to as it stands.

    ``path``: what to write. ``finish`` gives it its name; ``discard`` removes it. RunError where it cannot be opened.
    """

    def __init__(self, target: Path) -> None:
        self.target = target
        self._plain = not target.exists() or target.is_file()
        self.path = target.resolve().with_name(f"{target.name}.part") if self._plain else target
        self.file: IO[bytes] | None = None
        """As ``open`` gave it."""

    def open(self) -> IO[bytes]:
        """Open it for writing bytes."""
        try:
            self.file = self.path.open("wb")
        except OSError as error:
            raise RunError(
                f"{self.target}: cannot be written: {error.strerror}. Give another file."
            ) from None
        return self.file

    def finish(self) -> None:
        """Everything is written: close it and give it its name."""
        if self.file is not None:
            self.file.close()
        if self._plain:
            with self.path.open("rb") as file:
                os.fsync(file.fileno())
            self.path.replace(self.target.resolve())

    def discard(self) -> None:
        """It came to nothing: leave no trace."""
        if self.file is not None:
            with suppress(OSError):  # what is buffered found no room
                self.file.close()
        if self._plain:
            self.path.unlink(missing_ok=True)
