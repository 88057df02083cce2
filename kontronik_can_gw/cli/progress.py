"""A progress bar on standard error with rate and remaining time."""

import sys
from typing import Self

from rich import console, progress

from kontronik_can_gw.printable import printable


class Progress:
    """A progress bar on a terminal, otherwise nothing. ``size``: total bytes, None where unknown.

    ``data_on_screen``: data is written to standard output, so there is no bar if that is the same terminal.
    """

    def __init__(self, name: str, size: int | None, data_on_screen: bool = True) -> None:
        is_shown = sys.stderr.isatty() and not (data_on_screen and sys.stdout.isatty())
        self._bar = progress.Progress(
            progress.TextColumn("{task.description}", markup=False),
            progress.BarColumn(),
            progress.DownloadColumn(),
            progress.TransferSpeedColumn(),
            progress.TimeRemainingColumn(),
            console=console.Console(stderr=True),
            transient=True,
            disable=not is_shown,
        )
        self._task = self._bar.add_task(printable(name), total=size)

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def advance(self, size: int) -> None:
        """Add ``size`` processed bytes."""
        self._bar.advance(self._task, size)

    def reach(self, position: int) -> None:
        """Set the number of processed bytes."""
        self._bar.update(self._task, completed=position)
