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
from obvious import JIVEPRO, LENGTHS, LIVE, can_frame, messages

PERIOD = 0.010


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
        bec_current = LIVE.unpack_from(frame)[6]
        supplied = self.device != JIVEPRO and (self.device is not None or bec_current != 0)
        now = self.frames * PERIOD
        self.frames += 1
        for name, values in messages(frame, supplied):
            message = self.database.get_message_by_name(name)
            self.log.on_message_received(can_frame(message, values, timestamp=now, is_rx=False))


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
