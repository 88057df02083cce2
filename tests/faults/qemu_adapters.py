"""Two adapters on a played USB: a serial one whose wire has real bits, and a CAN one whose bus has errors.

``SerialAdapter`` is an FT232BM (driver ftdi_sio). What is put on its wire is a sequence of levels, made with the sender's baud rate and
parity; it is sampled with the rate and parity that the driver has set, so wrong parity, framing errors and breaks come out as they do
on hardware. ``CanAdapter`` is an 8 devices USB2CAN (driver usb_8dev) on a ``CanBus`` in this process: bit rates, acknowledgement, error
counters, error passive, bus-off and its end.
"""

import struct
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

from qemu_usb import UsbDevice

# --- the wire of a UART


@dataclass(frozen=True)
class Line:
    """How a UART is set."""

    baud: int = 115_200
    parity: str = "E"

    @property
    def bits(self) -> int:
        """Bit times of a byte."""
        return 10 + (self.parity != "N")


ESC_LINE = Line()
ERROR_OVERRUN, ERROR_PARITY, ERROR_FRAMING, ERROR_BREAK = 0x02, 0x04, 0x08, 0x10
FIFO_SIZE = 384
"""Received bytes, two of status with each packet among them, that the chip holds while nobody reads."""


def levels(data: bytes, line: Line = ESC_LINE) -> list[int]:
    """The wire's level in each bit time of the sender, with the line idle before and after."""
    wire = [1]
    for byte in data:
        ones = byte.bit_count() & 1
        parity = {"N": [], "E": [ones], "O": [ones ^ 1]}[line.parity]
        wire += [0, *(byte >> i & 1 for i in range(8)), *parity, 1]
    return wire + [1] * 12


def sampled(wire: list[int], sent_at: int, line: Line) -> Iterator[tuple[int, int]]:
    """(byte, error) as a UART set to ``line`` reads a wire whose levels last 1/``sent_at`` s."""
    ratio = sent_at / line.baud  # of the sender's bit times in one of ours
    end, position = len(wire), 0.0

    def level(offset: float) -> int:
        index = int(position + offset * ratio)
        return wire[index] if index < end else 1

    parity_bits = line.parity != "N"
    while True:
        while position < end and wire[int(position)]:
            position = int(position) + 1.0
        if position >= end:
            return
        if level(0.5):  # shorter than half a bit: no start
            position = int(position) + 1.0
            continue
        byte = sum(level(1.5 + i) << i for i in range(8))
        error = 0
        if parity_bits:
            even = byte.bit_count() & 1
            if level(9.5) != (even if line.parity == "E" else even ^ 1):
                error = ERROR_PARITY
        stop = level(9.5 + parity_bits)
        if not stop:
            error = ERROR_FRAMING if byte or (parity_bits and level(9.5)) else ERROR_BREAK
        yield byte, error
        position += (9.5 + parity_bits) * ratio
        if not stop:  # a UART waits for the line to be idle again
            while position < end and not wire[int(position)]:
                position = int(position) + 1.0


