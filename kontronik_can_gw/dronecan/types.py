"""The types that a node sends or answers, as bytes (DSDL of github.com/dronecan/DSDL, b4653c7 of 2026-02-05).

Numbers are little endian; in the last, partial bytes the most significant bit comes first. What is out of a type's range is
its limit, as DSDL has it ("saturated"). None: not available, NaN where the type has that.
"""

import struct
from math import nan

from kontronik_can_gw.dronecan.transport import data_type

STATUS = data_type(1034, 0xA9AF28AEA2FBB254)
STATUS_EXTENDED = data_type(1036, 0x02DC203C50960EDC)
NODE_STATUS = data_type(341, 0x0F0868D0C1A7C6F1)
CIRCUIT_STATUS = data_type(1091, 0x8313D33D0DDDA115)
TEMPERATURE = data_type(1110, 0x70261C28A94144C6)
LOG_MESSAGE = data_type(16383, 0xD654A48E0C049D75)
ALLOCATION = data_type(1, 0x0B2A812620A11D40)
GET_NODE_INFO = data_type(1, 0xEE468A8121C46A9E)
RESTART_NODE = data_type(5, 0x569E05394A3017F0)
GET_SET = data_type(11, 0xA7B622F939D1A4D5)

OK, WARNING, ERROR = 0, 1, 2
"""Health of NodeStatus."""
OPERATIONAL, OFFLINE = 0, 7
"""Mode of NodeStatus."""
MAX_ESC_INDEX = 31
MAX_RPM = (1 << 17) - 1
MAX_NODE_NAME, MAX_TEXT, MAX_PARAMETER_NAME = 80, 90, 92
UNKNOWN_MOTOR_TEMPERATURE = -256
"""The type has no such thing: what is certainly no temperature."""
_MAX_HALF = 65504.0
_KELVIN = 273.15
_STATUS = struct.Struct("<IeeeH")


def _half(value: float | None) -> float:
    """For a float of 16 bits."""
    if value is None:
        return nan
    return value if -_MAX_HALF <= value <= _MAX_HALF else _MAX_HALF if value > 0 else -_MAX_HALF


def kelvin(celsius: float | None) -> float | None:
    """A temperature in K."""
    return None if celsius is None else celsius + _KELVIN


def status(
    errors: int,
    volts: float | None,
    amperes: float | None,
    temperature: float | None,
    rpm: int,
    percent: int,
    index: int,
) -> bytes:
    """uavcan.equipment.esc.Status; ``temperature`` in K."""
    if not -MAX_RPM <= rpm <= MAX_RPM:
        rpm = MAX_RPM if rpm > 0 else -MAX_RPM - 1
    head = _STATUS.pack(errors, _half(volts), _half(amperes), _half(temperature), rpm & 0xFFFF)
    tail = (rpm >> 16 & 3) << 14 | min(percent, 127) << 7 | index << 2
    return head + tail.to_bytes(2, "big")


def status_extended(
    input_percent: int, output_percent: int, motor_celsius: int, angle: int, flags: int, index: int
) -> bytes:
    """uavcan.equipment.esc.StatusExtended; ``flags``: 19 bits of the manufacturer's own."""
    bits = min(input_percent, 127) << 49 | min(output_percent, 127) << 42
    bits |= (motor_celsius & 0xFF) << 34 | (motor_celsius >> 8 & 1) << 33
    bits |= (angle & 0xFF) << 25 | (angle >> 8 & 1) << 24
    bits |= (flags & 0xFF) << 16 | (flags >> 8 & 0xFF) << 8 | (flags >> 16 & 7) << 5 | index
    return bits.to_bytes(7, "big")


def node_status(uptime_s: int, health: int, mode: int, code: int) -> bytes:
    """uavcan.protocol.NodeStatus; ``code``: 16 bits of the manufacturer's own."""
    return struct.pack("<IBH", uptime_s & 0xFFFFFFFF, health << 6 | mode << 3, code & 0xFFFF)


def node_info(
    state: bytes, software: tuple[int, int], hardware: tuple[int, int], unique_id: bytes, name: str
) -> bytes:
    """The answer of GetNodeInfo; ``state``: NodeStatus."""
    versions = struct.pack("<BBBIQBB", *software, 0, 0, 0, *hardware)
    return state + versions + unique_id + b"\0" + name.encode("ascii")


def circuit_status(number: int, volts: float | None, amperes: float | None, flags: int) -> bytes:
    """uavcan.equipment.power.CircuitStatus; flags: 1 over-voltage, 2 under-voltage, 4 over-current."""
    return struct.pack("<HeeB", number, _half(volts), _half(amperes), flags)


def temperature(device: int, degrees: float | None, is_hot: bool) -> bytes:
    """uavcan.equipment.device.Temperature; ``degrees`` in K."""
    return struct.pack("<HeB", device, _half(degrees), is_hot)


def log_message(level: int, source: str, text: str) -> bytes:
    """uavcan.protocol.debug.LogMessage; level: 1 information, 2 warning, 3 error."""
    name = source.encode("ascii", "replace")[:31]
    return bytes((level << 5 | len(name),)) + name + text.encode("ascii", "replace")[:MAX_TEXT]


def allocation(node_id: int, is_first: bool, unique_id: bytes) -> bytes:
    """uavcan.protocol.dynamic_node_id.Allocation."""
    return bytes((node_id << 1 | is_first,)) + unique_id
