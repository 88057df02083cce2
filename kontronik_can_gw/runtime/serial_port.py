"""A serial port that is only ever read: 115200 baud, 8 data bits, even parity, 1 stop bit, exclusive.

Nothing is written to it, ever: an answer could switch an ESC into a mode in which its parameters can be changed. This class has no
way to write, and the line's echo is switched off before anything else.
"""

import contextlib
import errno
import fcntl
import grp
import os
import struct
import termios
from pathlib import Path

import serial

from kontronik_can_gw.errors import RunError

BAUD_RATE = 115_200
READ_SIZE = 4096

_TIOCGICOUNT = 0x545D
_COUNTS = struct.Struct("=20i")
_FRAME_ERRORS, _PARITY_ERRORS, _BUFFER_OVERRUNS = 6, 8, 10
"""In struct serial_icounter_struct; 7 are overruns."""


class PortLost(Exception):
    """The port was unplugged or hung up."""


class SerialPort:
    """An open port. RunError with one clear line where it cannot be opened."""

    def __init__(self, path: str) -> None:
        self.path = path
        is_pty = os.path.realpath(path).startswith("/dev/pts/")
        # one that does not lock it, as a getty, could write to it; its terminal is not touched
        if Path("/sys/class/tty", Path(os.path.realpath(path)).name).exists() and (users := _users(path)):
            raise _in_use(path, users)
        quiet = _open_quietly(path)
        try:
            self._serial = _open(path, serial.PARITY_EVEN, is_pty)
        finally:
            os.close(quiet)
        self._fd = self._serial.fileno()
        if not is_pty:
            with contextlib.suppress(OSError):
                fcntl.ioctl(self._fd, termios.TIOCEXCL)
            with contextlib.suppress(OSError, ValueError, NotImplementedError):
                self._serial.set_low_latency_mode(True)

    def fileno(self) -> int:
        return self._fd

    def read(self) -> bytes:
        """What has come; call it only when the port is readable. PortLost when the port has gone."""
        try:
            data = os.read(self._fd, READ_SIZE)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise PortLost(error.strerror or str(error)) from None
        if not data:
            raise PortLost("hung up")
        return data

    def line_errors(self) -> int:
        """Parity, framing and overrun errors that the driver has counted; 0 where it counts none (pseudo terminals, some adapters)."""
        try:
            counts = _COUNTS.unpack(fcntl.ioctl(self._fd, _TIOCGICOUNT, bytes(_COUNTS.size)))
        except OSError:
            return 0
        return int(sum(counts[_FRAME_ERRORS : _PARITY_ERRORS + 1]) + counts[_BUFFER_OVERRUNS])

    def discard(self) -> None:
        """Throw away what waits to be read."""
        with contextlib.suppress(OSError, termios.error):
            termios.tcflush(self._fd, termios.TCIFLUSH)

    def close(self) -> None:
        with contextlib.suppress(OSError, termios.error):
            self._serial.close()


def _in_use(path: str, users: str) -> RunError:
    who = f": {users}" if users else " (another gateway? a getty?)"
    name = Path(path).name
    return RunError(
        f"{path}: is in use by another program{who}. End it; if it is a getty: sudo systemctl disable --now serial-getty@{name}."
    )


def device_of(path: str) -> int | None:
    """The device number behind a path (slcan's ``path@baud`` too); None where there is none."""
    try:
        status = Path(path.partition("@")[0]).stat()
    except (OSError, ValueError):
        return None
    return status.st_rdev or None


def _open_quietly(path: str) -> int:
    """Open and switch echo off in one breath: a terminal that was just made echoes what it receives."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise _explained(path, error.errno, str(error.strerror)) from None
    try:
        mode = termios.tcgetattr(fd)
        mode[0] &= ~(termios.IXON | termios.IXOFF | termios.IXANY)
        mode[1] &= ~termios.OPOST
        mode[3] &= ~(termios.ECHO | termios.ECHONL | termios.ICANON | termios.ISIG)
        with contextlib.suppress(termios.error):  # pseudo terminals may refuse their own settings
            termios.tcsetattr(fd, termios.TCSANOW, mode)
        termios.tcflush(fd, termios.TCOFLUSH)
    except termios.error:
        os.close(fd)
        raise RunError(f"{path}: is not a serial port. Name the adapter's: see `ls /dev/serial/by-id`.") from None
    return fd


def _open(path: str, parity: str, is_pty: bool) -> serial.Serial:
    try:
        return serial.Serial(path, BAUD_RATE, parity=parity, timeout=0, exclusive=True)
    except (OSError, termios.error, ValueError) as error:  # SerialException is an OSError; termios.error is not
        number = error.args[0] if error.args and isinstance(error.args[0], int) else getattr(error, "errno", None)
        if number == errno.EINVAL and parity == serial.PARITY_EVEN:
            if is_pty:  # a pseudo terminal has no parity and may say so
                return _open(path, serial.PARITY_NONE, is_pty)
            raise RunError(
                f"{path}: cannot do 115200 baud with even parity. A Raspberry Pi's mini-UART (ttyS0) cannot: use ttyAMA0."
            ) from None
        raise _explained(path, number, str(error)) from None


def _explained(path: str, number: int | None, text: str) -> RunError:
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        ports = sorted(str(p) for p in Path("/dev/serial/by-id").glob("*"))
        there = (
            f"Ports there are: {', '.join(ports)}."
            if ports
            else "Is the adapter plugged in? See `ls /dev/serial/by-id`."
        )
        return RunError(f"{path}: no such serial port. {there}")
    if number == errno.EACCES:
        group, shared = "dialout", True
        with contextlib.suppress(OSError, KeyError):
            status = Path(path).stat()
            shared = status.st_mode & 0o060 == 0o060
            group = grp.getgrgid(status.st_gid).gr_name
        if not shared:  # to join the group would not help
            return RunError(f"{path}: permission denied, to its group {group} too: sudo chmod g+rw {path}.")
        return RunError(
            f"{path}: permission denied. Join its group: sudo usermod -aG {group} $USER, then log in again."
        )
    if number in (errno.EAGAIN, errno.EBUSY):
        return _in_use(path, _users(path))
    return RunError(f"{path}: cannot be opened: {text}")


def _users(path: str) -> str:
    """Who else has the port open, as far as we may see."""
    device, found = device_of(path), set()
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        with contextlib.suppress(OSError):
            if link.stat().st_rdev == device and (pid := link.parts[2]) != str(os.getpid()):
                found.add(f"{Path('/proc', pid, 'comm').read_text().strip()} (pid {pid})")
    return ", ".join(sorted(found))
