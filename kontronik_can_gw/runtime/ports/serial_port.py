"""Reads a serial port exclusively, with the line settings of the ESC's protocol.

Nothing is ever written to the port, because an answer could switch an ESC into a mode in which its
parameters can be changed. Therefore SerialPort has no method that writes, and the echo of the line
is switched off before anything else.
"""

import contextlib
import errno
import fcntl
import grp
import os
import select
import struct
import termios
import time
from collections.abc import Mapping
from pathlib import Path

import serial

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.decoder import EscProtocol
from kontronik_can_gw.runtime.ports.usb_adapters import UsbIdentity, identity_at

READ_SIZE = 4096

_TIOCGICOUNT = 0x545D
MINI_UART = "brcm,bcm2835-aux-uart"
"""Name of a Raspberry Pi's second UART in the device tree.

This UART has no parity, but its driver does not report an error if parity is requested.
"""

_TERMIOS_SIZE = 64
"""Bytes that suffice for the kernel's struct termios on every machine."""
_COUNTS = struct.Struct("=20i")
_WAITING = struct.Struct("=i")
_LINE_ERRORS = {
    "framing": 6,
    "overrun": 7,
    "parity": 8,
    "break": 9,
    "buffer_overrun": 10,
}
"""Positions of the counters in struct serial_icounter_struct (linux/serial.h)."""


_NO_PARITY = "For a Raspberry Pi's mini-UART (ttyS0), which has none, use ttyAMA0 instead."


class PortLost(Exception):
    """The port was unplugged or hung up."""


class NoPort(RunError):
    """Raised if the port does not exist."""


class SerialPort:
    """An open port. Raises RunError with the remedy if the port cannot be opened."""

    def __init__(self, path: str, protocol: EscProtocol) -> None:
        self.path = path
        self._real_path = os.path.realpath(path)
        is_pty = self._real_path.startswith("/dev/pts/")
        # A program that does not lock the port, for example a getty, could write to it. The
        # settings of a terminal that is in use are not changed.
        if Path("/sys/class/tty", Path(self._real_path).name).exists():
            users = _users_now_and_then(path)
            if users:
                raise _in_use(path, users)
        quiet = _open_quietly(path)
        try:
            self._serial = _open(path, protocol, is_pty)
        finally:
            os.close(quiet)
        self._fd = self._serial.fileno()
        self._real_path = os.path.realpath(path)
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)
        self.is_drained = True
        """True if the last ``read`` left no bytes in the kernel."""
        try:
            mode = termios.tcgetattr(self._fd)
            # With VMIN = 0 an empty port could not be distinguished from one that hung up.
            mode[6][termios.VMIN] = 1
            with contextlib.suppress(termios.error):
                termios.tcsetattr(self._fd, termios.TCSANOW, mode)
            self._mode = termios.tcgetattr(self._fd)
            self.settings = self._settings_now()
        except (OSError, termios.error) as error:  # unplugged since it was opened
            self._serial.close()
            raise _explained(path, error.args[0], str(error)) from None
        self._line_errors = line_errors(self._fd)
        if not is_pty:
            with contextlib.suppress(OSError):
                fcntl.ioctl(self._fd, termios.TIOCEXCL)
            with contextlib.suppress(OSError, ValueError, NotImplementedError):
                self._serial.set_low_latency_mode(True)

    def fileno(self) -> int:
        return self._fd

    def read(self) -> bytes:
        """Return the received bytes, at most READ_SIZE. Raises PortLost if the port was lost.

        After a short read there may be more bytes, because the kernel passes on its further
        buffers only when it is asked again. ``poll`` asks it at a third of the cost of a read
        that finds nothing.
        """
        try:
            data = os.read(self._fd, READ_SIZE)
        except BlockingIOError:
            self.is_drained = True
            return b""
        except OSError as error:
            raise PortLost(error.strerror or str(error)) from None
        if not data:
            raise PortLost("unplugged")
        self.is_drained = not self._poll.poll(0)
        return data

    def settings_hold(self) -> bool:
        """Return True if the settings are unchanged. Otherwise restore them and return False.

        Another program, for example stty, can change them at any time.
        """
        try:
            if self._settings_now() == self.settings:
                return True
            termios.tcsetattr(self._fd, termios.TCSANOW, self._mode)
        except (OSError, termios.error):
            return True  # the port was lost, which the next read will report
        return False

    def _settings_now(self) -> bytes:
        """Return the kernel's struct termios. It takes a tenth of the time of termios.tcgetattr."""
        return fcntl.ioctl(self._fd, termios.TCGETS, bytes(_TERMIOS_SIZE))

    def line_errors(self) -> Mapping[str, int]:
        """Return the driver's counts of line errors by kind.

        Empty if the driver counts none, as for pseudo terminals and some adapters. Returns the
        same object as before if no count has changed.
        """
        if self._line_errors:
            found = line_errors(self._fd)
            if found != self._line_errors:
                self._line_errors = found
        return self._line_errors

    @property
    def waits_to_be_read(self) -> bool:
        """True if ``read`` would find bytes."""
        try:
            answer = fcntl.ioctl(self._fd, termios.FIONREAD, bytes(_WAITING.size))
        except OSError:
            return False
        (count,) = _WAITING.unpack(answer)
        return bool(count)

    def identity(self) -> UsbIdentity | None:
        """Return the identity of the port's USB adapter, or None for another kind of port."""
        return identity_at(self._real_path)

    def discard(self) -> None:
        """Discard the bytes that have not been read yet."""
        with contextlib.suppress(OSError, termios.error):
            termios.tcflush(self._fd, termios.TCIFLUSH)

    def close(self) -> None:
        with contextlib.suppress(OSError, termios.error):
            self._serial.close()


