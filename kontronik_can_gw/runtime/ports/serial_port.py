"""A serial port that is only ever read: set as the ESC's protocol says, exclusive.

Nothing is written to it, ever: an answer could switch an ESC into a mode in which its parameters can be changed. This class has no
way to write, and the line's echo is switched off before anything else.
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
from kontronik_can_gw.runtime.ports.usb_adapters import Identity, identity_at

READ_SIZE = 4096

_TIOCGICOUNT = 0x545D
MINI_UART = "brcm,bcm2835-aux-uart"
"""A Raspberry Pi's second UART, by its name in the device tree: it has no parity, and its driver does not say so."""

_TERMIOS_SIZE = 64
"""Enough for the kernel's struct termios on any machine."""
_COUNTS = struct.Struct("=20i")
_WAITING = struct.Struct("=i")
_LINE_ERRORS = {"framing": 6, "overrun": 7, "parity": 8, "break": 9, "buffer_overrun": 10}
"""Places in struct serial_icounter_struct (linux/serial.h)."""


_NO_PARITY = "A Raspberry Pi's mini-UART (ttyS0) cannot do even parity: use ttyAMA0."


class PortLost(Exception):
    """The port was unplugged or hung up."""


class NoPort(RunError):
    """There is no such port."""


class SerialPort:
    """An open port. RunError with one clear line where it cannot be opened."""

    def __init__(self, path: str, protocol: EscProtocol) -> None:
        self.path = path
        is_pty = os.path.realpath(path).startswith("/dev/pts/")
        # one that does not lock it, as a getty, could write to it; its terminal is not touched
        if Path("/sys/class/tty", Path(os.path.realpath(path)).name).exists() and (
            users := _users_now_and_then(path)
        ):
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
        self.drained = True
        """Whether the last ``read`` left nothing."""
        try:
            mode = termios.tcgetattr(self._fd)
            mode[6][termios.VMIN] = 1  # so that an empty port does not look like one that hung up
            with contextlib.suppress(termios.error):
                termios.tcsetattr(self._fd, termios.TCSANOW, mode)
            self._mode = termios.tcgetattr(self._fd)
            self.settings = self._settings_now()
        except (OSError, termios.error) as error:  # pulled out at this instant
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
        """What has come, at most READ_SIZE. PortLost when the port has gone.

        A short read does not mean that nothing more waits: the kernel passes on what it has further back only when it is asked again.
        It is asked by poll, which costs a third of a read that finds nothing.
        """
        try:
            data = os.read(self._fd, READ_SIZE)
        except BlockingIOError:
            self.drained = True
            return b""
        except OSError as error:
            raise PortLost(error.strerror or str(error)) from None
        if not data:
            raise PortLost("hung up")
        self.drained = not self._poll.poll(0)
        return data

    def settings_hold(self) -> bool:
        """Whether the port still is as it was set; if not it is set again. (Another program, as stty, can change it at any time.)"""
        try:
            if self._settings_now() == self.settings:
                return True
            termios.tcsetattr(self._fd, termios.TCSANOW, self._mode)
        except (OSError, termios.error):
            return True  # it has gone, which reading will show
        return False

    def _settings_now(self) -> bytes:
        """struct termios as the kernel has it, which takes a tenth of the time of termios.tcgetattr's list."""
        return fcntl.ioctl(self._fd, termios.TCGETS, bytes(_TERMIOS_SIZE))

    def line_errors(self) -> Mapping[str, int]:
        """What the driver has counted so far, by kind; empty where it counts nothing (pseudo terminals, some adapters).

        The same object as long as nothing changes.
        """
        if self._line_errors and (found := line_errors(self._fd)) != self._line_errors:
            self._line_errors = found
        return self._line_errors

    @property
    def waits_to_be_read(self) -> bool:
        """True while ``read`` would find bytes."""
        try:
            return bool(
                _WAITING.unpack(fcntl.ioctl(self._fd, termios.FIONREAD, bytes(_WAITING.size)))[0]
            )
        except OSError:
            return False

    def identity(self) -> Identity | None:
        """Of the USB adapter that the port belongs to; None for another kind of port."""
        return identity_at(self._real_path)

    def discard(self) -> None:
        """Throw away what waits to be read."""
        with contextlib.suppress(OSError, termios.error):
            termios.tcflush(self._fd, termios.TCIFLUSH)

    def close(self) -> None:
        with contextlib.suppress(OSError, termios.error):
            self._serial.close()


def line_errors(fd: int) -> dict[str, int]:
    """The line errors of an open port since its driver was loaded, by kind; empty where it counts none."""
    try:
        counts = _COUNTS.unpack(fcntl.ioctl(fd, _TIOCGICOUNT, bytes(_COUNTS.size)))
    except OSError:
        return {}
    return {kind: counts[place] for kind, place in _LINE_ERRORS.items()}


def is_mini_uart(path: str, root: Path = Path("/")) -> bool:
    """True for a Raspberry Pi's mini-UART, which cannot do even parity."""
    device = root / "sys/class/tty" / Path(os.path.realpath(path)).name / "device"
    with contextlib.suppress(OSError):
        for folder in [device.resolve(), *device.resolve().parents][:4]:
            names = folder / "of_node" / "compatible"
            if names.is_file() and MINI_UART in names.read_text(errors="replace").split("\0"):
                return True
    return False


