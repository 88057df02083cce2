"""Simulated ESCs on pseudo terminals, which a gateway opens like serial ports.

A real ESC must never be sent a byte (its line has an ASCII mode in which parameters can be written). So everything that a gateway sends,
echo included, is counted in ``PtyEsc.received``.
"""

import os
import select
import termios
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.kontronik.simulator import SECOND_NS, SimulatedEsc


class PtyEsc:
    """The ESC's end of a pseudo terminal, as context manager. The gateway opens ``path``, or the symbolic link ``link``.

    An existing symbolic link at ``link`` is replaced, anything else there is a RunError. The link is removed at close.
    """

    def __init__(self, link: str | Path | None = None) -> None:
        self.dropped_bytes = 0
        """Bytes dropped because nobody read and the terminal was full."""
        self.received = 0
        """Number of bytes from the gateway. Must stay 0."""
        self.first_received = b""
        """The first of them, at most 64."""
        self.frames = self.intact = 0
        """Frames of ``run``, and those that were accepted and are not damaged."""
        self._link: Path | None = None
        try:
            self._master, self._slave = os.openpty()
        except OSError as error:
            raise RunError(
                f"no pseudo terminal available: {error.strerror}. Use fewer ESCs."
            ) from None
        try:
            _set_raw(self._slave)
            os.set_blocking(self._master, False)
            self.path = os.ttyname(self._slave)
            if link is not None:
                self._link = _make_link(Path(link), self.path)
        except BaseException:
            self.close()
            raise

    def fileno(self) -> int:
        """File descriptor of the ESC's end, to poll for bytes from the gateway."""
        return self._master

    def write(self, data: bytes) -> bool:
        """Send without blocking. If not everything was accepted, count the rest in ``dropped_bytes`` and return False."""
        if not data:
            return True
        try:
            taken = os.write(self._master, data)
        except BlockingIOError:
            taken = 0
        self.dropped_bytes += len(data) - taken
        return taken == len(data)

    def check(self) -> int:
        """Read what the gateway sent since the last call; return the number of bytes. Other than 0 is a fault of the gateway."""
        total = 0
        try:
            while data := os.read(self._master, 4096):
                self.first_received = (self.first_received + data)[:64]
                total += len(data)
        except BlockingIOError:
            pass
        self.received += total
        return total

    def close(self) -> None:
        """Remove the link if it is still ours, close the terminal. May be called again."""
        if self._link is not None:
            if self._link.is_symlink() and str(self._link.readlink()) == self.path:
                self._link.unlink(missing_ok=True)
            self._link = None
        if self._master >= 0:
            os.close(self._slave)  # open until now, so that readers can come and go
            os.close(self._master)
            self._master = self._slave = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def run(
    escs: Sequence[tuple[SimulatedEsc, PtyEsc]],
    *,
    seconds: float | None = None,
    stop: Callable[[], bool] = lambda: False,
    on_received: Callable[[int], None] = lambda _: None,
) -> None:
    """Send in real time, all ESCs in this one thread.

    Ends when all frames due before ``seconds`` were sent, or ``stop()`` is true (asked at least each 100 ms). The simulations'
    time 0 is the call's time. ``on_received`` gets the index of an ESC that received bytes.
    """
    origin_ns = time.monotonic_ns()
    end_ns = None if seconds is None else round(seconds * SECOND_NS)
    poller = select.poll()
    index_of = {}
    for index, (_, terminal) in enumerate(escs):
        index_of[terminal.fileno()] = index
        poller.register(terminal, select.POLLIN)
    over = False
    while not over:
        now_ns = time.monotonic_ns() - origin_ns
        if end_ns is not None and now_ns >= end_ns:
            now_ns, over = end_ns - 1, True
        over = over or stop()
        for esc, terminal in escs:
            for sent in esc.frames_until(now_ns) if esc.next_ns <= now_ns else ():
                terminal.frames += 1
                terminal.intact += terminal.write(sent.wire) and sent.intact
        # At least 1 ms, so that frames due within it share a round: 64 ESCs cost no more rounds than 10.
        due_ns = min((esc.next_ns for esc, _ in escs), default=now_ns + SECOND_NS)
        until_ns = min(due_ns, now_ns + SECOND_NS // 10)
        if end_ns is not None:
            until_ns = min(until_ns, end_ns)
        for fd, _ in poller.poll(0 if over else max((until_ns - now_ns) / 1e6, 1)):
            if escs[index_of[fd]][1].check():
                on_received(index_of[fd])


def _set_raw(fd: int) -> None:
    """No echo, no line discipline, no translation: bytes pass as on a UART."""
    mode = termios.tcgetattr(fd)
    mode[0] = mode[1] = mode[3] = 0
    mode[2] |= termios.CS8 | termios.CREAD | termios.CLOCAL
    termios.tcsetattr(fd, termios.TCSANOW, mode)


def _make_link(link: Path, target: str) -> Path:
    """Put the symbolic link in place; return it as an absolute path, since the directory may change later."""
    link = link.absolute()
    try:
        if not link.is_symlink() and link.exists():
            raise RunError(
                f"{link}: exists and is not a symbolic link. Remove it or give another --link."
            )
        link.unlink(missing_ok=True)
        link.symlink_to(target)
    except OSError as error:
        raise RunError(
            f"{link}: no link can be made: {error.strerror}. Give another --link."
        ) from None
    return link
