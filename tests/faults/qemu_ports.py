"""The ESCs of the emulated machine: on its 16550A, and on QEMU's USB adapter."""

import os
from collections.abc import Callable

from encoding import Identity
from feeder import FedEsc
from qemu_machine import FarEnd, LineSetting, Monitor, line_setting, serial_ports, wait_until

AS_SET = LineSetting(115_200, 8, "E", 1, False)
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

    def __init__(self, identity: Identity, reader: Callable[[], int | None], monitor: Monitor) -> None:
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
        self._monitor.must("device_del", id="usbser0")
        wait_until(lambda: before not in serial_ports(), 5, f"{before} gone")

    def plug(self) -> None:
        """Returns when there is a device file again, maybe another."""
        before = serial_ports()
        self._monitor.plug_serial()
        wait_until(lambda: serial_ports() - before, 5, "the adapter's device file")
        (self.device,) = serial_ports() - before
