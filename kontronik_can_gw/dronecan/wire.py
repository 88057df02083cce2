"""What is on the wire: types of messages and services, ids, and received transfers (specification, 4.1). Pure.

A transfer is the payload of a message, a request or a response. Types: DSDL of github.com/dronecan/DSDL, b4653c7 of 2026-02-05.
"""

import struct
from binascii import crc_hqx
from collections.abc import Callable
from typing import NamedTuple

from kontronik_can_gw.signals.transfer import END, START, TOGGLE, TRANSFER_ID
from kontronik_can_gw.times import SECOND

LOW, LOWEST = 24, 31
"""Priorities, as autopilots and their peripherals use them: of measurements, of node states and texts."""
MAX_NODE_ID = 125
"""126 and 127 are those of tools."""
SERVICE, REQUEST, NODE = 0x80, 0x8000, 0x7F
"""Bits of an id: it is a service's, it is a request; the source."""
MAX_PAYLOAD, MAX_TRANSFERS, TIMEOUT_NS = 300, 32, 2 * SECOND


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
# made by the core: esc_report.py
STATUS          = _type(1034,  0xA9AF28AEA2FBB254)
STATUS_EXTENDED = _type(1036,  0x02DC203C50960EDC)
CIRCUIT_STATUS  = _type(1091,  0x8313D33D0DDDA115)
TEMPERATURE     = _type(1110,  0x70261C28A94144C6)
# made here
NODE_STATUS     = _type(341,   0x0F0868D0C1A7C6F1, "IBH")      # uptime in s, health << 6 | mode << 3, code of the manufacturer's own
LOG_MESSAGE     = _type(16383, 0xD654A48E0C049D75, "B")        # level << 5 | length of the source; source, text
ALLOCATION      = _type(1,     0x0B2A812620A11D40, "B")        # node-ID << 1 | is first; unique id or a part
GET_NODE_INFO   = _type(1,     0xEE468A8121C46A9E, "7sBBBIQBB16sB")  # NodeStatus, software, nothing, hardware, unique id, nothing; name
RESTART_NODE    = _type(5,     0x569E05394A3017F0, "B")        # is ok << 7
GET_SET         = _type(11,    0xA7B622F939D1A4D5)             # nodes.py
# fmt: on

OK, WARNING, ERROR = 0, 1, 2
"""Health of NodeStatus."""
OPERATIONAL, OFFLINE = 0, 7
"""Mode of NodeStatus."""
MAX_TEXT = 90
"""Of a LogMessage."""


def message_id(number: int, source: int, priority: int) -> int:
    """The id of a node's messages of a type."""
    return priority << 24 | number << 8 | source


def anonymous_id(number: int, discriminator: int, priority: int) -> int:
    """The id of a message without a node; ``discriminator``: 14 random bits."""
    return priority << 24 | discriminator << 10 | (number & 3) << 8


def response_id(request_id: int) -> int:
    """The id of the answer to a request: of its priority, from its destination to its source."""
    source, own = request_id & NODE, request_id >> 8 & NODE
    return request_id & 0x1FFF0000 | source << 8 | SERVICE | own


class Assembler:
    """Puts transfers together, at most ``MAX_TRANSFERS`` at a time: the one that waits longest gives way.

    Out of order, without an end within two seconds, too long or with a wrong CRC: dropped, and counted in ``errors``.
    """

    def __init__(self) -> None:
        self.errors = 0
        self._begun: dict[int, tuple[int, int, bytes]] = {}
        """By id: toggle and transfer id of the frame that is missing, time of the first one, CRC and payload so far."""

    def receive(self, can_id: int, data: bytes, seed: int, now: int) -> bytes | None:
        """The payload of the transfer that this frame completes. ``seed``: of its type."""
        if not data:
            return None
        tail, payload, since = data[-1], b"", now
        if tail & START:
            self.errors += self._begun.pop(can_id, None) is not None
            if tail & TOGGLE:  # of another version of the protocol
                return None
            if tail & END:
                return data[:-1]
        else:
            expected, since, payload = self._begun.get(can_id, (-1, now, b""))
            if tail & ~END != expected:
                return None  # a frame that comes twice is among these
            del self._begun[can_id]
        payload += data[:-1]
        is_late = now - since > TIMEOUT_NS
        if tail & END:
            if not is_late and crc_hqx(payload[2:], seed) == int.from_bytes(payload[:2], "little"):
                return payload[2:]
            self.errors += 1
        elif is_late or len(data) < 8 or len(payload) > MAX_PAYLOAD:
            self.errors += 1
        else:
            if len(self._begun) >= MAX_TRANSFERS:
                del self._begun[next(iter(self._begun))]
                self.errors += 1
            self._begun[can_id] = tail & TRANSFER_ID | ~tail & TOGGLE, since, payload
        return None
