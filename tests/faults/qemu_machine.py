"""What the emulated machine of tests/vm offers besides a kernel: the far end of its serial port, its CAN controllers.

All of it is reached from inside the machine, by a virtio port, /sys and ``ip``. See tests/vm/vm_run.py for what is plugged in.
"""

import contextlib
import fcntl
import json
import os
import select
import struct
import subprocess
import termios
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

VIRTIO_PORTS = Path("/dev/virtio-ports")
KVASER = Path("/sys/bus/pci/drivers/kvaser_pci")
BITRATE = 1_000_000
_TIOCGICOUNT = 0x545D


def wait_until(condition: Callable[[], Any], seconds: float, what: str) -> None:
    """Wait until something holds. AssertionError when it does not come."""
    begin = time.monotonic()
    while not condition():
        if time.monotonic() - begin > seconds:
            raise AssertionError(f"{what}: not within {seconds} s")
        time.sleep(0.01)


class FarEnd:
    """The far end of an emulated serial port: what is written comes out of the port, what the port sends is counted."""

    def __init__(self, name: str) -> None:
        self._fd = os.open(VIRTIO_PORTS / name, os.O_RDWR | os.O_NONBLOCK)
        self.received = 0
        """Bytes that the machine has transmitted."""
        self._stop = False
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def put(self, data: bytes, seconds: float = 1.0) -> int:
        """Bytes to the port, as many as it takes within the time."""
        done, deadline = 0, time.monotonic() + seconds
        while done < len(data):
            try:
                done += os.write(self._fd, data[done:])
            except BlockingIOError:
                if time.monotonic() > deadline:
                    break
                time.sleep(0.002)
        return done

    def _listen(self) -> None:
        while not self._stop:
            if select.select([self._fd], [], [], 0.2)[0]:
                with contextlib.suppress(BlockingIOError):
                    self.received += len(os.read(self._fd, 4096))

    def close(self) -> None:
        self._stop = True
        self._thread.join(2)
        os.close(self._fd)


# --- serial ports


class LineCounts(NamedTuple):
    """What a driver has counted on a line, of struct serial_icounter_struct."""

    framing: int
    overrun: int
    parity: int
    breaks: int


class LineSetting(NamedTuple):
    baud: int
    bits: int
    parity: str
    stop_bits: int
    echo: bool


def _beside(device: str) -> int:
    """A port opened beside whoever has it, as root may; its settings are not touched."""
    return os.open(device, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)


def line_counts(device: str) -> LineCounts:
    fd = _beside(device)
    try:
        return LineCounts(*struct.unpack("=20i", fcntl.ioctl(fd, _TIOCGICOUNT, bytes(80)))[6:10])
    finally:
        os.close(fd)


def line_setting(device: str) -> LineSetting:
    """How a port is set, read from the kernel."""
    fd = _beside(device)
    try:
        _, _, control, local, _, speed, _ = termios.tcgetattr(fd)
    finally:
        os.close(fd)
    baud = {termios.B9600: 9600, termios.B115200: 115200}.get(speed, 0)
    bits = {termios.CS5: 5, termios.CS6: 6, termios.CS7: 7, termios.CS8: 8}[control & termios.CSIZE]
    parity = "N" if not control & termios.PARENB else "O" if control & termios.PARODD else "E"
    return LineSetting(
        baud, bits, parity, 2 if control & termios.CSTOPB else 1, bool(local & termios.ECHO)
    )


def hold(device: str) -> int:
    """Open a port as another program does, without echo, and keep it."""
    fd = _beside(device)
    mode = termios.tcgetattr(fd)
    mode[3] &= ~(termios.ECHO | termios.ECHONL | termios.ICANON)
    termios.tcsetattr(fd, termios.TCSANOW, mode)
    return fd


def serial_ports() -> set[str]:
    return {str(path) for path in Path("/dev").glob("ttyUSB*")}


# --- CAN interfaces


def can_up(name: str) -> None:
    for settings in ("down", "txqueuelen 100", f"up type can bitrate {BITRATE} restart-ms 100"):
        subprocess.run(["ip", "link", "set", name, *settings.split()], check=True)


def receive_overruns(name: str) -> int:
    command = ["ip", "-s", "-j", "link", "show", name]
    shown = subprocess.run(command, check=True, capture_output=True).stdout
    return int(json.loads(shown)[0]["stats64"]["rx"]["over_errors"])


def pci_slot(interface: str) -> str:
    return Path("/sys/class/net", interface, "device").resolve().name


def pci_bind(slot: str, bound: bool) -> None:
    """Give a CAN controller to its driver, or take it away: then its interface is gone."""
    (KVASER / ("bind" if bound else "unbind")).write_text(slot)


def driver_back(slot: str) -> None:
    """Give the first controller to its driver again, and bring its interface up."""
    pci_bind(slot, True)
    wait_until(Path("/sys/class/net/can0").exists, 3, "can0")
    can_up("can0")


def controller_registers(slot: str) -> int:
    """A descriptor of the SJA1000's registers, for pread and pwrite of single bytes."""
    return os.open(f"/sys/bus/pci/devices/{slot}/resource1", os.O_RDWR)
