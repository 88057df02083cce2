"""The ESCs of the emulated machine: on its 16550A, on QEMU's USB adapter, and on a played adapter whose wire has real bits."""

import os
import random
import termios
import time
from collections.abc import Callable

from encoding import Identity
from feeder import FedEsc
from qemu_adapters import ESC_LINE, Line, SerialAdapter
from qemu_machine import FarEnd, Monitor, line_setting, serial_ports, wait_until

AS_SET = (115_200, 8, "E", 1, False)
"""How the gateway sets a port: without echo. Until then the kernel echoes on one that was never used, as a USB port is at each plug-in."""
RATE_HZ = 10
INFO_EVERY = 20


class FarPort:
    """An ESC at the far end of one of QEMU's serial ports.

    QEMU keeps what comes while the port is closed, and delivers it at the next opening: no UART does. So this ESC is silent
    until the process that ``reader`` names has the port open.
    """

    def __init__(self, name: str, device: str, identity: Identity, reader: Callable[[], int | None]) -> None:
        self.far = FarEnd(name)
        self.device = device
        self.fed = FedEsc(self.write, identity, RATE_HZ, INFO_EVERY)
        self._reader = reader
        self._known: int | None = None  # the process that has it open
        self._is_set = False
        self._before_set = 0  # bytes sent until then: what may have been echoed

    @property
    def path(self) -> str:
        return self.device

    def write(self, data: bytes) -> bool:
        reader = self._reader()
        if reader is None:
            return False
        if self._known != reader:
            if not self._is_open(reader):
                return False
            self._known = reader
        self._is_set = self._is_set or line_setting(self.device) == AS_SET
        if not self._is_set:
            self._before_set += len(data)
        return self.far.put(data) == len(data)

    def closed(self) -> None:
        """The port was closed, or went away: silent until it is open again."""
        self._known = None

    def _is_open(self, process: int) -> bool:
        try:
            for fd in os.listdir(f"/proc/{process}/fd"):
                if os.readlink(f"/proc/{process}/fd/{fd}") == self.device:
                    return True
        except OSError:
            pass
        return False

    @property
    def echoed(self) -> int:
        return min(len(self.far.received), self._before_set)

    def received(self) -> int:
        return len(self.far.received) - self.echoed

    def close(self) -> None:
        self.far.close()


class UsbPort(FarPort):
    """QEMU's USB serial adapter, unplugged and plugged in by the monitor."""

    def __init__(self, identity: Identity, reader: Callable[[], int | None], monitor: Monitor) -> None:
        (device,) = serial_ports()
        super().__init__("ftdi", device, identity, reader)
        self._configured = device
        self._monitor = monitor

    @property
    def path(self) -> str:
        return self._configured

    def unplug(self) -> None:
        self.closed()
        self._is_set = False
        before, self.device = self.device, ""
        self._monitor.unplug_serial()
        wait_until(lambda: before not in serial_ports(), 5, f"{before} gone")

    def plug(self) -> None:
        """Returns when there is a device file again, maybe another."""
        before = serial_ports()
        self._monitor.plug_serial()
        wait_until(lambda: serial_ports() - before, 5, "the adapter's device file")
        (self.device,) = serial_ports() - before


class WirePort:
    """A played adapter. ``send`` is how a frame gets onto the wire; setting it to another of the methods is the fault."""

    def __init__(self, adapter: SerialAdapter, identity: Identity, rate_hz: float = RATE_HZ) -> None:
        self.adapter = adapter
        self.device = ""
        self.fed = FedEsc(self.write, identity, rate_hz, INFO_EVERY)
        self.send: Callable[[bytes], bool] = self.clean
        self._random = random.Random(1)
        self.plug()
        self._configured = self.device

    @property
    def path(self) -> str:
        return self._configured

    def write(self, data: bytes) -> bool:
        return self.send(data)

    def clean(self, data: bytes) -> bool:
        self.adapter.put(data)
        return self.adapter.plugged

    def flipped(self, data: bytes) -> bool:
        """One bit time of the frame, start, parity and stop bits among them, has the wrong level."""
        self.adapter.flip(data, self._random.randrange(1, len(data) * ESC_LINE.bits + 1))
        return False

    def at(self, line: Line) -> Callable[[bytes], bool]:
        """As an ESC sends whose UART is set otherwise."""

        def send(data: bytes) -> bool:
            self.adapter.put(data, line)
            return False

        return send

    def unplug(self) -> None:
        before, self.device = self.device, ""
        self.adapter.unplug()
        wait_until(lambda: before not in serial_ports(), 5, f"{before} gone")

    def plug(self) -> None:
        before = serial_ports()
        self.adapter.plug()
        wait_until(lambda: serial_ports() - before, 5, "the played adapter's device file")
        (self.device,) = serial_ports() - before

    @property
    def echoed(self) -> int:
        return self.adapter.echoed

    def received(self) -> int:
        """Bytes, and breaks, which are as bad."""
        return len(self.adapter.received_from_host) + self.adapter.breaks_from_host

    def close(self) -> None:
        self.send = lambda data: False
        self.adapter.unplug()


def hold(device: str) -> int:
    """Open a port as another program does, without echo, and keep it."""
    deadline = time.monotonic() + 2
    while True:
        try:
            fd = os.open(device, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
            break
        except OSError:  # it may be a moment younger than its file
            if time.monotonic() > deadline:
                raise
            time.sleep(0.005)
    mode = termios.tcgetattr(fd)
    mode[3] &= ~(termios.ECHO | termios.ECHONL | termios.ICANON)
    termios.tcsetattr(fd, termios.TCSANOW, mode)
    return fd
