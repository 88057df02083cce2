"""Opens a serial port for a moment to check even parity and read its line error counts.

Nothing is written, and the settings of a port that another program may use are not changed (the caller knows). The settings used,
115200 baud with even parity and without echo, are those of the gateway and are kept: an echo would be sent to the ESC.
"""

import contextlib
import errno
import fcntl
import os
import struct
import termios
from collections.abc import Mapping
from dataclasses import dataclass, field

_GET_COUNTS, _COUNTS = 0x545D, struct.Struct("=20i")
_COUNTERS = {6: "framing", 8: "parity", 7: "overrun", 9: "break", 10: "buffer overrun"}
"""Indices in struct serial_icounter_struct."""
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
    counts: bool = False


def look(path: str, alone: bool) -> Line:
    """Open a port for a moment. ``alone``: no other program has it open; otherwise parity is tried only on an unconfigured port."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        return Line(error.strerror or str(error), busy=error.errno == errno.EBUSY)
    try:
        parity = _try_even_parity(fd, alone)
        errors = _line_errors(fd)
        return Line(even_parity=parity, errors=errors or {}, counts=errors is not None)
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


def _line_errors(fd: int) -> dict[str, int] | None:
    try:
        counts = _COUNTS.unpack(fcntl.ioctl(fd, _GET_COUNTS, bytes(_COUNTS.size)))
    except OSError:
        return None
    return {name: counts[place] for place, name in _COUNTERS.items() if counts[place]}
