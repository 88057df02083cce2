"""The ESCs of the emulated machine: on its 16550A, on QEMU's USB adapter, and on a played adapter whose wire has real bits."""

import os
import random
from collections.abc import Callable

from encoding import Identity
from feeder import FedEsc
from qemu_adapters import ESC_LINE, Line, SerialAdapter
from qemu_machine import FarEnd, LineSetting, Monitor, line_setting, serial_ports, wait_until

AS_SET = LineSetting(115_200, 8, "E", 1, False)
"""How the gateway sets a port: without echo. Until then the kernel echoes on one that was never used, as a USB port is at each plug-in."""
RATE_HZ = 10
INFO_EVERY = 20


def pull(how: Callable[[], None], device: str) -> None:
    """Unplug an adapter; returns when its device file is gone."""
    how()
    wait_until(lambda: device not in serial_ports(), 5, f"{device} gone")


def put_back(how: Callable[[], None]) -> str:
    """Plug in an adapter; its device file, maybe another than before."""
    before = serial_ports()
    how()
    wait_until(lambda: serial_ports() - before, 5, "the adapter's device file")
    (device,) = serial_ports() - before
    return device


class FarPort:
    """An ESC at the far end of one of QEMU's serial ports.

    QEMU keeps what comes while the port is closed, and delivers it at the next opening: no UART does. So this ESC is silent
    until the process that ``reader`` names has the port open.
    """

    def __init__(
        self, name: str, device: str, identity: Identity, reader: Callable[[], int | None]
    ) -> None:
        self.far = FarEnd(name)
        self.path = self.device = device
        self.fed = FedEsc(self.write, identity, RATE_HZ, INFO_EVERY)
        self._reader = reader
        self._known: int | None = None  # the process that has it open
        self._is_set = False
        self._before_set = 0  # bytes sent until then: what may have been echoed

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
        return min(self.far.received, self._before_set)

    def received(self) -> int:
        return self.far.received - self.echoed

    def close(self) -> None:
        self.far.close()


class UsbPort(FarPort):
    """QEMU's USB serial adapter, unplugged and plugged in by the monitor."""

    def __init__(
        self, identity: Identity, reader: Callable[[], int | None], monitor: Monitor
    ) -> None:
        if not serial_ports():
            monitor.plug_serial()
        wait_until(serial_ports, 5, "the adapter's device file")
        (device,) = serial_ports()
        super().__init__("ftdi", device, identity, reader)
        self._monitor = monitor

    def unplug(self) -> None:
        self._known = None
        self._is_set = False
        before, self.device = self.device, ""
        pull(lambda: self._monitor.must("device_del", id="usbser0"), before)

    def plug(self) -> None:
        self.device = put_back(self._monitor.plug_serial)


class WirePort:
    """A played adapter. ``send`` is how a frame gets onto the wire; setting it to another of the methods is the fault."""

    def __init__(self, adapter: SerialAdapter, identity: Identity) -> None:
        self.adapter = adapter
        self.fed = FedEsc(self.write, identity, RATE_HZ, INFO_EVERY)
        self.send: Callable[[bytes], bool] = self.clean
        self._random = random.Random(1)
        self.path = self.device = put_back(adapter.plug)

    def write(self, data: bytes) -> bool:
        return self.send(data)

    def clean(self, data: bytes) -> bool:
        self.adapter.put(data)
        return self.adapter.plugged

    def silent(self, data: bytes) -> bool:
        return False

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
        pull(self.adapter.unplug, before)

    def plug(self) -> None:
        self.device = put_back(self.adapter.plug)

    @property
    def echoed(self) -> int:
        return self.adapter.echoed

    def received(self) -> int:
        return self.adapter.received

    def close(self) -> None:
        self.unplug()