def _in_use(path: str, users: str) -> RunError:
    who = f": {users}" if users else " (another gateway? a getty?)"
    name = Path(os.path.realpath(path)).name
    getty = (
        f"; if it is a getty: sudo systemctl disable --now serial-getty@{name}"
        if name.startswith("tty")
        else ""
    )
    return RunError(f"{path}: is in use by another program{who}. End it{getty}.")


def device_of(path: str) -> int | None:
    """The device number that a path leads to (slcan's ``path@baud`` too); None where it leads to none."""
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
        raise RunError(
            f"{path}: is not a serial port. Name the adapter's: see `ls /dev/serial/by-id`."
        ) from None
    return fd


def _open(
    path: str, protocol: EscProtocol, is_pty: bool, refuses_parity: bool = False
) -> serial.Serial:
    parity = serial.PARITY_EVEN if protocol.even_parity else serial.PARITY_NONE
    if refuses_parity:
        parity = serial.PARITY_NONE
    try:
        return serial.Serial(path, protocol.baud_rate, parity=parity, timeout=0, exclusive=True)
    except (
        OSError,
        termios.error,
        ValueError,
    ) as error:
        # SerialException is an OSError; termios.error is not
        number = (
            error.args[0]
            if error.args and isinstance(error.args[0], int)
            else getattr(error, "errno", None)
        )
        if number == errno.EINVAL and parity == serial.PARITY_EVEN:
            if is_pty:  # a pseudo terminal has no parity and may say so
                return _open(path, protocol, is_pty, refuses_parity=True)
            raise RunError(
                f"{path}: cannot do {protocol.baud_rate} baud with even parity. {_NO_PARITY}"
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
        return NoPort(f"{path}: no such serial port. {there}")
    if number == errno.EACCES:
        group, shared = "dialout", True
        with contextlib.suppress(OSError, KeyError):
            status = Path(path).stat()
            shared = status.st_mode & 0o060 == 0o060
            group = grp.getgrgid(status.st_gid).gr_name
        if not shared:  # to join the group would not help
            return RunError(
                f"{path}: permission denied, to its group {group} too: sudo chmod g+rw {path}."
            )
        return RunError(
            f"{path}: permission denied. Join its group: sudo usermod -aG {group} $USER, then log in again."
        )
    if number == errno.EPERM:
        return RunError(
            f"{path}: the service is not allowed to use this device: sudo systemctl edit kontronik-can-gw, and there under "
            f"[Service]: DeviceAllow={path} rw."
        )
    if number in (errno.EAGAIN, errno.EBUSY):
        return _in_use(path, _users(path))
    return RunError(f"{path}: cannot be opened: {text}")


_seen_users: set[Path] = set()
_next_search: dict[str, float] = {}
_SEARCH_PAUSE_S = 10.0


def _users_now_and_then(path: str) -> str:
    """Who has the port open; looked for at first and then no more than every ten seconds, because it takes a while on a slow machine."""
    now = time.monotonic()
    if now < _next_search.get(path, 0.0) and not _seen_users:
        return ""
    _next_search[path] = now + _SEARCH_PAUSE_S
    return _users(path)


def _users(path: str) -> str:
    """Who else has the port open, as far as we may see: without root's rights only who has it as terminal (a getty), and the kernel."""
    device, found = device_of(path), set()
    name = Path(os.path.realpath(path)).name
    with contextlib.suppress(OSError):
        lines = Path("/proc/consoles").read_text().splitlines()
        if any(line.split()[:1] == [name] for line in lines):
            found.add(
                f"the kernel's console (take console={name} out of the kernel's command line)"
            )
    seen = [process for process in _seen_users if _has_open(process, device)]
    # who had it open when we last looked mostly has it still: all programs are not looked through each time
    for process in seen or Path("/proc").glob("[0-9]*"):
        if process.name != str(os.getpid()) and _has_open(process, device):
            with contextlib.suppress(OSError):
                name = (process / "comm").read_text(errors="replace").strip()
                found.add(f"{name} (pid {process.name})")
                _seen_users.add(process)
    _seen_users.difference_update([process for process in _seen_users if not process.exists()])
    return ", ".join(sorted(found))


def _has_open(process: Path, device: int | None) -> bool:
    """True if a process has a device open, or as its controlling terminal (proc(5): field 7 of stat)."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        terminal = int((process / "stat").read_text(errors="replace").rpartition(")")[2].split()[4])
        # the kernel packs numbers as minor 7..0, major 19..8, minor 31..20
        if device is not None and terminal == _packed(device):
            return True
    with contextlib.suppress(OSError):
        for link in (process / "fd").iterdir():
            with contextlib.suppress(OSError):
                if link.stat().st_rdev == device:
                    return True
    return False


def _packed(device: int) -> int:
    major, minor = os.major(device), os.minor(device)
    return minor & 0xFF | major << 8 | (minor & ~0xFF) << 12
