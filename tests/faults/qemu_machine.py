"""What the emulated machine of tests/vm has besides a kernel, by /sys, ioctl and ``ip``: tests/vm/vm_run.py says what is plugged in."""

import fcntl
import json
import os
import struct
import subprocess
import termios
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

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


# --- serial ports


class LineCounts(NamedTuple):
    """What a driver has counted on a line, of struct serial_icounter_struct."""

    framing: int
    overrun: int
    parity: int
    breaks: int


def _beside(device: str) -> int:
    """A port opened beside whoever has it, as root may; its settings are not touched."""
    return os.open(device, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)


def line_counts(device: str) -> LineCounts:
    fd = _beside(device)
    try:
        return LineCounts(*struct.unpack("=20i", fcntl.ioctl(fd, _TIOCGICOUNT, bytes(80)))[6:10])
    finally:
        os.close(fd)


AS_SET = termios.B115200, termios.CS8 | termios.PARENB, 0
"""How the gateway sets a port: 8E1, without echo. Until then the kernel echoes on a new one, as a USB port is at each plug-in."""


def line_setting(device: str) -> tuple[int, int, int]:
    """How a port is set, read from the kernel: speed, what stands for 8E1, echo."""
    fd = _beside(device)
    try:
        _, _, control, local, _, speed, _ = termios.tcgetattr(fd)
    finally:
        os.close(fd)
    frame = termios.CSIZE | termios.PARENB | termios.PARODD | termios.CSTOPB
    return speed, control & frame, local & termios.ECHO


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
