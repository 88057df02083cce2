"""A simulated USB serial adapter. The kernel's vhci_hcd (USB/IP) plugs it in, ftdi_sio drives it.

Like the chip, it reports wrong parity, wrong stop bits and breaks. Only root may plug it in, and
only on a kernel with vhci_hcd, which the machine of tests/vm has.
"""

import contextlib
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

VHCI = Path("/sys/devices/platform/vhci_hcd.0")
FULL_SPEED = 2
_HEADER = struct.Struct(">5I28s")
_SUBMIT = struct.Struct(">4xi12x8s")
_SETUP = struct.Struct("<BBHHH")
_CMD_UNLINK = 2
_RET_SUBMIT = 3
_RET_UNLINK = 4
_STALL = -32
_UNLINKED = -104
_DEVICE_TO_HOST = 0x80
_VENDOR_OR_CLASS = 0x60
_GET_STATUS = 0
_GET_DESCRIPTOR = 6
_GET_CONFIGURATION = 8
_DEVICE = 1
_CONFIGURATION = 2
_STRING = 3


def wait_until(
    condition: Callable[[], Any],
    seconds: float,
    what: str,
) -> None:
    """Wait until a condition is true. Raise AssertionError if it stays false."""
    begin = time.monotonic()
    while not condition():
        if time.monotonic() - begin > seconds:
            raise AssertionError(f"{what}: not within {seconds} s")
        time.sleep(0.01)


class Line(NamedTuple):
    """The settings of the chip's UART. It always has eight data bits and one stop bit."""

    baud: int = 115_200
    parity: str = "E"


ESC_LINE = Line()
FRESH_LINE = Line(9600, "N")
STATUS_OVERRUN = 0x02
STATUS_PARITY = 0x04
STATUS_FRAMING = 0x08
STATUS_BREAK = 0x10
MODEM_STATUS = 0x01
LINE_STATUS = 0x60
FIFO_SIZE = 384
"""Received bytes that the chip buffers, including two status bytes for each packet."""


def descriptors(strings: Sequence[str]) -> dict[int, bytes]:
    """Return the descriptors by wValue: an FT232BM with the bulk endpoints 81h and 02h."""
    found = {
        _DEVICE << 8: bytes.fromhex("12 01 0002 00 00 00 08 0304 0160 0004 01 02 03 01"),
        _CONFIGURATION << 8: bytes.fromhex(
            "09 02 2000 01 01 00 80 32"  # 32 bytes, one interface, bus-powered, 100 mA
            "09 04 00 00 02 FF FF FF 00"  # vendor's class
            "07 05 81 02 4000 00 07 05 02 02 4000 00"  # bulk, packets of 64 bytes
        ),
        _STRING << 8: bytes.fromhex("04 03 0904"),  # English
    }
    for number, string in enumerate(strings, 1):
        text = string.encode("utf-16-le")
        found[_STRING << 8 | number] = bytes((2 + len(text), _STRING)) + text
    return found


