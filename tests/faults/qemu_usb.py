"""USB devices played by this process: the kernel's vhci_hcd (USB/IP) plugs them in, and their real drivers serve them.

A device answers control requests and takes and gives bulk data; each has a thread that speaks USB/IP on a socket pair. ``plug`` and
``unplug`` are what a hand does. Only root may plug, and only on a kernel with vhci_hcd: the machine of tests/vm.
"""

import contextlib
import socket
import struct
import threading
from collections import defaultdict, deque
from collections.abc import Sequence
from pathlib import Path

from qemu_machine import wait_until

VHCI = Path("/sys/devices/platform/vhci_hcd.0")
FULL_SPEED = 2
PACKET_SIZE = 64
_HEADER = struct.Struct(">5I28s")
_SUBMIT = struct.Struct(">IiiiI8s")
_SETUP = struct.Struct("<BBHHH")
_CMD_UNLINK, _RET_SUBMIT, _RET_UNLINK = 2, 3, 4
_STALL, _UNLINKED = -32, -104
_DEVICE_TO_HOST, _VENDOR_OR_CLASS = 0x80, 0x60
_GET_STATUS, _GET_DESCRIPTOR, _GET_CONFIGURATION = 0, 6, 8
_DEVICE, _CONFIGURATION, _STRING, _INTERFACE, _ENDPOINT = 1, 2, 3, 4, 5
_BULK = 2


def descriptors(
    product: tuple[int, int, int], strings: Sequence[str], endpoints: Sequence[int]
) -> dict[int, bytes]:
    """By wValue, of a device with one configuration and one interface. ``product``: vendor, product, release."""
    device = struct.pack("<BBHBBBBHHHBBBB", 18, _DEVICE, 0x200, 0, 0, 0, 8, *product, 1, 2, 3, 1)
    parts = struct.pack("<9B", 9, _INTERFACE, 0, 0, len(endpoints), 0xFF, 0xFF, 0xFF, 0)
    for endpoint in endpoints:
        parts += struct.pack("<4BHB", 7, _ENDPOINT, endpoint, _BULK, PACKET_SIZE, 0)
    configuration = (
        struct.pack("<BBH5B", 9, _CONFIGURATION, 9 + len(parts), 1, 1, 0, 0x80, 50) + parts
    )
    english = bytes((4, _STRING, 9, 4))
    found = {_DEVICE << 8: device, _CONFIGURATION << 8: configuration, _STRING << 8: english}
    for number, string in enumerate(strings, 1):
        text = string.encode("utf-16-le")
        found[_STRING << 8 | number] = bytes((2 + len(text), _STRING)) + text
    return found


