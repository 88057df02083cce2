"""How far a long conversion is."""

import sys
from collections.abc import Iterable, Iterator, Sized
from typing import TypeVar

from kontronik_can_gw.printable import printable

_Block = TypeVar("_Block", bound=Sized)


def watched(blocks: Iterable[_Block], name: str, data_on_screen: bool) -> Iterator[_Block]:
    """The blocks, with the number of their items so far on standard error while they are taken; on no terminal nothing is shown.

    ``data_on_screen``: data is written to standard output, which may be the same terminal.
    """
    if not sys.stderr.isatty() or (data_on_screen and sys.stdout.isatty()):
        yield from blocks
        return
    from rich import console, progress

    columns = "{task.description}", "{task.completed:,}", "after", "{task.elapsed:.0f} s"
    shown = [progress.TextColumn(text, markup=False) for text in columns]
    screen = console.Console(stderr=True)
    with progress.Progress(progress.SpinnerColumn(), *shown, console=screen, transient=True) as bar:
        task = bar.add_task(printable(name), total=None)
        for block in blocks:
            bar.advance(task, len(block))
            yield block
