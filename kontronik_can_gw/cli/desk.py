"""Functions of several desk commands: recordings, layouts, progress and pseudo terminals."""

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TypeVar

from kontronik_can_gw.cli.common import announced_config, load_all, stopping_on_signals
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.pty import PtyEsc
from kontronik_can_gw.desk.recordings.inputs import Input, open_input
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc
from kontronik_can_gw.desk.recordings.stream import Stream
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.printable import printable

_Block = TypeVar("_Block", bound=Sized)


def given_layout(args: argparse.Namespace) -> BusLayout | None:
    """Return the layout of ``-c`` or ``--dbc``. None if neither is given.

    Raises UserError with all mistakes.
    """
    if args.config or args.dbc:
        return bus_layout(args)
    return None


def bus_layout(args: argparse.Namespace) -> BusLayout:
    """Return the layout of ``-c`` or ``--dbc``.

    Without these options, the layout of the default configuration is returned, and without a
    default configuration the shipped one. Raises UserError with all mistakes.
    """
    if args.config is None and args.dbc is None:
        args.config = announced_config()
    if args.config is None:
        return layout_of_dbc(args.dbc or shipped("dbc/kontronik_esc.dbc"))
    loaded = load_all(args.config)
    if loaded.database is None:
        raise UserError(
            f"{args.config}: dbc.enabled is false, so no messages of a DBC are sent. "
            "Give --dbc instead."
        )
    return BusLayout(
        loaded.database,
        loaded.layout,
        loaded.escs,
        loaded.config,
    )


OpenInput = Callable[[Path, BusLayout | None], Input]


@contextmanager
def reading(
    path: Path,
    layout: BusLayout | None,
    opened_by: OpenInput = open_input,
) -> Iterator[Input]:
    """Open a recording.

    SIGINT, SIGTERM and SIGHUP raise KeyboardInterrupt. If the recording is a stream they end it
    instead, so that its data so far can be used. ``was_ended`` is true afterwards.
    """
    stream: Stream | None = None

    def stop() -> None:
        if stream is None:
            raise KeyboardInterrupt
        stream.end()

    with stopping_on_signals(stop), opened_by(path, layout) as recording:
        stream = recording.stream
        yield recording


def was_ended(recording: Input) -> bool:
    """Return True if the recording is a stream that was ended by a signal."""
    return recording.stream is not None and recording.stream.is_ended


def watched(blocks: Iterable[_Block], name: str, data_on_screen: bool) -> Iterator[_Block]:
    """Yield the blocks, and show the number of their items on standard error.

    Nothing is shown if standard error is not a terminal. ``data_on_screen``: data is written to
    standard output, which may be the same terminal.
    """
    if not sys.stderr.isatty() or (data_on_screen and sys.stdout.isatty()):
        yield from blocks
        return
    from rich import console, progress

    columns: list[progress.ProgressColumn] = [progress.SpinnerColumn()]
    for text in ("{task.description}", "{task.completed:,}", "after", "{task.elapsed:.0f} s"):
        columns.append(progress.TextColumn(text, markup=False))
    screen = console.Console(stderr=True)
    with progress.Progress(*columns, console=screen, transient=True) as bar:
        task = bar.add_task(printable(name), total=None)
        for block in blocks:
            bar.advance(task, len(block))
            yield block


@contextmanager
def terminals(names: Sequence[str], link: str | None) -> Iterator[list[PtyEsc]]:
    """Open a pseudo terminal for each name, and print lines such as "esc1 /dev/pts/5".

    ``link`` is the path of a symbolic link to it. {n} in it is the number, from 1.
    """
    with ExitStack() as stack:
        opened = []
        for number in range(1, len(names) + 1):
            path = link and link.replace("{n}", str(number))
            opened.append(stack.enter_context(PtyEsc(path)))
        for name, terminal in zip(names, opened, strict=True):
            print(f"{name} {terminal.path}")
        sys.stdout.flush()
        yield opened
