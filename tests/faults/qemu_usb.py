"""USB devices played by this process: the kernel's vhci_hcd (USB/IP) plugs them in, and their real drivers serve them.

A device answers control requests and takes and gives bulk data; each has a thread that speaks USB/IP on a socket pair. ``plug`` and
``unplug`` are what a hand does. Only root may plug, and only on a kernel with vhci_hcd: the machine of tests/vm.
"""

import contextlib
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path

VHCI = Path("/sys/devices/platform/vhci_hcd.0")
FULL_SPEED = 2
_HEADER = struct.Struct(">5I28s")
_SUBMIT = struct.Struct(">IiiiI8s")
_SETUP = struct.Struct("<BBHHH")
_CMD_SUBMIT, _CMD_UNLINK, _RET_SUBMIT, _RET_UNLINK = 1, 2, 3, 4
_STALL, _UNLINKED = -32, -104
_IN = 0x80
_GET_STATUS, _GET_DESCRIPTOR, _GET_CONFIGURATION = 0, 6, 8
_DEVICE, _CONFIGURATION, _STRING = 1, 2, 3


class UsbDevice:
    """A full-speed device with one configuration, one interface and bulk endpoints of 64 bytes."""

    def __init__(
        self,
        port: int,
        vendor: int,
        product: int,
        release: int,
        strings: tuple[str, str, str],
        endpoints: Sequence[int],
    ) -> None:
        self.port = port
        self._strings = strings
        head = struct.pack("<BBHBBBBHHHBBBB", 18, _DEVICE, 0x200, 0, 0, 0, 8, vendor, product, release, 1, 2, 3, 1)
        self._device = head
        tail = struct.pack("<BBBBBBBBB", 9, 4, 0, 0, len(endpoints), 0xFF, 0xFF, 0xFF, 0)
        for endpoint in endpoints:
            tail += struct.pack("<BBBBHB", 7, 5, endpoint, 2, 64, 0)
        self._configuration = struct.pack("<BBHBBBBB", 9, 2, 9 + len(tail), 1, 1, 0, 0x80, 50) + tail
        self._lock = threading.RLock()
        self._ours: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self._asked: dict[int, deque[tuple[int, int]]] = {}  # endpoint: (sequence number, length) that wait for data
        self._ready: dict[int, deque[bytes]] = {}  # endpoint: packets that wait to be asked for
        self._stalled = False
        self._held: list[tuple[int, int, bytes]] = []  # (sequence number, endpoint, data) not taken while stalled

    # --- what a hand does

    @property
    def plugged(self) -> bool:
        return self._ours is not None

    def plug(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        deadline = time.monotonic() + 5
        while True:  # right after an unplug the port is not free yet
            try:
                (VHCI / "attach").write_text(f"{self.port} {theirs.fileno()} {0x10001 + self.port} {FULL_SPEED}")
                break
            except OSError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.01)
        theirs.close()  # the kernel holds it
        with self._lock:
            self._asked.clear()
            self._ready.clear()
            self._held.clear()
            self._ours = ours
        self._thread = threading.Thread(target=self._serve, args=(ours,), daemon=True, name=f"usb{self.port}")
        self._thread.start()

    def unplug(self) -> None:
        with contextlib.suppress(OSError):  # it may have lost the device by itself
            (VHCI / "detach").write_text(str(self.port))
        if self._thread is not None:
            self._thread.join(5)
            self._thread = None

    # --- what a device does

    def control(self, kind: int, request: int, value: int, index: int, length: int, data: bytes) -> bytes | None:
        """Answer a vendor's request; None stalls."""
        return None

    def taken(self, endpoint: int, data: bytes) -> None:
        """Bulk data from the host."""

    def give(self, endpoint: int, packet: bytes) -> None:
        """Send one packet to the host, as soon as it asks. Nothing happens while unplugged."""
        with self._lock:
            if self._ours is None:
                return
            asked = self._asked.get(endpoint)
            if asked:
                number, _ = asked.popleft()
                self._answer(number, packet)
            else:
                self._ready.setdefault(endpoint, deque(maxlen=4096)).append(packet)

    def before_answer(self, endpoint: int) -> None:
        """The host asks for data; what takes its time may do so here."""

    def waiting(self, endpoint: int) -> int:
        """Bytes that wait until the host asks for them."""
        with self._lock:
            return sum(len(packet) for packet in self._ready.get(endpoint, ()))

    def forget(self, endpoint: int) -> None:
        """Drop them."""
        with self._lock:
            self._ready.pop(endpoint, None)

    # --- USB/IP

    def _serve(self, ours: socket.socket) -> None:
        stream = ours.makefile("rb")
        try:
            while len(head := stream.read(_HEADER.size)) == _HEADER.size:
                command, number, _, direction, endpoint, rest = _HEADER.unpack(head)
                if command == _CMD_UNLINK:
                    self._unlink(number, int.from_bytes(rest[:4], "big"))
                    continue
                _, length, _, _, _, setup = _SUBMIT.unpack(rest)
                data = b"" if direction else stream.read(length)
                if endpoint == 0:
                    answer = self._standard(setup, data)
                    with self._lock:
                        self._answer(number, answer if direction else b"", None if answer is None else len(data))
                elif direction:
                    self.before_answer(endpoint)
                    with self._lock:
                        ready = self._ready.get(endpoint)
                        if ready:
                            self._answer(number, ready.popleft())
                        else:
                            self._asked.setdefault(endpoint, deque()).append((number, length))
                else:
                    self._take(number, endpoint, data)
        except OSError:
            pass
        finally:
            with self._lock:
                self._ours = None
            stream.close()
            ours.close()

    def stall(self, stalled: bool) -> None:
        """Take nothing from the host any more, as a device whose firmware hangs; or go on: what it held is lost."""
        with self._lock:
            self._stalled = stalled
            for number, _, data in self._held:
                self._answer(number, b"", len(data))
            self._held.clear()

    def _take(self, number: int, endpoint: int, data: bytes) -> None:
        with self._lock:
            if self._stalled:
                self._held.append((number, endpoint, data))
                return
            self._answer(number, b"", len(data))
        self.taken(endpoint, data)

    def _answer(self, number: int, data: bytes | None, taken: int | None = 0) -> None:
        """Complete a request: with data to the host, with so many bytes taken from it, or (None) stalled."""
        status = _STALL if data is None or taken is None else 0
        length = len(data) if data else taken or 0
        packet = struct.pack(">5I5i8x", _RET_SUBMIT, number, 0, 0, 0, status, length, 0, 0, 0) + (data or b"")
        if self._ours is not None:
            with contextlib.suppress(OSError):
                self._ours.sendall(packet)

    def _unlink(self, number: int, victim: int) -> None:
        with self._lock:
            status = 0
            for asked in self._asked.values():
                for request in list(asked):
                    if request[0] == victim:
                        asked.remove(request)
                        status = _UNLINKED
            if any(number == victim for number, _, _ in self._held):
                self._held = [held for held in self._held if held[0] != victim]
                status = _UNLINKED
            if self._ours is not None:
                with contextlib.suppress(OSError):
                    self._ours.sendall(struct.pack(">5Ii24x", _RET_UNLINK, number, 0, 0, 0, status))

    def _standard(self, setup: bytes, data: bytes) -> bytes | None:
        kind, request, value, index, length = _SETUP.unpack(setup)
        if kind & 0x60:
            answer = self.control(kind, request, value, index, length, data)
            return None if answer is None else answer[:length]
        if request == _GET_DESCRIPTOR:
            return self._descriptor(value >> 8, value & 0xFF, length)
        if request == _GET_STATUS:
            return bytes(2)[:length]
        if request == _GET_CONFIGURATION:
            return b"\1"
        return None if kind & _IN else b""

    def _descriptor(self, kind: int, number: int, length: int) -> bytes | None:
        if kind == _DEVICE:
            return self._device[:length]
        if kind == _CONFIGURATION:
            return self._configuration[:length]
        if kind == _STRING and number == 0:
            return bytes((4, _STRING, 9, 4))[:length]
        if kind == _STRING and number <= len(self._strings):
            text = self._strings[number - 1].encode("utf-16-le")
            return (bytes((2 + len(text), _STRING)) + text)[:length]
        return None
