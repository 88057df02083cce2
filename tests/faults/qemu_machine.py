"""What the emulated machine of tests/vm offers besides a kernel: QEMU's monitor, the far ends of its serial ports, its CAN controllers.

All of it is reached from inside the machine, by virtio ports, /sys and ``ip``. See tests/vm/vm_run.py for what is plugged in.
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
USB_SERIAL = {
    "driver": "usb-serial",
    "id": "usbser0",
    "serial": "ESC0002",
    "bus": "xhci.0",
    "port": "1",
    "chardev": "ftdis",
    "always-plugged": True,
}
_TIOCGICOUNT = 0x545D


def wait_until(condition: Callable[[], Any], seconds: float, what: str) -> float:
    """Wait until something holds; the seconds it took. AssertionError when it does not come."""
    begin = time.monotonic()
    while not condition():
        if time.monotonic() - begin > seconds:
            raise AssertionError(f"{what}: not within {seconds} s")
        time.sleep(0.01)
    return time.monotonic() - begin


class Monitor:
    """QEMU's monitor (QMP)."""

    def __init__(self) -> None:
        self._stream = (VIRTIO_PORTS / "qmp").open("r+b", buffering=0)
        self._lock = threading.Lock()
        self._buffer = b""
        self.ask("qmp_capabilities")

    def ask(self, command: str, **arguments: object) -> dict[str, Any]:
        """The answer: with the key "return" or "error"."""
        with self._lock:
            self._stream.write(json.dumps({"execute": command, "arguments": arguments}).encode() + b"\n")
            while True:
                while b"\n" not in self._buffer:
                    self._buffer += self._stream.read(4096) or b""
                line, self._buffer = self._buffer.split(b"\n", 1)
                answer: dict[str, Any] = json.loads(line)
                if "return" in answer or "error" in answer:
                    return answer

    def unplug_serial(self) -> None:
        answer = self.ask("device_del", id="usbser0")
        assert "return" in answer, answer

    def plug_serial(self) -> None:
        """QEMU takes its time to forget the device of an unplug: tried again until it has."""
        deadline = time.monotonic() + 5
        while "error" in (answer := self.ask("device_add", **USB_SERIAL)):
            assert time.monotonic() < deadline, answer
            time.sleep(0.02)

    def send_break(self, chardev: str) -> None:
        answer = self.ask("chardev-send-break", id=chardev)
        assert "return" in answer, answer


class FarEnd:
    """The far end of an emulated serial port: what is written comes out of the port, what the port sends is counted."""

    def __init__(self, name: str) -> None:
        self._fd = os.open(VIRTIO_PORTS / name, os.O_RDWR | os.O_NONBLOCK)
        self.received = b""
        """All that the machine has transmitted: it has to stay empty."""
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
                    self.received += os.read(self._fd, 4096)

    def close(self) -> None:
        self._stop = True
        self._thread.join(2)
        os.close(self._fd)


# --- serial ports


class LineCounts(NamedTuple):
    """What a driver has counted on a line, of struct serial_icounter_struct."""

    received: int
    transmitted: int
    framing: int
    overrun: int
    parity: int
    breaks: int
    buffer_overrun: int


def line_counts(device: str) -> LineCounts:
    """Read beside whoever has the port; root may open one that is TIOCEXCL. Its settings are not touched."""
    fd = os.open(device, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        counts = struct.unpack("=20i", fcntl.ioctl(fd, _TIOCGICOUNT, bytes(80)))
    finally:
        os.close(fd)
    return LineCounts(*counts[4:11])


class LineSetting(NamedTuple):
    baud: int
    bits: int
    parity: str
    stop_bits: int
    echo: bool


def line_setting(device: str) -> LineSetting:
    """How a port is set, read from the kernel."""
    fd = os.open(device, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        _, _, control, local, _, speed, _ = termios.tcgetattr(fd)
    finally:
        os.close(fd)
    baud = {termios.B9600: 9600, termios.B115200: 115200}.get(speed, 0)
    bits = {termios.CS5: 5, termios.CS6: 6, termios.CS7: 7, termios.CS8: 8}[control & termios.CSIZE]
    parity = "N" if not control & termios.PARENB else "O" if control & termios.PARODD else "E"
    return LineSetting(baud, bits, parity, 2 if control & termios.CSTOPB else 1, bool(local & termios.ECHO))


def serial_ports() -> set[str]:
    return {str(path) for path in Path("/dev").glob("ttyUSB*")}


# --- CAN interfaces


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True)


def can_up(name: str, bitrate: int = 500_000, restart_ms: int = 0, queue: int = 100) -> None:
    ip("link", "set", name, "txqueuelen", str(queue))
    ip("link", "set", name, "up", "type", "can", "bitrate", str(bitrate), "restart-ms", str(restart_ms))


def can_details(name: str) -> dict[str, Any]:
    """What ``ip -d -s -j link show`` says of the controller."""
    done = subprocess.run(["ip", "-d", "-s", "-j", "link", "show", name], check=True, capture_output=True, text=True)
    found: dict[str, Any] = json.loads(done.stdout)[0]
    return found


def controller_state(name: str) -> str:
    """As ``ip`` names it: ERROR-ACTIVE, BUS-OFF ..."""
    return str(can_details(name)["linkinfo"]["info_data"]["state"])


def pci_slot(interface: str) -> str:
    return Path("/sys/class/net", interface, "device").resolve().name


def pci_bind(slot: str, bound: bool) -> None:
    """Give a CAN controller to its driver, or take it away: then its interface is gone."""
    (KVASER / ("bind" if bound else "unbind")).write_text(slot)


def controller_registers(slot: str) -> int:
    """A descriptor of the SJA1000's registers, for pread and pwrite of single bytes."""
    return os.open(f"/sys/bus/pci/devices/{slot}/resource1", os.O_RDWR)
