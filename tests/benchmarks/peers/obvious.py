"""The obvious program: a thread a port, pyserial, zlib, struct, cantools and python-can. What a competent person writes at first.

    python obvious.py DBC CHANNEL PORT...

Each live frame becomes the five messages of the DBC (ESC n has ids n-1 higher). A value that does not fit is sent as Error, without live
frames for 250 ms everything is NotAvailable, as is the BEC current of a JIVEPro.
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
LENGTHS = {b"KODL": (38, 40), b"KODI": (41, 44)}
TIMEOUT = 0.25
INFO_TIMEOUT = 10.0
JIVEPRO = 3


def messages(frame: bytes, supplied: bool) -> list[tuple[str, dict[str, Any]]]:
    """The five messages of a live frame; ``supplied``: its BEC current is one."""
    (
        speed, voltage, current, motor_current, peak_current, charge, bec_current, bec_voltage,
        pwm, throttle, opening, temperature, bec_temperature, errors, state, timing,
    ) = LIVE.unpack_from(frame)  # fmt: skip
    return [
        (
            "FiveSpeed",
            {
                "ElectricalSpeed": speed,
                "BatteryVoltage": voltage / 100,
                "PwmInput": pwm,
                "Timing": timing,
            },
        ),
        (
            "FiveCurrent",
            {
                "BatteryCurrent": current / 10,
                "MotorCurrent": motor_current / 10,
                "PeakCurrent": peak_current / 10,
                "ThrottlePercent": throttle,
                "OutputOpeningPercent": opening,
            },
        ),
        ("FiveState", {"OperatingErrors": errors, "OperatingStateRaw": state}),
        (
            "FiveBec",
            {
                "BecVoltage": bec_voltage / 1000,
                "BecCurrent": bec_current / 1000 if supplied else "NotAvailable",
                "PowerStageTemperature": temperature,
                "BecTemperature": bec_temperature,
            },
        ),
        ("FiveCharge", {"ConsumedCharge": charge}),
    ]


def can_frame(message: Any, values: dict[str, Any], index: int) -> can.Message:
    """A message of ESC number ``index``; what a signal has no room for is Error."""
    for signal in message.signals:
        value = values[signal.name]
        if not isinstance(value, str) and not signal.minimum <= value <= signal.maximum:
            values[signal.name] = "Error"
    data = message.encode(values)
    return can.Message(arbitration_id=message.frame_id + index, data=data, is_extended_id=False)


class Esc:
    """One ESC: its port, what was received and is not decoded yet, its messages."""

    def __init__(
        self, index: int, port: Any, database: Any, bus: Any, lock: threading.Lock
    ) -> None:
        self.index = index
        self.port = port
        self.database = database
        self.bus = bus
        self.lock = lock
        self.buffer = b""
        self.layout: int | None = None
        self.device: int | None = None
        self.last_device: int | None = None
        self.info_time = 0.0
        self.live_time = 0.0
        self.is_up = False

    def run(self) -> None:
        """Serve the port for ever."""
        self.send_not_available()
        while True:
            self.step()

    def step(self) -> None:
        """Wait for bytes and decode what there is."""
        data = self.port.read(self.port.in_waiting or 1)
        now = time.monotonic()
        if self.is_up and now - self.live_time > TIMEOUT:
            self.is_up = False
            self.device = None
            self.send_not_available()
        if self.device is not None and now - self.info_time > INFO_TIMEOUT:
            self.device = None
        if data:
            self.buffer += data
            self.find_frames()

    def find_frames(self) -> None:
        """Take the whole frames out of the buffer."""
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
                covered = (length - 4) // 4 * 4
                if (
                    crc32(self.buffer[:covered])
                    == struct.unpack_from("<I", self.buffer, length - 4)[0]
                ):
                    frame, self.buffer = self.buffer[:length], self.buffer[length:]
                    self.handle(frame, layout)
                    break
            else:
                self.buffer = self.buffer[1:]

    def handle(self, frame: bytes, layout: int) -> None:
        """A frame whose CRC is right."""
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
        for name, values in messages(frame, supplied):
            self.send(name, values)

    def send_not_available(self) -> None:
        """Nothing is known."""
        for message in self.database.messages:
            self.send(message.name, {signal.name: "NotAvailable" for signal in message.signals})

    def send(self, name: str, values: dict[str, Any]) -> None:
        """Encode and send a message."""
        message = self.database.get_message_by_name(name)
        frame = can_frame(message, values, self.index)
        with (
            self.lock,
            contextlib.suppress(can.CanOperationError),
        ):
            # the bus is full: the next one is newer anyway
            self.bus.send(frame)


def main(arguments: list[str]) -> None:
    """A thread a port."""
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