def line_errors(fd: int) -> dict[str, int]:
    """Return the line errors of an open port since its driver was loaded, by kind.

    Empty if the driver counts none.
    """
    try:
        answer = fcntl.ioctl(fd, _TIOCGICOUNT, bytes(_COUNTS.size))
    except OSError:
        return {}
    counts = _COUNTS.unpack(answer)
    return {kind: counts[place] for kind, place in _LINE_ERRORS.items()}


def is_mini_uart(path: str, root: Path = Path("/")) -> bool:
    """Return True for a Raspberry Pi's mini-UART, which does not support even parity."""
    device = root / "sys/class/tty" / Path(os.path.realpath(path)).name / "device"
    with contextlib.suppress(OSError):
        for folder in [device.resolve(), *device.resolve().parents][:4]:
            names = folder / "of_node" / "compatible"
            if names.is_file() and MINI_UART in names.read_text(errors="replace").split("\0"):
                return True
    return False


def _in_use(path: str, users: str) -> RunError:
    who = " (another gateway? a getty?)"
    if users:
        who = f": {users}"
    name = Path(os.path.realpath(path)).name
    getty = ""
    if name.startswith("tty"):
        getty = f" If it is a getty: sudo systemctl disable --now serial-getty@{name}."
    return RunError(f"{path}: is in use by another program{who}. End it.{getty}")


def device_of(path: str) -> int | None:
    """Return the device number to which a path leads, also for slcan's ``path@baud``.

    None if the path does not lead to a device.
    """
    try:
        status = Path(path.partition("@")[0]).stat()
    except (OSError, ValueError):
        return None
    return status.st_rdev or None


def _open_quietly(path: str) -> int:
    """Open a port and switch its echo off at once. Returns the file descriptor.

    A terminal that was just created echoes the bytes that it receives.
    """
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
        raise RunError(
            f"{path}: is not a serial port. See the adapters: `ls /dev/serial/by-id`."
        ) from None
    return fd


def _open(
    path: str,
    protocol: EscProtocol,
    is_pty: bool,
    refuses_parity: bool = False,
) -> serial.Serial:
    parity = serial.PARITY_EVEN if protocol.even_parity else serial.PARITY_NONE
    if refuses_parity:
        parity = serial.PARITY_NONE
    try:
        return serial.Serial(path, protocol.baud_rate, parity=parity, timeout=0, exclusive=True)
    except (OSError, termios.error, ValueError) as error:
        # SerialException is an OSError; termios.error is not.
        number = getattr(error, "errno", None)
        if error.args and isinstance(error.args[0], int):
            number = error.args[0]
        if number == errno.EINVAL and parity == serial.PARITY_EVEN:
            if is_pty:  # a pseudo terminal has no parity and may refuse it
                return _open(path, protocol, is_pty, refuses_parity=True)
            raise RunError(
                f"{path}: does not support {protocol.baud_rate} baud with even parity. {_NO_PARITY}"
            ) from None
        raise _explained(path, number, str(error)) from None


