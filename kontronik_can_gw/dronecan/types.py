"""The types that a node sends or answers, as bytes (DSDL of github.com/dronecan/DSDL, b4653c7 of 2026-02-05).

Numbers are little endian; in the last, partial bytes the most significant bit comes first. What is out of a type's range is
its limit, as DSDL has it ("saturated").
"""

import struct
from binascii import crc_hqx
from collections.abc import Callable
from math import nan
from typing import NamedTuple


class DataType(NamedTuple):
    """A type of messages or of a service. ``seed``: the CRC of its signature, which that of a transfer begins with."""

    number: int
    seed: int
    pack: Callable[..., bytes]
    """Its fields as bytes: of those with a text or an array at the end what comes before that."""


def _type(number: int, signature: int, form: str = "") -> DataType:
    seed = crc_hqx(signature.to_bytes(8, "little"), 0xFFFF)
    return DataType(number, seed, struct.Struct("<" + form).pack)


# fmt: off
STATUS          = _type(1034,  0xA9AF28AEA2FBB254, "IeeeHBB")  # made by status()
STATUS_EXTENDED = _type(1036,  0x02DC203C50960EDC)             # status_extended()
NODE_STATUS     = _type(341,   0x0F0868D0C1A7C6F1, "IBH")      # uptime in s, health << 6 | mode << 3, code of the manufacturer's own
CIRCUIT_STATUS  = _type(1091,  0x8313D33D0DDDA115, "HeeB")     # id, V, A; 1 over-voltage, 2 under-voltage, 4 over-current
TEMPERATURE     = _type(1110,  0x70261C28A94144C6, "HeB")      # id, K, 1: too hot
LOG_MESSAGE     = _type(16383, 0xD654A48E0C049D75, "B")        # level << 5 | length of the source; source, text
ALLOCATION      = _type(1,     0x0B2A812620A11D40, "B")        # node-ID << 1 | is first; unique id or a part
GET_NODE_INFO   = _type(1,     0xEE468A8121C46A9E, "7sBBBIQBB16sB")  # NodeStatus, software, nothing, hardware, unique id, nothing; name
RESTART_NODE    = _type(5,     0x569E05394A3017F0, "B")        # is ok << 7
GET_SET         = _type(11,    0xA7B622F939D1A4D5)             # node.py
# fmt: on

OK, WARNING, ERROR = 0, 1, 2
"""Health of NodeStatus."""
OPERATIONAL, OFFLINE = 0, 7
"""Mode of NodeStatus."""
MAX_ESC_INDEX, MAX_RPM, MAX_TEXT = 31, (1 << 17) - 1, 90
UNKNOWN_MOTOR_TEMPERATURE = -256
"""StatusExtended has no such thing: what is certainly no temperature."""
_MAX_HALF = 65504.0
_KELVIN = 273.15


def half(value: float | None) -> float:
    """For a float of 16 bits: NaN for None, which is not available."""
    if value is None:
        return nan
    return value if -_MAX_HALF <= value <= _MAX_HALF else _MAX_HALF if value > 0 else -_MAX_HALF


def kelvin(celsius: float | None) -> float:
    """A temperature for a float of 16 bits."""
    return nan if celsius is None else half(celsius + _KELVIN)


def status(
    errors: int,
    volts: float | None,
    amperes: float | None,
    celsius: float | None,
    rpm: int,
    percent: int,
    index: int,
) -> bytes:
    """uavcan.equipment.esc.Status."""
    if not -MAX_RPM <= rpm <= MAX_RPM:
        rpm = MAX_RPM if rpm > 0 else -MAX_RPM - 1
    if percent > 127:
        percent = 127
    high, low = rpm >> 10 & 0xC0 | percent >> 1, percent << 7 & 0x80 | index << 2
    v, a, k = half(volts), half(amperes), kelvin(celsius)
    return STATUS.pack(errors, v, a, k, rpm & 0xFFFF, high, low)


def status_extended(
    input_percent: int, output_percent: int, motor_celsius: int, angle: int, flags: int, index: int
) -> bytes:
    """uavcan.equipment.esc.StatusExtended; ``flags``: 19 bits of the manufacturer's own."""
    bits = min(input_percent, 127) << 49 | min(output_percent, 127) << 42
    bits |= (motor_celsius & 0xFF) << 34 | (motor_celsius >> 8 & 1) << 33
    bits |= (angle & 0xFF) << 25 | (angle >> 8 & 1) << 24
    bits |= (flags & 0xFF) << 16 | (flags >> 8 & 0xFF) << 8 | (flags >> 16 & 7) << 5 | index
    return bits.to_bytes(7, "big")