class UsbDevice:
    """A full-speed device with bulk endpoints."""

    def __init__(self, port: int, descriptors: dict[int, bytes]) -> None:
        self.port = port
        self._descriptors = descriptors
        self._lock = threading.RLock()
        self._ours: socket.socket | None = None
        self._thread: threading.Thread | None = None
        # endpoint: requests that wait for data
        self._asked: dict[int, deque[int]] = defaultdict(deque)
        # endpoint: packets that wait to be asked for
        self._ready: dict[int, deque[bytes]] = defaultdict(deque)

    # --- what a hand does

    @property
    def plugged(self) -> bool:
        return self._ours is not None

    def plug(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        words = f"{self.port} {theirs.fileno()} {0x10001 + self.port} {FULL_SPEED}"

        def attached() -> bool:
            with contextlib.suppress(OSError):  # right after an unplug the port is not free yet
                (VHCI / "attach").write_text(words)
                return True
            return False

        wait_until(attached, 5, f"vhci port {self.port} is free")
        theirs.close()  # the kernel holds it
        with self._lock:
            self._asked.clear()
            self._ready.clear()
            self._ours = ours
        self._thread = threading.Thread(
            target=self._serve, args=(ours,), daemon=True, name=f"usb{self.port}"
        )
        self._thread.start()

    def unplug(self) -> None:
        with contextlib.suppress(OSError):  # it may have lost the device by itself
            (VHCI / "detach").write_text(str(self.port))
        if self._thread is not None:
            self._thread.join(5)
            self._thread = None

    # --- what a device does

    def control(self, kind: int, request: int, value: int, index: int, length: int) -> bytes | None:
        """Answer a vendor's request; None stalls."""
        return None

    def taken(self, endpoint: int, data: bytes) -> None:
        """Bulk data from the host."""

    def before_answer(self) -> None:
        """The host asks for data; what takes its time may do so here."""

    def give(self, endpoint: int, packet: bytes) -> None:
        """Send one packet to the host, as soon as it asks. Nothing happens while unplugged."""
        with self._lock:
            if not self.plugged:
                return
            if self._asked[endpoint]:
                self._answer(self._asked[endpoint].popleft(), packet)
            else:
                self._ready[endpoint].append(packet)

    def waiting(self, endpoint: int) -> int:
        """Bytes that wait until the host asks for them."""
        with self._lock:
            return sum(len(packet) for packet in self._ready[endpoint])

    def forget(self, endpoint: int) -> None:
        """Drop them."""
        with self._lock:
            self._ready[endpoint].clear()

    # --- USB/IP

    def _serve(self, ours: socket.socket) -> None:
        stream = ours.makefile("rb")
        try:
            while len(head := stream.read(_HEADER.size)) == _HEADER.size:
                command, number, _, to_host, endpoint, rest = _HEADER.unpack(head)
                if command == _CMD_UNLINK:
                    self._unlink(number, int.from_bytes(rest[:4], "big"))
                    continue
                _, length, _, _, _, setup = _SUBMIT.unpack(rest)
                data = b"" if to_host else stream.read(length)
                if endpoint == 0:
                    self._control(number, setup, len(data))
                elif to_host:
                    self._give(number, endpoint)
                else:
                    self._take(number, endpoint, data)
        except OSError:
            pass
        finally:
            with self._lock:
                self._ours = None
            stream.close()
            ours.close()

    def _control(self, number: int, setup: bytes, taken: int) -> None:
        kind, request, value, index, length = _SETUP.unpack(setup)
        answer: bytes | None = b""
        if kind & _VENDOR_OR_CLASS:
            answer = self.control(kind, request, value, index, length)
        elif request == _GET_DESCRIPTOR:
            answer = self._descriptors.get(value)
        elif request == _GET_STATUS:
            answer = bytes(2)
        elif request == _GET_CONFIGURATION:
            answer = b"\1"
        elif kind & _DEVICE_TO_HOST:
            answer = None
        if answer is None:
            self._answer(number, status=_STALL)
        else:
            self._answer(number, answer[:length] if kind & _DEVICE_TO_HOST else b"", taken)

    def _give(self, number: int, endpoint: int) -> None:
        self.before_answer()
        with self._lock:
            if self._ready[endpoint]:
                self._answer(number, self._ready[endpoint].popleft())
            else:
                self._asked[endpoint].append(number)

    def _take(self, number: int, endpoint: int, data: bytes) -> None:
        self._answer(number, taken=len(data))
        self.taken(endpoint, data)

    def _answer(self, number: int, data: bytes = b"", taken: int = 0, status: int = 0) -> None:
        """Complete a request: with data to the host, or with so many bytes taken from it."""
        self._send(
            struct.pack(
                ">5I5i8x", _RET_SUBMIT, number, 0, 0, 0, status, len(data) or taken, 0, 0, 0
            )
            + data
        )

    def _unlink(self, number: int, victim: int) -> None:
        """The host takes a request back."""
        with self._lock:
            status = 0
            for asked in self._asked.values():
                if victim in asked:
                    asked.remove(victim)
                    status = _UNLINKED
            self._send(struct.pack(">5Ii24x", _RET_UNLINK, number, 0, 0, 0, status))

    def _send(self, packet: bytes) -> None:
        with self._lock, contextlib.suppress(OSError):
            if self._ours is not None:
                self._ours.sendall(packet)