def _explained(path: str, number: int | None, text: str) -> RunError:
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        ports = sorted(str(port) for port in Path("/dev/serial/by-id").glob("*"))
        if ports:
            hint = f"Available: {', '.join(ports)}."
        else:
            hint = "Is the adapter plugged in? See `ls /dev/serial/by-id`."
        return NoPort(f"{path}: no such serial port. {hint}")
    if number == errno.EACCES:
        group = "dialout"
        is_shared = True
        with contextlib.suppress(OSError, KeyError):
            status = Path(path).stat()
            is_shared = status.st_mode & 0o060 == 0o060
            group = grp.getgrgid(status.st_gid).gr_name
        if not is_shared:  # joining the group would not help
            return RunError(
                f"{path}: permission denied, even for its group {group}. "
                f"Permit it: sudo chmod g+rw {path}."
            )
        return RunError(
            f"{path}: permission denied. "
            f"Join its group: sudo usermod -aG {group} $USER, then log in again."
        )
    if number == errno.EPERM:
        return RunError(
            f"{path}: the service is not allowed to use this device. "
            "Type sudo systemctl edit kontronik-can-gw, and add under [Service]: "
            f"DeviceAllow={path} rw."
        )
    if number in (errno.EAGAIN, errno.EBUSY):
        return _in_use(path, _users(path))
    return RunError(f"{path}: cannot be opened: {text}")


_seen_users: set[Path] = set()
"""Folders in /proc of the programs that had a port open when it was last searched for."""
_next_search: dict[str, float] = {}
"""Time of the next search by path, in seconds of the monotonic clock."""
_SEARCH_PAUSE_S = 10.0


def _users_now_and_then(path: str) -> str:
    """Return the text of ``_users``, or "" in the pause between two searches.

    A search takes a while on a slow machine. Therefore there is at most one in ten seconds, unless
    the last one found a program.
    """
    now = time.monotonic()
    if now < _next_search.get(path, 0.0) and not _seen_users:
        return ""
    _next_search[path] = now + _SEARCH_PAUSE_S
    return _users(path)


def _users(path: str) -> str:
    """Return the other programs that have the port open, as a text for a message.

    Without root's rights it finds only the kernel's console, programs whose controlling terminal is
    the port (a getty), and programs of the same user.
    """
    device = device_of(path)
    found = set()
    name = Path(os.path.realpath(path)).name
    with contextlib.suppress(OSError):
        lines = Path("/proc/consoles").read_text().splitlines()
        if any(line.split()[:1] == [name] for line in lines):
            found.add(
                f"the kernel's console (remove console={name} from the kernel's command line)"
            )
    own = str(os.getpid())
    seen = [process for process in _seen_users if _has_open(process, device)]
    # All programs are searched only if the earlier users have closed the port.
    for process in seen or Path("/proc").glob("[0-9]*"):
        if process.name == own or not _has_open(process, device):
            continue
        with contextlib.suppress(OSError):
            program = (process / "comm").read_text(errors="replace").strip()
            found.add(f"{program} (pid {process.name})")
            _seen_users.add(process)
    _seen_users.difference_update([process for process in _seen_users if not process.exists()])
    return ", ".join(sorted(found))


def _has_open(process: Path, device: int | None) -> bool:
    """Return True if a process has a device open, or as its controlling terminal.

    The terminal is field 7 of the process's ``stat`` file (proc(5)).
    """
    with contextlib.suppress(OSError, ValueError, IndexError):
        stat = (process / "stat").read_text(errors="replace")
        fields_from_3 = stat.rpartition(")")[2].split()
        terminal = int(fields_from_3[4])
        if device is not None and terminal == _packed(device):
            return True
    with contextlib.suppress(OSError):
        for link in (process / "fd").iterdir():
            with contextlib.suppress(OSError):
                if link.stat().st_rdev == device:
                    return True
    return False


def _packed(device: int) -> int:
    """Return a device number as the kernel packs it: minor 7..0, major 19..8, minor 31..20."""
    major = os.major(device)
    minor = os.minor(device)
    return minor & 0xFF | major << 8 | (minor & ~0xFF) << 12
