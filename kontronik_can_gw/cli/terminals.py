"""Pseudo terminals in the place of ESCs' serial ports, for ``simulate`` and ``replay``."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager

from kontronik_can_gw.desk.pty import PtyEsc


@contextmanager
def terminals(names: Sequence[str], link: str | None) -> Iterator[list[PtyEsc]]:
    """A pseudo terminal for each name, printed as "esc1 /dev/pts/5". ``link``: symbolic link, {n} is the number from 1."""
    with ExitStack() as stack:
        opened = []
        for number in range(1, len(names) + 1):
            path = link and link.replace("{n}", str(number))
            opened.append(stack.enter_context(PtyEsc(path)))
        for name, terminal in zip(names, opened, strict=True):
            print(f"{name} {terminal.path}")
        sys.stdout.flush()
        yield opened
