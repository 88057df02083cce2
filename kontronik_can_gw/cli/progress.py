"""A progress bar on standard error with rate and remaining time."""

import sys
from typing import Self

from kontronik_can_gw.printable import printable


class Progress:
    """A progress bar on a terminal, otherwise nothing. ``size``: total bytes, None where unknown.

    ``data_on_screen``: data is written to standard output, so there is no bar if that is the same terminal.
    """

    def __init__(self, name: str, size: int | None, data_on_screen: bool = True) -> None:
        self._progress = None
        if not sys.stderr.isatty() or (data_on_screen and sys.stdout.isatty()):
            return
        from rich import console, progress

        self._progress = progress.Progress(
            progress.TextColumn("{task.description}", markup=False),
            progress.BarColumn(),
            progress.DownloadColumn(),
            progress.TransferSpeedColumn(),
            progress.TimeRemainingColumn(),
            console=console.Console(stderr=True),
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

    def advance(self, size: int) -> None:
        """Add ``size`` processed bytes."""
        if self._progress is not None:
            self._progress.advance(self._task, size)

    def reach(self, position: int) -> None:
        """Set the number of processed bytes."""
        if self._progress is not None:
            self._progress.update(self._task, completed=position)
