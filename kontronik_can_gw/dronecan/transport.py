"""Ids and received transfers (specification, 4.1): a transfer is the payload of a message, a request or a response. Pure."""

from binascii import crc_hqx

from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.signals.transfer import END, START, TOGGLE, TRANSFER_ID

LOW, LOWEST = 24, 31
"""Priorities, as autopilots and their peripherals use them: of measurements, of node states and texts."""
MAX_NODE_ID = 125
"""126 and 127 are those of tools."""
SERVICE, REQUEST, NODE = 0x80, 0x8000, 0x7F
"""Bits of an id: it is a service's, it is a request; the source."""
MAX_PAYLOAD, MAX_TRANSFERS, TIMEOUT_NS = 300, 32, 2 * SECOND


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