class SerialAdapter(UsbDevice):
    """An FT232BM. ``received_from_host`` and ``breaks_from_host`` tell of all that would have gone out to the ESC, and ``echoed``
    of what came before the host had set the line as an ESC's: the kernel's echo on a fresh port."""

    def __init__(self, port: int, serial_number: str) -> None:
        super().__init__(port, 0x0403, 0x6001, 0x0400, ("FTDI", "FT232BM with a wire", serial_number), (0x81, 0x02))
        self.line = Line(9600, "N")
        self.latency_ms = 16
        self.received_from_host = b""
        self.breaks_from_host = 0
        self.echoed = 0
        self._is_set = False
        self._just_reset = False
        self._overrun = 0

    def plug(self) -> None:
        self.line, self._is_set = Line(9600, "N"), False
        super().plug()

    def put(self, data: bytes, line: Line = ESC_LINE) -> None:
        """Bytes from an ESC whose UART is set to ``line``."""
        if not self.plugged:
            return
        if line == self.line:  # the usual case, and slow to work out: what comes out is what went in
            self._pass_on(data, 0)
            return
        self._sample(levels(data, line), line.baud)

    def hold_low(self, seconds: float) -> None:
        """A break: the line at 0 for so long."""
        bits = int(seconds * self.line.baud)
        self._sample([1] + [0] * bits + [1] * 12, self.line.baud)

    def flip(self, data: bytes, bit: int) -> None:
        """A frame in which one bit time (of the sender, from 1) has the wrong level."""
        wire = levels(data)
        wire[bit] ^= 1
        self._sample(wire, ESC_LINE.baud)

    def _sample(self, wire: list[int], sent_at: int) -> None:
        run, run_error = bytearray(), 0
        for byte, error in sampled(wire, sent_at, self.line):
            if error or run_error:
                self._pass_on(bytes(run), run_error)
                run = bytearray()
            run.append(byte)
            run_error = error
        self._pass_on(bytes(run), run_error)

    def _pass_on(self, data: bytes, error: int) -> None:
        """The line status counts for the packet: a byte with an error has one of its own."""
        for at in range(0, len(data), 62):
            packet = data[at : at + 62]
            if self.waiting(1) + len(packet) > FIFO_SIZE:
                self._overrun = ERROR_OVERRUN
                return
            self.give(1, bytes((0x01, 0x60 | error | self._overrun)) + packet)
            self._overrun = 0

    def before_answer(self, endpoint: int) -> None:
        if (
            self._just_reset
        ):  # by the port's opening: what does not fill a packet waits until the latency timer has run out
            self._just_reset = False
            time.sleep(self.latency_ms / 1000)

    def taken(self, endpoint: int, data: bytes) -> None:
        if self._is_set:
            self.received_from_host += data
        else:
            self.echoed += len(data)

    def control(self, kind: int, request: int, value: int, index: int, length: int, data: bytes) -> bytes | None:
        if request == 0:  # reset, or clear a buffer: 1 the one of what was received
            if value in (0, 1):
                self.forget(1)
            self._just_reset = value == 0
        elif request == 3:  # baud rate: 3 MHz over a divisor with eighths
            eighths = (0, 4, 2, 1, 3, 5, 6, 7)[value >> 14 | (index & 1) << 2]
            self.line = Line(_nearest(3_000_000 / ((value & 0x3FFF) + eighths / 8 or 1)), self.line.parity)
            self._is_set = self._is_set or self.line == ESC_LINE
        elif request == 4:  # data bits, parity, stop bits, break
            self.line = Line(self.line.baud, "NOEMS"[value >> 8 & 7])
            self.breaks_from_host += value >> 14 & 1
            self._is_set = self._is_set or self.line == ESC_LINE
        elif request == 5:  # modem status
            return b"\x01\x60"
        elif request == 9:
            self.latency_ms = value & 0xFF
        elif request == 10:
            return bytes((self.latency_ms,))
        return bytes(length) if kind & 0x80 else b""


def _nearest(rate: float) -> int:
    """The usual baud rate that is meant."""
    usual = (9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600)
    best = min(usual, key=lambda each: abs(each - rate))
    return best if abs(best - rate) < 0.03 * best else int(rate)


# --- the CAN bus

_TX = struct.Struct(">BBIB8sB")
_RX = struct.Struct(">BBBIB8sIB")
_COMMAND = struct.Struct(">BBBBB10sB")
_OPEN, _CLOSE, _VERSION = 2, 3, 12
_STATUS_OK, _STATUS_WARNING, _STATUS_PASSIVE, _STATUS_BUS_OFF, _STATUS_ACK, _STATUS_FORM = 0, 2, 3, 4, 0x23, 0x21
_CLOCK = 32_000_000


@dataclass
class CanBus:
    """A bus of played adapters; who is open at the sender's bit rate acknowledges and receives."""

    adapters: list["CanAdapter"] = field(default_factory=list)
    lock: threading.RLock = field(default_factory=threading.RLock)
    """Over all that the adapters count."""

    def acknowledged(self, sender: "CanAdapter", frame: bytes) -> bool:
        heard = False
        for each in self.adapters:
            if each is sender or not each.awake:
                continue
            if each.bitrate == sender.bitrate:
                each.deliver(frame)
                heard = True
            else:  # it cannot read what it hears, and says so on the bus
                each.disturb(_STATUS_FORM, receive=8)
        return heard


