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
USB_SERIAL: dict[str, Any] = {
    "driver": "usb-serial",
    "id": "usbser0",
    "serial": "ESC0002",
    "bus": "xhci.0",
}
USB_SERIAL |= {"port": "1", "chardev": "ftdis", "always-plugged": True}
BITRATE = 1_000_000
_TIOCGICOUNT = 0x545D


def wait_until(condition: Callable[[], Any], seconds: float, what: str) -> None:
    """Wait until something holds. AssertionError when it does not come."""
    begin = time.monotonic()
    while not condition():
        if time.monotonic() - begin > seconds:
            raise AssertionError(f"{what}: not within {seconds} s")
        time.sleep(0.01)


class Monitor:
    """QEMU's monitor (QMP)."""

    def __init__(self) -> None:
        self._stream = (VIRTIO_PORTS / "qmp").open("r+b", buffering=0)
        self._buffer = b""
        self.ask("qmp_capabilities")

    def ask(self, command: str, **arguments: object) -> dict[str, Any]:
        """The answer: with the key "return" or "error"."""
        self._stream.write(
            json.dumps({"execute": command, "arguments": arguments}).encode() + b"\n"
        )
        while True:
            while b"\n" not in self._buffer:
                self._buffer += self._stream.read(4096) or b""
            line, self._buffer = self._buffer.split(b"\n", 1)
            answer: dict[str, Any] = json.loads(line)
            if "return" in answer or "error" in answer:
                return answer

    def must(self, command: str, **arguments: object) -> None:
        """AssertionError where it is refused."""
        answer = self.ask(command, **arguments)
        assert "return" in answer, answer

    def plug_serial(self) -> None:
        """QEMU takes its time to forget the device of an unplug: tried again until it has."""
        wait_until(lambda: "return" in self.ask("device_add", **USB_SERIAL), 5, "device_add")

    def close(self) -> None:
        self._stream.close()


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


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True)


def can_up(name: str, bitrate: int = BITRATE, restart_ms: int = 100) -> None:
    ip("link", "set", name, "down")
    ip("link", "set", name, "txqueuelen", "100")
    settings = f"type can bitrate {bitrate} restart-ms {restart_ms}"
    ip("link", "set", name, "up", *settings.split())


def _can_details(name: str) -> Any:
    done = subprocess.run(
        ["ip", "-d", "-s", "-j", "link", "show", name], check=True, capture_output=True, text=True
    )
    return json.loads(done.stdout)[0]


def receive_overruns(name: str) -> int:
    return int(_can_details(name)["stats64"]["rx"]["over_errors"])


def controller_state(name: str) -> str:
    """As ``ip`` names it: ERROR-ACTIVE, BUS-OFF ..."""
    return str(_can_details(name)["linkinfo"]["info_data"]["state"])


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
