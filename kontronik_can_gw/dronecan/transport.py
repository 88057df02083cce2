"""Ids and transfers on classic CAN (specification, 4.1): a payload becomes frames, frames become a payload.

A transfer is the payload of a message, a request or a response. Its frames have one id; the last byte of each, the tail, says
where it belongs. Pure: ``now`` is integer nanoseconds.
"""

from binascii import crc_hqx
from functools import cache

from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.frames import CanFrame

LOW, LOWEST = 24, 31
"""Priorities, as autopilots and their peripherals use them: of measurements, of node states and texts."""
MAX_NODE_ID = 125
"""126 and 127 are those of tools."""
SERVICE, REQUEST, NODE = 0x80, 0x8000, 0x7F
"""Bits of an id: it is a service's, it is a request; the source."""
TRANSFER_ID = 0x1F
"""Bits of a tail."""
MAX_PAYLOAD, MAX_TRANSFERS, TIMEOUT_NS = 300, 32, 2 * SECOND
_START, _END, _TOGGLE = 0x80, 0x40, 0x20
_frame = (
    tuple.__new__
)  # without the detour of a named tuple's own: three frames for each esc.Status


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


def transfer(
    can_id: int, seed: int, payload: bytes, transfer_id: int, queued: bool, page: int = 0
) -> list[CanFrame]:
    """The frames of a transfer. ``seed``: of its type; ``queued`` as in CanFrame; of others ``page`` counts on from the first."""
    if len(payload) > 7:
        payload = crc_hqx(payload, seed).to_bytes(2, "little") + payload
    frames, at = [], 0
    for tail in _tails(transfer_id, (len(payload) + 6) // 7 or 1):
        data = payload[at : at + 7] + tail
        frames.append(_frame(CanFrame, (can_id, data, True, False, page, False, queued)))
        at += 7
        page += 1
    return frames


@cache
def _tails(transfer_id: int, count: int) -> tuple[bytes, ...]:
    """The last bytes of ``count`` frames."""
    tails = [transfer_id | n % 2 * _TOGGLE for n in range(count)]
    tails[0] |= _START
    tails[-1] |= _END
    return tuple(bytes((tail,)) for tail in tails)


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
        if tail & _START:
            self.errors += self._begun.pop(can_id, None) is not None
            if tail & _TOGGLE:  # of another version of the protocol
                return None
            if tail & _END:
                return data[:-1]
        else:
            expected, since, payload = self._begun.get(can_id, (-1, now, b""))
            if tail & ~_END != expected:
                return None  # a frame that comes twice is among these
            del self._begun[can_id]
        payload += data[:-1]
        is_late = now - since > TIMEOUT_NS
        if tail & _END:
            if not is_late and crc_hqx(payload[2:], seed) == int.from_bytes(payload[:2], "little"):
                return payload[2:]
            self.errors += 1
        elif is_late or len(data) < 8 or len(payload) > MAX_PAYLOAD:
            self.errors += 1
        else:
            if len(self._begun) >= MAX_TRANSFERS:
                del self._begun[next(iter(self._begun))]
                self.errors += 1
            self._begun[can_id] = tail & TRANSFER_ID | ~tail & _TOGGLE, since, payload
        return None
