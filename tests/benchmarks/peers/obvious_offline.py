"""The obvious offline program: search, zlib, struct, cantools and python-can. What a competent person writes at first.

    python obvious_offline.py DBC IN OUT

IN holds the UART bytes of one ESC, whose live frames come every 10 ms; OUT becomes a candump log with the five messages of the DBC for
each. A value that does not fit is sent as Error; without information of the device a BEC current of 0 is NotAvailable, as is a JIVEPro's.
Prints CPU seconds and live frames as JSON.
"""

import json
import struct
import sys
import time
from pathlib import Path
from typing import Any
from zlib import crc32

import can
import cantools

LIVE = struct.Struct("<4xIHhhhHHHHbBbbIBB")
LENGTHS = {b"KODL": (38, 40), b"KODI": (41, 44)}
PERIOD = 0.010
JIVEPRO = 3


class Converter:
    """From bytes to the log."""

    def __init__(self, database: Any, log: can.CanutilsLogWriter) -> None:
        self.database = database
        self.log = log
        self.device: int | None = None
        self.frames = 0

    def convert(self, data: bytes) -> None:
        """Find the frames and handle them."""
        at = 0
        while True:
            at = data.find(b"KOD", at)
            if at < 0:
                return
            for length in LENGTHS.get(data[at : at + 4], ()):
                covered = (length - 4) // 4 * 4
                if len(data) - at >= length:
                    crc = struct.unpack_from("<I", data, at + length - 4)[0]
                    if crc32(data[at : at + covered]) == crc:
                        self.handle(data[at : at + length])
                        at += length
                        break
            else:
                at += 1

    def handle(self, frame: bytes) -> None:
        """A frame whose CRC is right."""
        if frame[3:4] == b"I":
            self.device = struct.unpack_from("<H", frame, 4)[0] >> 10
            return
        (
            speed, voltage, current, motor_current, peak_current, charge, bec_current, bec_voltage,
            pwm, throttle, opening, temperature, bec_temperature, errors, state, timing,
        ) = LIVE.unpack_from(frame)  # fmt: skip
        supplied = self.device != JIVEPRO and (self.device is not None or bec_current != 0)
        now = self.frames * PERIOD
        self.frames += 1
        self.send(
            now,
            "FiveSpeed",
            {"ElectricalSpeed": speed, "BatteryVoltage": voltage / 100, "PwmInput": pwm, "Timing": timing},
        )
        self.send(
            now,
            "FiveCurrent",
            {
                "BatteryCurrent": current / 10,
                "MotorCurrent": motor_current / 10,
                "PeakCurrent": peak_current / 10,
                "ThrottlePercent": throttle,
                "OutputOpeningPercent": opening,
            },
        )
        self.send(now, "FiveState", {"OperatingErrors": errors, "OperatingStateRaw": state})
        self.send(
            now,
            "FiveBec",
            {
                "BecVoltage": bec_voltage / 1000,
                "BecCurrent": bec_current / 1000 if supplied else "NotAvailable",
                "PowerStageTemperature": temperature,
                "BecTemperature": bec_temperature,
            },
        )
        self.send(now, "FiveCharge", {"ConsumedCharge": charge})

    def send(self, now: float, name: str, values: dict[str, Any]) -> None:
        """Encode and log a message; what a signal has no room for is Error."""
        message = self.database.get_message_by_name(name)
        for signal in message.signals:
            value = values[signal.name]
            if not isinstance(value, str) and not signal.minimum <= value <= signal.maximum:
                values[signal.name] = "Error"
        data = self.database.encode_message(name, values)
        self.log.on_message_received(
            can.Message(timestamp=now, arbitration_id=message.frame_id, data=data, is_extended_id=False, is_rx=False)
        )


def main(arguments: list[str]) -> None:
    """Convert one file."""
    dbc, source, target = arguments
    database = cantools.database.load_file(dbc)
    begun = time.process_time()
    with can.CanutilsLogWriter(target, channel="can0") as log:
        converter = Converter(database, log)
        converter.convert(Path(source).read_bytes())
    print(json.dumps({"cpu_s": time.process_time() - begun, "live": converter.frames}))


if __name__ == "__main__":
    main(sys.argv[1:])
