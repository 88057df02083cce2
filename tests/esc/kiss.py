"""KISS/BLHeli32 serial telemetry, as an example of another ESC protocol.

115200 8N1. A frame is ten bytes, big-endian, without a header: temperature (°C), voltage (10 mV),
current (10 mA), charge (mAh), electrical speed (100 1/min), CRC-8 with polynomial 07h. A gap
separates two frames. After an error, bytes are dropped up to the next gap.
"""

import struct
from dataclasses import dataclass, replace

from kontronik_can_gw.esc.decoder import EscProtocol, Field, FrameForm, Reading

GAP_NS = 2_000_000
_BODY = struct.Struct(">bHHHH")
FORM = FrameForm(length=10)


@dataclass
class Counters:
    """Counts of one stream."""

    bytes: int = 0
    live: int = 0
    info: int = 0
    crc_errors: int = 0
    dropped_bytes: int = 0

    def copy(self) -> "Counters":
        return replace(self)

    def as_dict(self) -> dict[str, int]:
        return dict(vars(self))

    def diagnosis(self, since: "Counters | None" = None) -> str | None:
        old = since or Counters()
        if self.live > old.live:
            return None
        if self.bytes > old.bytes:
            return "bytes but no frame"
        return "no bytes"


class Kiss:
    """Finds the frames of one stream."""

    def __init__(self) -> None:
        self.counters = Counters()
        self._pending = b""
        self._lost = False
        """True from an error to the next gap."""
        self._last_ns = 0
        """Time of the last read."""

    @property
    def pending(self) -> int:
        return len(self._pending)

    def feed(self, data: bytes, now: int = 0) -> list[Reading]:
        if now - self._last_ns >= GAP_NS:
            self.flush()
        self._last_ns = now
        self.counters.bytes += len(data)
        self._pending += data
        found = []
        while len(self._pending) >= FORM.length and not self._lost:
            frame = self._pending[: FORM.length]
            if crc8(frame):
                self.counters.crc_errors += 1
                self._lost = True
                break
            temperature, voltage, current, charge, speed = _BODY.unpack(frame[:9])
            offset = self.counters.bytes - len(self._pending)
            steps = (temperature, voltage, current, charge, speed * 100)
            found.append(Reading(FORM, offset, steps))
            self._pending = self._pending[FORM.length :]
            self.counters.live += 1
        if self._lost:
            self._drop()
        return found

    def flush(self) -> list[Reading]:
        self._drop()
        self._lost = False
        return []

    def adopt_counters(self, counters: Counters) -> None:
        self.counters = counters

    def _drop(self) -> None:
        self.counters.dropped_bytes += len(self._pending)
        self._pending = b""


def crc8(data: bytes) -> int:
    """Return the CRC. Over a frame with its CRC it is 0."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc <<= 1
            if crc & 0x100:
                crc ^= 0x107
    return crc


def frame(
    temperature: int,
    voltage: int,
    current: int,
    charge: int,
    speed: int,
) -> bytes:
    """Return the bytes of a frame with these raw values."""
    body = _BODY.pack(temperature, voltage, current, charge, speed)
    return body + bytes((crc8(body),))


KISS = EscProtocol(
    name="kiss",
    make=Kiss,
    fields=(
        Field("power_stage_temperature", "°C", 0, -128, 127),
        Field("battery_voltage", "V", 1, 0, 0xFFFF, per_unit=100),
        Field("battery_current", "A", 2, 0, 0xFFFF, per_unit=100),
        Field("consumed_charge", "mAh", 3, 0, 0xFFFF),
        Field("electrical_speed", "1/min", 4, 0, 6_553_500),
    ),
)
