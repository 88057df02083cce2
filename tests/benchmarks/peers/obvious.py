"""The baseline program: the first version that a competent programmer would write.

    python obvious.py DBC CHANNEL PORT...

It has a thread for each port, and uses pyserial, zlib, struct, cantools and python-can. For each
UART frame of live data it sends the five messages of the DBC. The ids of ESC n are higher by n-1. A
value that does not fit is sent as Error. After 250 ms without UART frames of live data, all values
are sent as NotAvailable. The BEC current of a JIVEPro is always NotAvailable.
"""

import contextlib
import struct
import sys
import threading
import time
from typing import Any
from zlib import crc32

import can
import cantools
import serial

LIVE = struct.Struct("<4xIHhhhHHHHbBbbIBB")
SIGNALS = (
    *("ElectricalSpeed", "BatteryVoltage", "BatteryCurrent", "MotorCurrent", "PeakCurrent"),
    *("ConsumedCharge", "BecCurrent", "BecVoltage", "PwmInput", "ThrottlePercent"),
    *("OutputOpeningPercent", "PowerStageTemperature", "BecTemperature"),
    *("OperatingErrors", "OperatingStateRaw", "Timing"),
)
STEPS = (1, 100, 10, 10, 10, 1, 1000, 1000, 1, 1, 1, 1, 1, 1, 1, 1)
"""Steps of a unit."""
LENGTHS = {b"KODL": (38, 40), b"KODI": (41, 44)}
TIMEOUT = 0.25
INFO_TIMEOUT = 10.0
JIVEPRO = 3


def values_of(frame: bytes, supplied: bool) -> dict[str, Any]:
    """Return the signals of a frame. ``supplied`` is True if the ESC measures its BEC current."""
    found = zip(SIGNALS, STEPS, LIVE.unpack_from(frame), strict=True)
    values: dict[str, Any] = {name: value / steps for name, steps, value in found}
    if not supplied:
        values["BecCurrent"] = "NotAvailable"
    return values


def can_frame(message: Any, values: dict[str, Any], index: int) -> can.Message:
    """Return a message of ESC number ``index``. Values that do not fit are Error."""
    own = {signal.name: values[signal.name] for signal in message.signals}
    for signal in message.signals:
        value = own[signal.name]
        if not isinstance(value, str) and not signal.minimum <= value <= signal.maximum:
            own[signal.name] = "Error"
    data = message.encode(own)
    return can.Message(arbitration_id=message.frame_id + index, data=data, is_extended_id=False)


class Esc:
    """One ESC: its port, received bytes that are not decoded yet, and its messages."""

    def __init__(self, index: int, port: Any, *shared: Any) -> None:
        self.index = index
        self.port = port
        self.database, self.bus, self.lock = shared
        self.buffer = b""
        self.layout: int | None = None
        self.device: int | None = None
        self.last_device: int | None = None
        self.info_time = 0.0
        self.live_time = 0.0
        self.is_up = False

    def run(self) -> None:
        """Read the port without end."""
        self.send(dict.fromkeys(SIGNALS, "NotAvailable"))
        while True:
            self.step()

    def step(self) -> None:
        """Wait for bytes and decode all complete frames."""
        data = self.port.read(self.port.in_waiting or 1)
        now = time.monotonic()
        if self.is_up and now - self.live_time > TIMEOUT:
            self.is_up = False
            self.device = None
            self.send(dict.fromkeys(SIGNALS, "NotAvailable"))
        if self.device is not None and now - self.info_time > INFO_TIMEOUT:
            self.device = None
        if data:
            self.buffer += data
            self.find_frames()

    def find_frames(self) -> None:
        """Remove the complete frames from the buffer and handle them."""
        while True:
            start = self.buffer.find(b"KOD")
            if start < 0:
                self.buffer = self.buffer[-2:]
                return
            self.buffer = self.buffer[start:]
            if len(self.buffer) < 4:
                return
            lengths = LENGTHS.get(self.buffer[:4])
            if lengths is None:
                self.buffer = self.buffer[1:]
                continue
            for layout, length in enumerate(lengths):
                if len(self.buffer) < length:
                    return
                crc = crc32(self.buffer[: (length - 4) // 4 * 4])
                if crc == struct.unpack_from("<I", self.buffer, length - 4)[0]:
                    frame, self.buffer = self.buffer[:length], self.buffer[length:]
                    self.handle(frame, layout)
                    break
            else:
                self.buffer = self.buffer[1:]

    def handle(self, frame: bytes, layout: int) -> None:
        """Handle a frame whose CRC is right."""
        if layout != self.layout:
            self.layout = layout
            self.device = self.last_device = None
        if frame[3:4] == b"I":
            self.device = self.last_device = struct.unpack_from("<H", frame, 4)[0] >> 10
            self.info_time = time.monotonic()
            return
        bec_current = LIVE.unpack_from(frame)[6]
        if self.device is not None:
            supplied = self.device != JIVEPRO
        else:
            supplied = bec_current != 0 and self.last_device != JIVEPRO
        self.live_time = time.monotonic()
        self.is_up = True
        self.send(values_of(frame, supplied))

    def send(self, values: dict[str, Any]) -> None:
        """Encode and send all messages."""
        for message in self.database.messages:
            frame = can_frame(message, values, self.index)
            # if the bus is full, the next frame has newer values
            with self.lock, contextlib.suppress(can.CanOperationError):
                self.bus.send(frame)


def main(arguments: list[str]) -> None:
    """Start a thread for each port."""
    dbc, channel, *ports = arguments
    database = cantools.database.load_file(dbc)
    bus = can.Bus(interface="socketcan", channel=channel)
    lock = threading.Lock()
    threads = []
    for index, path in enumerate(ports):
        port = serial.Serial(path, 115200, parity=serial.PARITY_NONE, timeout=TIMEOUT)
        esc = Esc(index, port, database, bus, lock)
        threads.append(threading.Thread(target=esc.run, daemon=True))
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


if __name__ == "__main__":
    main(sys.argv[1:])
