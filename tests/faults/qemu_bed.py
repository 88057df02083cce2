"""The ESCs of the emulated machine: on its 16550A, and on a played adapter whose wire has real bits."""

import os
import random
from collections.abc import Callable

from encoding import Identity
from feeder import FedEsc
from qemu_adapter import ESC_LINE, Line, SerialAdapter
from qemu_machine import FarEnd, LineSetting, line_setting, serial_ports, wait_until

AS_SET = LineSetting(115_200, 8, "E", 1, False)
"""How the gateway sets a port: without echo. Until then the kernel echoes on one that was never used, as a USB port is at each plug-in."""
RATE_HZ = 10
INFO_EVERY = 20


class FarPort:
    """An ESC at the far end of QEMU's serial port.

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


class WirePort:
    """A played adapter. ``send`` is how a frame gets onto the wire; setting it to another of the methods is the fault."""

    def __init__(self, adapter: SerialAdapter, identity: Identity) -> None:
        self.adapter = adapter
        self.fed = FedEsc(self.write, identity, RATE_HZ, INFO_EVERY)
        self.send: Callable[[bytes], bool] = self.clean
        self._random = random.Random(1)
        self.device = ""
        self.plug()
        self.path = self.device

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
        """Returns when its device file is gone."""
        before, self.device = self.device, ""
        self.adapter.unplug()
        wait_until(lambda: before not in serial_ports(), 5, f"{before} gone")

    def plug(self) -> None:
        """Returns when its device file is there, maybe another than before."""
        before = serial_ports()
        self.adapter.plug()
        wait_until(lambda: serial_ports() - before, 5, "the adapter's device file")
        (self.device,) = serial_ports() - before

    @property
    def echoed(self) -> int:
        return self.adapter.echoed

    def received(self) -> int:
        return self.adapter.received

    def close(self) -> None:
        self.unplug()
