"""Ids and transfers on classic CAN (specification, 4.1): a payload becomes frames, frames become a payload.

A transfer is the payload of a message, a request or a response. Its frames have one id; the last byte of each says where it
belongs. Pure: ``now`` is integer nanoseconds.
"""

from binascii import crc_hqx
from typing import NamedTuple

from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.frames import CanFrame

LOW, LOWEST = 24, 31
"""Priorities, as autopilots and their peripherals use them: of measurements, of node states and texts."""
MAX_NODE_ID = 125
"""126 and 127 are those of tools."""
MAX_PAYLOAD, MAX_TRANSFERS, TIMEOUT_NS = 300, 32, 2 * SECOND
_SERVICE, _REQUEST = 0x80, 0x8000
_START, _END, _TOGGLE, _ID_MASK = 0x80, 0x40, 0x20, 0x1F
_BYTE = tuple(bytes((each,)) for each in range(256))


class DataType(NamedTuple):
    """A type of messages or of a service. ``seed``: the CRC of its signature, which that of a transfer begins with."""

    number: int
    seed: int


def data_type(number: int, signature: int) -> DataType:
    """The type with this id and data type signature."""
    return DataType(number, crc_hqx(signature.to_bytes(8, "little"), 0xFFFF))


def message_id(kind: DataType, source: int, priority: int) -> int:
    """The id of a node's messages of a type."""
    return priority << 24 | kind.number << 8 | source


def anonymous_id(kind: DataType, discriminator: int, priority: int) -> int:
    """The id of a message without a node; ``discriminator``: 14 random bits."""
    return priority << 24 | discriminator << 10 | (kind.number & 3) << 8


def response_id(request_id: int) -> int:
    """The id of the answer to a request: of its priority, from its destination to its source."""
    source, own = request_id & 0x7F, request_id >> 8 & 0x7F
    return request_id & 0x1FFF0000 | source << 8 | _SERVICE | own


class Header(NamedTuple):
    """What the id of a frame says. ``kind``: number of the message's or service's type; ``to``: node-ID, None: everybody."""

    source: int
    kind: int
    to: int | None = None
    is_request: bool = False


def header(can_id: int) -> Header:
    """What a 29-bit id means."""
    source = can_id & 0x7F
    if can_id & _SERVICE:
        return Header(source, can_id >> 16 & 0xFF, can_id >> 8 & 0x7F, bool(can_id & _REQUEST))
    return Header(source, can_id >> 8 & (0xFFFF if source else 3))


def transfer(
    can_id: int, seed: int, payload: bytes, transfer_id: int, queued: bool, page: int = 0
) -> list[CanFrame]:
    """The frames of a transfer. ``queued`` as in CanFrame; of others the first has this ``page``, the following ones count on."""
    tail, size = _START | transfer_id, len(payload)
    if size <= 7:
        data = payload + _BYTE[tail | _END]
        return [CanFrame(can_id, data, True, False, page, False, queued)]
    payload = crc_hqx(payload, seed).to_bytes(2, "little") + payload
    frames = []
    for at in range(0, size + 2, 7):
        if at + 7 >= size + 2:
            tail |= _END
        data = payload[at : at + 7] + _BYTE[tail]
        frames.append(CanFrame(can_id, data, True, False, page, False, queued))
        tail = tail & ~_START ^ _TOGGLE
        page += 1
    return frames


class Received(NamedTuple):
    """A transfer that is whole."""

    payload: bytes
    transfer_id: int


class _Begun:
    """A transfer of which frames are missing."""

    def __init__(self, data: bytes, now: int) -> None:
        self.transfer_id = data[-1] & _ID_MASK
        self.crc = int.from_bytes(data[:2], "little")
        self.payload = data[2:-1]
        self.toggle = _TOGGLE
        self.begun = now


class Assembler:
    """Puts transfers together, at most ``MAX_TRANSFERS`` at a time: the oldest gives way.

    Out of order, without an end within two seconds, too long or with a wrong CRC: dropped, and counted in ``errors``.
    """

    def __init__(self) -> None:
        self.errors = 0
        self._begun: dict[int, _Begun] = {}

    def receive(self, can_id: int, data: bytes, seed: int, now: int) -> Received | None:
        """The transfer that this frame completes. ``seed``: of its type."""
        if not data:
            return None
        tail = data[-1]
        transfer_id = tail & _ID_MASK
        if tail & _START:
            if self._begun.pop(can_id, None) is not None:
                self.errors += 1
            if tail & _TOGGLE:  # of another version of the protocol
                return None
            if tail & _END:
                return Received(data[:-1], transfer_id)
            if len(data) == 8:
                if len(self._begun) >= MAX_TRANSFERS:
                    del self._begun[next(iter(self._begun))]
                    self.errors += 1
                self._begun[can_id] = _Begun(data, now)
            return None
        return self._go_on(can_id, data, seed, now)

    def _go_on(self, can_id: int, data: bytes, seed: int, now: int) -> Received | None:
        begun, tail = self._begun.get(can_id), data[-1]
        if begun is None or tail & _ID_MASK != begun.transfer_id or tail & _TOGGLE != begun.toggle:
            return None  # a frame that comes twice is among these
        begun.payload += data[:-1]
        begun.toggle ^= _TOGGLE
        if tail & _END:
            del self._begun[can_id]
            if now - begun.begun <= TIMEOUT_NS and crc_hqx(begun.payload, seed) == begun.crc:
                return Received(begun.payload, begun.transfer_id)
            self.errors += 1
        elif len(begun.payload) > MAX_PAYLOAD or now - begun.begun > TIMEOUT_NS or len(data) < 8:
            del self._begun[can_id]
            self.errors += 1
        return None
