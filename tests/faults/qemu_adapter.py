"""A serial adapter on a played USB whose wire has real bits: an FT232BM (driver ftdi_sio).

What is put on its wire is a sequence of levels, made with the sender's baud rate and parity; it is sampled with the rate and parity
that the driver has set, so wrong parity, framing errors and breaks come out as they do on hardware.
"""

import time
from collections.abc import Iterator
from typing import NamedTuple

from qemu_usb import UsbDevice, descriptors

# --- the wire of a UART


class Line(NamedTuple):
    """How a UART is set; always eight data bits and one stop bit."""

    baud: int = 115_200
    parity: str = "E"

    @property
    def bits(self) -> int:
        """Bit times of a byte."""
        return 10 + (self.parity != "N")


ESC_LINE = Line()
FRESH_LINE = Line(9600, "N")
STATUS_OVERRUN, STATUS_PARITY, STATUS_FRAMING, STATUS_BREAK = 0x02, 0x04, 0x08, 0x10
MODEM_STATUS, LINE_STATUS = 0x01, 0x60
FIFO_SIZE = 384
"""Received bytes, two of status with each packet among them, that the chip holds while nobody reads."""


def levels(data: bytes, line: Line) -> list[int]:
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
    stop_bit = line.bits - 1
    end, position = len(wire), 0.0

    def level(offset: float) -> int:
        index = int(position + offset * ratio)
        return wire[index] if index < end else 1

    def skip(unwanted: int) -> float:
        """The next change of the level."""
        at = int(position)
        while at < end and wire[at] == unwanted:
            at += 1
        return max(float(at), position)

    while (position := skip(1)) < end:
        if level(0.5):  # shorter than half a bit: no start
            position = int(position) + 1.0
            continue
        byte = sum(level(1.5 + i) << i for i in range(8))
        odd = byte.bit_count() & 1
        error = 0
        if line.parity != "N" and level(9.5) != (odd if line.parity == "E" else odd ^ 1):
            error = STATUS_PARITY
        stop = level(stop_bit + 0.5)
        if not stop:
            all_low = not byte and not (line.parity != "N" and level(9.5))
            error = STATUS_BREAK if all_low else STATUS_FRAMING
        yield byte, error
        position += (stop_bit + 0.5) * ratio
        if not stop:  # a UART waits for the line to be idle again
            position = skip(0)


class SerialAdapter(UsbDevice):
    """An FT232BM. ``received`` counts the bytes and breaks that would have gone out to the ESC, ``echoed`` the bytes of before the
    host had set the line as an ESC's: the kernel's echo on a fresh port."""

    def __init__(self, port: int, serial_number: str) -> None:
        strings = ("FTDI", "FT232BM with a wire", serial_number)
        super().__init__(port, descriptors((0x0403, 0x6001, 0x0400), strings, (0x81, 0x02)))
        self.line = FRESH_LINE
        self.latency_ms = 16
        self.received = 0
        self.echoed = 0
        self._is_set = False
        self._just_reset = False
        self._overrun = 0

    def plug(self) -> None:
        self.line, self._is_set = FRESH_LINE, False
        super().plug()

    def put(self, data: bytes, line: Line = ESC_LINE) -> None:
        """Bytes from an ESC whose UART is set to ``line``."""
        if not self.plugged:
            return
        if line == self.line:
            # the usual case, and slow to work out: what comes out is what went in
            self._pass_on(data, 0)
        else:
            self._sample(levels(data, line), line.baud)

    def hold_low(self, seconds: float) -> None:
        """A break: the line at 0 for so long."""
        bits = int(seconds * self.line.baud)
        self._sample([1] + [0] * bits + [1] * 12, self.line.baud)

    def flip(self, data: bytes, bit: int) -> None:
        """A frame in which one bit time (of the sender, from 1) has the wrong level."""
        wire = levels(data, ESC_LINE)
        wire[bit] ^= 1
        self._sample(wire, ESC_LINE.baud)

    def _sample(self, wire: list[int], sent_at: int) -> None:
        run = bytearray()
        for byte, error in sampled(wire, sent_at, self.line):
            if error:  # has a packet of its own: the line status counts for the whole of one
                self._pass_on(bytes(run), 0)
                self._pass_on(bytes([byte]), error)
                run.clear()
            else:
                run.append(byte)
        self._pass_on(bytes(run), 0)

    def _pass_on(self, data: bytes, error: int) -> None:
        for at in range(0, len(data), 62):
            packet = data[at : at + 62]
            if self.waiting(1) + len(packet) > FIFO_SIZE:
                self._overrun = STATUS_OVERRUN
                return
            self.give(1, bytes((MODEM_STATUS, LINE_STATUS | error | self._overrun)) + packet)
            self._overrun = 0

    def before_answer(self) -> None:
        if self._just_reset:
            # by the port's opening: what does not fill a packet waits for the latency timer
            self._just_reset = False
            time.sleep(self.latency_ms / 1000)

    def taken(self, endpoint: int, data: bytes) -> None:
        if self._is_set:
            self.received += len(data)
        else:
            self.echoed += len(data)

    def control(self, kind: int, request: int, value: int, index: int, length: int) -> bytes | None:
        if request == 0:  # reset, or clear a buffer: 1 the one of what was received
            if value in (0, 1):
                self.forget(1)
            self._just_reset = value == 0
        elif request == 3:  # baud rate: 3 MHz over a divisor with eighths
            eighths = (0, 4, 2, 1, 3, 5, 6, 7)[value >> 14 | (index & 1) << 2]
            rate = int(3_000_000 / ((value & 0x3FFF) + eighths / 8 or 1))
            exact = ESC_LINE.baud if abs(rate - ESC_LINE.baud) < 0.03 * ESC_LINE.baud else rate
            self._set(Line(exact, self.line.parity))
        elif request == 4:  # data bits, parity, stop bits, break
            self._set(Line(self.line.baud, "NOEMS"[value >> 8 & 7]))
            self.received += value >> 14 & 1
        elif request == 5:
            return bytes((MODEM_STATUS, LINE_STATUS))
        elif request == 9:
            self.latency_ms = value & 0xFF
        elif request == 10:
            return bytes((self.latency_ms,))
        return bytes(length)

    def _set(self, line: Line) -> None:
        self.line = line
        self._is_set = self._is_set or line == ESC_LINE