class SerialAdapter:
    """An FT232BM. A thread serves USB/IP on a socket pair.

    ``received`` counts the bytes and breaks that would be sent to the ESC after the host has set
    the line for an ESC. Before that the kernel echoes on a new port.
    """

    def __init__(self, serial_number: str) -> None:
        self.line = FRESH_LINE
        self.latency_ms = 16
        self.received = 0
        self._descriptors = descriptors(("FTDI", "FT232BM with a wire", serial_number))
        self._is_set = False
        self._just_reset = False
        self._overrun = 0
        self._lock = threading.RLock()
        self._ours: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self._asked: deque[int] = deque()  # requests that wait for data
        self._ready: deque[bytes] = deque()  # packets that wait for a request

    @property
    def plugged(self) -> bool:
        return self._ours is not None

    def plug(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)

        def attached() -> bool:
            with contextlib.suppress(OSError):  # just after an unplug the port is not free yet
                (VHCI / "attach").write_text(f"0 {theirs.fileno()} {0x10001} {FULL_SPEED}")
                return True
            return False

        wait_until(attached, 5, "the USB port is free")
        theirs.close()  # the kernel keeps it open
        with self._lock:
            self.line = FRESH_LINE
            self._is_set = False
            self._asked.clear()
            self._ready.clear()
            self._ours = ours
        self._thread = threading.Thread(target=self._serve, args=(ours,), daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        with contextlib.suppress(OSError):  # the kernel may have lost the device already
            (VHCI / "detach").write_text("0")
        if self._thread is not None:
            self._thread.join(5)
            self._thread = None

    # --- the wire

    def waiting(self) -> int:
        """Return the number of bytes that wait for a request of the host."""
        with self._lock:
            return sum(len(packet) for packet in self._ready)

    def put(self, data: bytes, error: int = 0) -> None:
        """Receive bytes from the ESC with a line error, and pass them to the host in packets.

        Bytes are ignored while the adapter is unplugged.
        """
        if self.line != ESC_LINE:
            data = bytes(len(data))
            error = STATUS_FRAMING
        with self._lock:
            for at in range(0, len(data) if self.plugged else 0, 62):
                packet = data[at : at + 62]
                if self.waiting() + len(packet) > FIFO_SIZE:
                    self._overrun = STATUS_OVERRUN
                    return
                packet = bytes((MODEM_STATUS, LINE_STATUS | error | self._overrun)) + packet
                self._overrun = 0
                if self._asked:
                    self._answer(self._asked.popleft(), packet)
                else:
                    self._ready.append(packet)

    # --- USB/IP

    def _serve(self, ours: socket.socket) -> None:
        stream = ours.makefile("rb")
        try:
            while True:
                head = stream.read(_HEADER.size)
                if len(head) < _HEADER.size:
                    break
                command, number, _, to_host, endpoint, rest = _HEADER.unpack(head)
                if command == _CMD_UNLINK:
                    self._unlink(number, int.from_bytes(rest[:4], "big"))
                    continue
                length, setup = _SUBMIT.unpack(rest)
                data = b"" if to_host else stream.read(length)
                if endpoint == 0:
                    self._control(number, setup, len(data))
                elif to_host:
                    self._give(number)
                else:
                    self._answer(number, taken=len(data))
                    self.take(data)
        except OSError:
            pass
        finally:
            with self._lock:
                self._ours = None
            stream.close()
            ours.close()

    def _give(self, number: int) -> None:
        """Answer a request of the host for data, now or when there is some."""
        if self._just_reset:
            # Opening the port resets the chip. An incomplete packet waits for the latency timer.
            self._just_reset = False
            time.sleep(self.latency_ms / 1000)
        with self._lock:
            if self._ready:
                self._answer(number, self._ready.popleft())
            else:
                self._asked.append(number)

    def take(self, data: bytes) -> None:
        """Count bytes that the host sends to the ESC."""
        if self._is_set:
            self.received += len(data)

    def _control(self, number: int, setup: bytes, taken: int) -> None:
        kind, request, value, index, length = _SETUP.unpack(setup)
        answer: bytes | None = b""
        if kind & _VENDOR_OR_CLASS:
            answer = self.vendor(request, value, index, length)
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

    def vendor(
        self,
        request: int,
        value: int,
        index: int,
        length: int,
    ) -> bytes:
        """Return the answer to a request of the driver ftdi_sio."""
        line = self.line
        if request == 0:  # reset, or clear a buffer; 1 clears the receive buffer
            if value in (0, 1):
                with self._lock:
                    self._ready.clear()
            self._just_reset = value == 0
        elif request == 3:  # baud rate: 3 MHz divided by a divisor with eighths
            eighths = (0, 4, 2, 1, 3, 5, 6, 7)[value >> 14 | (index & 1) << 2]
            rate = int(3_000_000 / ((value & 0x3FFF) + eighths / 8 or 1))
            if abs(rate - ESC_LINE.baud) < 0.03 * ESC_LINE.baud:
                rate = ESC_LINE.baud
            line = line._replace(baud=rate)
        elif request == 4:  # data bits, parity, stop bits, break
            line = line._replace(parity="NOEMS"[value >> 8 & 7])
            self.received += value >> 14 & 1
        elif request == 5:
            return bytes((MODEM_STATUS, LINE_STATUS))
        elif request == 9:
            self.latency_ms = value & 0xFF
        elif request == 10:
            return bytes((self.latency_ms,))
        self.line = line
        self._is_set = self._is_set or line == ESC_LINE
        return bytes(length)

    def _answer(
        self,
        number: int,
        data: bytes = b"",
        taken: int = 0,
        status: int = 0,
    ) -> None:
        """Complete a request with data for the host, or with the number of bytes taken from it."""
        size = len(data) or taken
        head = struct.pack(
            ">5I5i8x",
            _RET_SUBMIT,
            number,
            0,
            0,
            0,
            status,
            size,
            0,
            0,
            0,
        )
        self._send(head + data)

    def _unlink(self, number: int, victim: int) -> None:
        """Cancel a request of the host."""
        with self._lock:
            status = 0
            if victim in self._asked:
                self._asked.remove(victim)
                status = _UNLINKED
            self._send(struct.pack(">5Ii24x", _RET_UNLINK, number, 0, 0, 0, status))

    def _send(self, packet: bytes) -> None:
        with self._lock, contextlib.suppress(OSError):
            if self._ours is not None:
                self._ours.sendall(packet)
