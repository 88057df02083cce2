"""Opens a serial port for a moment to check even parity and read its line error counts.

Nothing is written, and the settings of a port that another program may use are not changed (the caller knows). The settings used,
115200 baud with even parity and without echo, are those of the gateway and are kept: an echo would be sent to the ESC.
"""

import contextlib
import errno
import os
import termios
from collections.abc import Mapping
from dataclasses import dataclass, field

from kontronik_can_gw.runtime.serial_port import line_errors

_STICKY_PARITY = 0o10000000000


@dataclass(frozen=True)
class Line:
    """Result of the check of a port. None: not known."""

    trouble: str | None = None
    """Why the port could not be opened."""
    busy: bool = False
    """True if it could not be opened because another program has it exclusively."""
    even_parity: bool | None = None
    errors: Mapping[str, int] = field(default_factory=dict)
    """Line errors since the driver was loaded, by kind; empty where it does not count."""


def look(path: str, alone: bool) -> Line:
    """Open a port for a moment. ``alone``: no other program has it open; otherwise parity is tried only on an unconfigured port."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        return Line(error.strerror or str(error), busy=error.errno == errno.EBUSY)
    try:
        return Line(even_parity=_try_even_parity(fd, alone), errors=line_errors(fd))
    except termios.error as error:
        return Line(f"is not a working serial port ({error.args[-1]})")
    finally:
        os.close(fd)


def _try_even_parity(fd: int, alone: bool) -> bool | None:
    """Set 115200 baud, 8E1, raw; True if the port accepted it. None: not tried."""
    mode = termios.tcgetattr(fd)
    if not alone and not mode[3] & termios.ICANON and not _is_ours(mode):
        return None  # another program has configured it
    mode[0] = 0
    mode[1] &= ~termios.OPOST
    mode[2] &= ~(termios.CSIZE | termios.CSTOPB | termios.PARODD | termios.CRTSCTS | _STICKY_PARITY)
    mode[2] |= termios.CS8 | termios.PARENB | termios.CREAD | termios.CLOCAL
    mode[3] = 0
    mode[4] = mode[5] = termios.B115200
    with contextlib.suppress(termios.error):  # the result is read back
        termios.tcsetattr(fd, termios.TCSANOW, mode)
    return _is_ours(termios.tcgetattr(fd))


def _is_ours(mode: list[object]) -> bool:
    flags, speed = mode[2], mode[4]
    assert isinstance(flags, int)
    asked = termios.CS8 | termios.PARENB
    seen = flags & (termios.CSIZE | termios.PARENB | termios.PARODD | termios.CSTOPB)
    return seen == asked and speed == termios.B115200
