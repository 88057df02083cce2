"""The bench on emulated hardware.

One ESC is on a simulated USB adapter, the other on a 16550A UART. There are two CAN controllers.
tests/vm/vm_run.py defines the hardware. /sys, ioctl and ``ip`` show its state.
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
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from beds import table
from bus_watch import MS
from feeder import FedEsc, Identity
from harness import Bench
from qemu_adapter import SerialAdapter, wait_until

from kontronik_can_gw.esc.kontronik.codec import WireLayout
from kontronik_can_gw.esc.kontronik.states import Device

WIRE = 0
UART = 1
SLACK_NS = 400 * MS
RATE_HZ = 10
INFO_EVERY = 20
KVASER = Path("/sys/bus/pci/drivers/kvaser_pci")
BITRATE = 1_000_000
_TIOCGICOUNT = 0x545D


# --- serial ports


class LineCounts(NamedTuple):
    """Errors that a driver has counted on a line, from struct serial_icounter_struct."""

    framing: int
    overrun: int
    parity: int
    breaks: int


@contextlib.contextmanager
def beside(device: str) -> Iterator[int]:
    """Open a port that another program has open, which root may. Keep its settings."""
    fd = os.open(device, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        yield fd
    finally:
        os.close(fd)


def line_counts(device: str) -> LineCounts:
    with beside(device) as fd:
        counts = struct.unpack("=20i", fcntl.ioctl(fd, _TIOCGICOUNT, bytes(80)))
    return LineCounts(*counts[6:10])


AS_SET = termios.B115200, termios.CS8 | termios.PARENB, 0
"""The gateway's settings of a port: 8E1, without echo.

Before the gateway sets it, the kernel echoes on a new port. A USB port is new after each plug-in.
"""


def line_setting(device: str) -> tuple[int, int, int]:
    """Read a port's settings from the kernel: speed, the flags of 8E1, and echo."""
    with beside(device) as fd:
        _, _, control, local, _, speed, _ = termios.tcgetattr(fd)
    frame = termios.CSIZE | termios.PARENB | termios.PARODD | termios.CSTOPB
    return speed, control & frame, local & termios.ECHO


@contextlib.contextmanager
def held(device: str) -> Iterator[int]:
    """Keep a port open without echo, as another program does."""
    with beside(device) as fd:
        mode = termios.tcgetattr(fd)
        mode[3] &= ~(termios.ECHO | termios.ECHONL | termios.ICANON)
        termios.tcsetattr(fd, termios.TCSANOW, mode)
        yield fd


def serial_ports() -> set[str]:
    return {str(path) for path in Path("/dev").glob("ttyUSB*")}


class FarPort(FedEsc):
    """An ESC at the far end of QEMU's serial port.

    Unlike a UART, QEMU keeps bytes that arrive while the port is closed, and delivers them when it
    is opened. So this ESC sends only while ``is_open`` reports that the gateway has the port open.
    """

    def __init__(self, identity: Identity, is_open: Callable[[str], bool]) -> None:
        super().__init__(identity, RATE_HZ, INFO_EVERY)
        self.path = self.device = "/dev/ttyS1"
        self._is_open = is_open
        self._received = 0
        self._fd = os.open("/dev/virtio-ports/com1", os.O_RDWR | os.O_NONBLOCK)
        with held(self.device):
            pass  # the port stays without echo
        self._stop = False
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def write(self, data: bytes) -> bool:
        return self._is_open(self.device) and self.put(data)

    def put(self, data: bytes, seconds: float = 1.0) -> bool:
        """Send bytes to the port. Return whether it took all of them within the time."""
        done = 0
        deadline = time.monotonic() + seconds
        while done < len(data) and time.monotonic() < deadline:
            try:
                done += os.write(self._fd, data[done:])
            except BlockingIOError:
                time.sleep(0.002)
        return done == len(data)

    def _listen(self) -> None:
        while not self._stop:
            if select.select([self._fd], [], [], 0.2)[0]:
                with contextlib.suppress(BlockingIOError):
                    self._received += len(os.read(self._fd, 4096))

    def received(self) -> int:
        return self._received

    def close(self) -> None:
        self._stop = True
        self._thread.join(2)
        os.close(self._fd)


class WirePort(FedEsc):
    """An ESC on a simulated adapter. ``error`` is the adapter's status for the frames' bytes."""

    def __init__(self, identity: Identity) -> None:
        super().__init__(identity, RATE_HZ, INFO_EVERY)
        self.adapter = SerialAdapter("ESC0002")
        self.error = 0
        self.device = ""
        self.plug()
        self.path = self.device

    def write(self, data: bytes) -> bool:
        self.adapter.put(data, self.error)
        return self.adapter.plugged

    def unplug(self) -> None:
        """Unplug the adapter, and wait until its device file is gone."""
        before = self.device
        self.device = ""
        self.adapter.unplug()
        wait_until(lambda: before not in serial_ports(), 5, f"{before} gone")

    def plug(self) -> None:
        """Plug the adapter in, and wait for its device file, which may be another than before."""
        before = serial_ports()
        self.adapter.plug()
        wait_until(lambda: serial_ports() - before, 5, "the adapter's device file")
        (self.device,) = serial_ports() - before

    def received(self) -> int:
        return self.adapter.received

    def close(self) -> None:
        self.unplug()


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


@contextlib.contextmanager
def driver_away() -> Iterator[None]:
    """Unbind the first controller from its driver, so that its interface is gone.

    At the end of the block the interface is back and up.
    """
    slot = pci_slot("can0")
    (KVASER / "unbind").write_text(slot)
    yield
    (KVASER / "bind").write_text(slot)
    wait_until(Path("/sys/class/net/can0").exists, 3, "can0")
    can_up("can0")


# --- the bench


class MachineBench(Bench):
    """A bench with two kinds of serial port. The judge is on the second CAN controller."""

    def __init__(self) -> None:
        self._gateway = None  # the feeder reads it before it is set
        self.wire = WirePort(Identity(2, WireLayout.LEGACY, Device.JIVEPRO, 12))
        self.uart = FarPort(Identity(1, WireLayout.V4), self._has_open)
        for name in ("can0", "can1"):
            can_up(name)
        known = table(("--esc", "2"), True, 2)
        super().__init__(
            "can0",
            "can1",
            [self.wire, self.uart],
            known,
            slack_ns=SLACK_NS,
        )

    def _has_open(self, device: str) -> bool:
        """Return whether the gateway has this file open."""
        gateway = self._gateway
        if gateway is None:
            return False
        folder = f"/proc/{gateway.process.pid}/fd"
        with contextlib.suppress(OSError):
            return any(os.readlink(f"{folder}/{fd}") == device for fd in os.listdir(folder))
        return False


@contextlib.contextmanager
def machine(_: Path) -> Iterator[MachineBench]:
    """Create the bench of the bed."""
    with MachineBench() as bench:
        bench.start()
        yield bench
