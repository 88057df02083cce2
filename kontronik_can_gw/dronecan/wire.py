"""DroneCAN on the wire: types of messages and services, ids, transfers (specification, 4.1).

A transfer is the payload of a message, a request or a response. The types are defined in
github.com/dronecan/DSDL, commit b4653c7 of 2026-02-05. No I/O, no clock: time is an argument.
"""

import struct
from binascii import crc_hqx
from collections.abc import Callable
from typing import NamedTuple

from kontronik_can_gw.signals.transfer import END, START, TOGGLE, TRANSFER_ID
from kontronik_can_gw.times import SECOND

# Priorities, as autopilots and their peripherals use them
LOW = 24
"""Priority of measurements."""
LOWEST = 31
"""Priority of node states and texts."""
MAX_NODE_ID = 125
"""The greatest node-ID of a device. 126 and 127 are reserved for tools."""
# Bits of an id
SERVICE = 0x80
"""The frame is a request or a response of a service."""
REQUEST = 0x8000
"""The frame of a service is a request."""
NODE = 0x7F
"""The node-ID of the source."""
MAX_PAYLOAD = 300
MAX_TRANSFERS = 32
TIMEOUT_NS = 2 * SECOND


class DataType(NamedTuple):
    """A type of messages, or a service."""

    number: int
    seed: int
    """CRC of the type's signature. The CRC of a transfer begins with it."""
    pack: Callable[..., bytes]
    """Packs the fields. A text or an array at the end is not included."""


def _type(number: int, signature: int, form: str = "") -> DataType:
    seed = crc_hqx(signature.to_bytes(8, "little"), 0xFFFF)
    return DataType(number, seed, struct.Struct("<" + form).pack)


# fmt: off
# packed by the core, see esc_report.py
STATUS          = _type(1034,  0xA9AF28AEA2FBB254)
STATUS_EXTENDED = _type(1036,  0x02DC203C50960EDC)
CIRCUIT_STATUS  = _type(1091,  0x8313D33D0DDDA115)
TEMPERATURE     = _type(1110,  0x70261C28A94144C6)
# uptime in s, health << 6 | mode << 3, the manufacturer's code
NODE_STATUS     = _type(341,   0x0F0868D0C1A7C6F1, "IBH")
# level << 5 | length of the source; followed by source and text
LOG_MESSAGE     = _type(16383, 0xD654A48E0C049D75, "B")
# node-ID << 1 | is first part; followed by the unique id or a part of it
ALLOCATION      = _type(1,     0x0B2A812620A11D40, "B")
# NodeStatus, software, unused, hardware, unique id, unused; followed by the name
GET_NODE_INFO   = _type(1,     0xEE468A8121C46A9E, "7sBBBIQBB16sB")
# is ok << 7
RESTART_NODE    = _type(5,     0x569E05394A3017F0, "B")
# packed by nodes.py
GET_SET         = _type(11,    0xA7B622F939D1A4D5)
# fmt: on

# Health in NodeStatus
OK = 0
WARNING = 1
ERROR = 2
# Mode in NodeStatus
OPERATIONAL = 0
OFFLINE = 7
MAX_TEXT = 90
"""Maximum length of the text in a LogMessage."""


def message_id(number: int, source: int, priority: int) -> int:
    """Return the id of a node's messages of a type."""
    return priority << 24 | number << 8 | source


def anonymous_id(number: int, discriminator: int, priority: int) -> int:
    """Return the id of a message without a source node. ``discriminator`` is 14 random bits."""
    return priority << 24 | discriminator << 10 | (number & 3) << 8


def response_id(request_id: int) -> int:
    """Return the id of the response to a request. It has the priority of the request."""
    client = request_id & NODE
    server = request_id >> 8 & NODE
    return request_id & 0x1FFF0000 | client << 8 | SERVICE | server


class Assembler:
    """Assembles received transfers from their frames.

    At most ``MAX_TRANSFERS`` are assembled at a time. A further one replaces the oldest. Transfers
    are dropped, and counted in ``errors``, if they are replaced, if another transfer with their id
    begins, if their end is not received within two seconds, if they are too long, or if their CRC
    is wrong. A frame out of order, for example a repeated one, is ignored.
    """

    def __init__(self) -> None:
        self.errors = 0
        self._begun: dict[int, tuple[int, int, bytes]] = {}
        """The unfinished transfers by CAN id.

        Each has the toggle bit and transfer id of its next frame, the time of its first frame, and
        its CRC and payload received so far.
        """

    def receive(
        self,
        can_id: int,
        data: bytes,
        seed: int,
        now: int,
    ) -> bytes | None:
        """Process a frame. Returns the payload of the transfer that it completes, or None.

        ``seed`` is the seed of the transfer's type.
        """
        if not data:
            return None
        tail = data[-1]
        payload = b""
        since = now
        if tail & START:
            self.errors += self._begun.pop(can_id, None) is not None
            if tail & TOGGLE:  # another version of the protocol
                return None
            if tail & END:
                return data[:-1]
        else:
            expected, since, payload = self._begun.get(can_id, (-1, now, b""))
            if tail & ~END != expected:
                return None  # for example a repeated frame
            del self._begun[can_id]
        payload += data[:-1]
        is_late = now - since > TIMEOUT_NS
        if tail & END:
            content = payload[2:]
            crc = int.from_bytes(payload[:2], "little")
            if not is_late and crc_hqx(content, seed) == crc:
                return content
            self.errors += 1
        elif is_late or len(data) < 8 or len(payload) > MAX_PAYLOAD:
            self.errors += 1
        else:
            next_tail = tail & TRANSFER_ID | ~tail & TOGGLE
            self._await_next(can_id, next_tail, since, payload)
        return None

    def _await_next(self, can_id: int, next_tail: int, since: int, payload: bytes) -> None:
        if len(self._begun) >= MAX_TRANSFERS:
            oldest = next(iter(self._begun))
            del self._begun[oldest]
            self.errors += 1
        self._begun[can_id] = (next_tail, since, payload)