class CanAdapter(UsbDevice):
    """An 8 devices USB2CAN with a controller that counts errors as ISO 11898-1 says."""

    def __init__(self, port: int, bus: CanBus, serial_number: str) -> None:
        strings = ("edevices", "USB2CAN converter", serial_number)
        super().__init__(port, 0x0483, 0x1234, 0x0100, strings, (0x81, 0x02, 0x83, 0x04))
        self.bus = bus
        bus.adapters.append(self)
        self.bitrate = 0
        self.open = False
        self.bus_off = False
        self.tx_errors = self.rx_errors = 0
        self.starts = 0
        """How often the driver has started the controller: at each up and each restart after bus-off."""
        self.told_version = False
        """The driver has asked what it wants to know first, and the interface may be used."""
        self._told = _STATUS_OK

    @property
    def awake(self) -> bool:
        return self.plugged and self.open and not self.bus_off

    def deliver(self, frame: bytes) -> None:
        """A frame of another adapter."""
        _, flags, can_id, size, content, _ = _TX.unpack(frame)
        stamp = int(time.monotonic() * 1000) & 0xFFFFFFFF
        self.rx_errors = max(0, self.rx_errors - 1)
        self.give(1, _RX.pack(0x55, 0, flags, can_id, size, content, stamp, 0xAA))

    def disturb(self, status: int, transmit: int = 0, receive: int = 0) -> None:
        """Count an error; tell the driver of it and of what state it leads to."""
        with self.bus.lock:
            self.tx_errors += transmit
            self.rx_errors = min(255, self.rx_errors + receive)
            self._tell(status)
            self._follow()

    def go_bus_off(self) -> None:
        """Thirty-two disturbed frames in a row."""
        with self.bus.lock:
            self.disturb(_STATUS_FORM, transmit=256 - self.tx_errors)

    def heal(self) -> None:
        """Errors counted down to 0, as by many good frames."""
        with self.bus.lock:
            self.tx_errors = self.rx_errors = 0
            self._follow()

    def _follow(self) -> None:
        most = max(self.tx_errors, self.rx_errors)
        if self.tx_errors > 255:
            state = _STATUS_BUS_OFF
        else:
            state = _STATUS_PASSIVE if most > 127 else _STATUS_WARNING if most > 95 else _STATUS_OK
        if state != self._told:
            self._told = state
            self.bus_off = state == _STATUS_BUS_OFF
            self._tell(state)

    def _tell(self, status: int) -> None:
        counters = bytes((status, min(self.rx_errors, 127), min(self.tx_errors, 255))) + bytes(5)
        self.give(1, _RX.pack(0x55, 3, 4, 0, 8, counters, 0, 0xAA))

    def taken(self, endpoint: int, data: bytes) -> None:
        if endpoint == 4:
            self._command(data)
            return
        with self.bus.lock:
            if not self.awake:
                return
            if self.bus.acknowledged(self, data):
                self.tx_errors = max(0, self.tx_errors - 1)
                self._follow()
            elif self.tx_errors < 128:  # an error passive node does not count missing acknowledgement
                self.disturb(_STATUS_ACK, transmit=8)

    def _command(self, data: bytes) -> None:
        _, channel, command, _, _, content, _ = _COMMAND.unpack(data)
        answer = bytes(10)
        after_bus_off = False
        if command == _OPEN:
            tseg1, tseg2, _, prescaler = struct.unpack(">BBBH", content[:5])
            with self.bus.lock:
                self.bitrate = _CLOCK // (prescaler * (1 + tseg1 + tseg2))
                after_bus_off, self.open, self.bus_off = self.bus_off, True, False
                self.tx_errors = self.rx_errors = 0
                self._told = _STATUS_OK
                self.starts += 1
        elif command == _CLOSE:
            self.open = False
        elif command == _VERSION:
            answer = b"\1\7\1\0" + bytes(6)
            self.told_version = True
        self.give(3, _COMMAND.pack(0x11, channel, command, 0, 0, answer, 0x22))
        if command == _OPEN and after_bus_off:
            self._tell(_STATUS_OK)
