"""A bar on standard error that tells how far a long work is: rate and time left."""

import sys
from typing import Self

from kontronik_can_gw.printable import printable


class Progress:
    """A bar, where a person looks on; else nothing. ``size``: bytes in all, None where nobody knows.

    ``data_on_screen``: the data itself goes to standard output, so that a bar on the same screen would be in its way.
    """

    def __init__(self, name: str, size: int | None, data_on_screen: bool = True) -> None:
        self._progress = None
        if not sys.stderr.isatty() or (data_on_screen and sys.stdout.isatty()):
            return
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            DownloadColumn,
            Progress,
            TextColumn,
            TimeRemainingColumn,
            TransferSpeedColumn,
        )

        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            DownloadColumn(),
            TransferSpeedColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            transient=True,
        )
        self._task = self._progress.add_task(printable(name), total=size)

    def __enter__(self) -> Self:
        if self._progress is not None:
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._progress is not None:
            self._progress.stop()

    @property
    def is_shown(self) -> bool:
        """True where a bar is on the screen."""
        return self._progress is not None

    def advance(self, size: int) -> None:
        """So many bytes more are done."""
        if self._progress is not None:
            self._progress.advance(self._task, size)

    def reach(self, position: int) -> None:
        """So many bytes are done in all."""
        if self._progress is not None:
            self._progress.update(self._task, completed=position)
