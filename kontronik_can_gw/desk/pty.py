"""Simulated ESCs on pseudo terminals, which a gateway opens like serial ports.

Nothing may ever be sent to a real ESC, because its line has an ASCII mode in which parameters can
be written. ``PtyEsc.received`` therefore counts every byte that a gateway sends, including echo.
"""

import os
import select
import termios
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.kontronik.simulator import SimulatedEsc
from kontronik_can_gw.times import SECOND


class PtyEsc:
    """The ESC's end of a pseudo terminal, as context manager.

    The gateway opens ``path``, or the symbolic link ``link``. An existing symbolic link at ``link``
    is replaced. Anything else there raises RunError. ``close`` removes the link.
    """

    def __init__(self, link: str | Path | None = None) -> None:
        self.dropped_bytes = 0
        """Bytes dropped because the terminal was full."""
        self.received = 0
        """Number of bytes from the gateway. It must stay 0."""
        self.first_received = b""
        """The first 64 bytes from the gateway."""
        self.frames = 0
        """Frames that ``run`` has sent."""
        self.intact = 0
        """Frames that ``run`` has sent completely and without flipped bits."""
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
        """Send without blocking. Returns True if the terminal accepted all bytes.

        The other bytes are dropped and counted in ``dropped_bytes``.
        """
        if not data:
            return True
        try:
            accepted = os.write(self._master, data)
        except BlockingIOError:
            accepted = 0
        self.dropped_bytes += len(data) - accepted
        return accepted == len(data)

    def check(self) -> int:
        """Read the bytes that the gateway has sent since the last call, and return their number.

        A number other than 0 is a fault of the gateway.
        """
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
        """Remove the link if it still leads to this terminal, and close the terminal.

        Another call does nothing.
        """
        if self._link is not None:
            if self._link.is_symlink() and str(self._link.readlink()) == self.path:
                self._link.unlink(missing_ok=True)
            self._link = None
        if self._master >= 0:
            os.close(self._slave)  # held open so that a gateway can open and close it repeatedly
            os.close(self._master)
            self._master = -1
            self._slave = -1

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
    """Send the frames of all ESCs in real time, in this thread.

    Ends when all frames that are due before ``seconds`` were sent, or when ``stop()`` returns True.
    It is called at least every 100 ms. The time of this call is time 0 of the simulations.
    ``on_received`` gets the index of an ESC that received bytes.
    """
    origin_ns = time.monotonic_ns()
    end_ns = None if seconds is None else round(seconds * SECOND)
    poller = select.poll()
    index_of = {}
    for index, (_, terminal) in enumerate(escs):
        index_of[terminal.fileno()] = index
        poller.register(terminal, select.POLLIN)
    is_last_round = False
    while not is_last_round:
        now_ns = time.monotonic_ns() - origin_ns
        if end_ns is not None and now_ns >= end_ns:
            now_ns = end_ns - 1
            is_last_round = True
        elif stop():
            is_last_round = True
        for esc, terminal in escs:
            if esc.next_ns <= now_ns:
                _send_frames(esc, terminal, now_ns)
        wait_ms = 0.0 if is_last_round else _wait_ms(escs, now_ns, end_ns)
        for fd, _ in poller.poll(wait_ms):
            index = index_of[fd]
            if escs[index][1].check():
                on_received(index)


def _wait_ms(
    escs: Sequence[tuple[SimulatedEsc, PtyEsc]],
    now_ns: int,
    end_ns: int | None,
) -> float:
    """Return the time until the next frame is due, at most 100 ms.

    It is at least 1 ms, so that frames due within it share a round. 64 ESCs then need no more
    rounds than 10.
    """
    dues = [esc.next_ns for esc, _ in escs]
    dues.append(now_ns + SECOND // 10)
    if end_ns is not None:
        dues.append(end_ns)
    return max((min(dues) - now_ns) / 1e6, 1)


def _send_frames(esc: SimulatedEsc, terminal: PtyEsc, now_ns: int) -> None:
    for sent in esc.frames_until(now_ns):
        terminal.frames += 1
        is_accepted = terminal.write(sent.wire)
        if is_accepted and sent.intact:
            terminal.intact += 1


def _set_raw(fd: int) -> None:
    """Switch off echo, line discipline and translation, so that bytes pass as on a UART."""
    mode = termios.tcgetattr(fd)
    mode[0] = 0
    mode[1] = 0
    mode[3] = 0
    mode[2] |= termios.CS8 | termios.CREAD | termios.CLOCAL
    termios.tcsetattr(fd, termios.TCSANOW, mode)


def _make_link(link: Path, target: str) -> Path:
    """Create the symbolic link and return its absolute path, because the directory may change."""
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
            f"{link}: the link cannot be created: {error.strerror}. Give another --link."
        ) from None
    return link
