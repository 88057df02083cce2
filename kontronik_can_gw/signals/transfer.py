"""A payload as one or several classic CAN frames with a 29-bit id (DroneCAN's transfers; specification, 4.1).

The last byte of each frame, the tail, says where it belongs: begin, end, a bit that toggles, the number of the transfer. What is
longer than a frame has a CRC-16/CCITT in front. Twin in C: make_transfer of native/core.c.
"""

from binascii import crc_hqx

from kontronik_can_gw.frames import CanFrame

START, END, TOGGLE, TRANSFER_ID = 0x80, 0x40, 0x20, 0x1F
"""Bits of a tail."""


def transfer(
    can_id: int, seed: int, payload: bytes, transfer_id: int, queued: bool = False, page: int = 0
) -> list[CanFrame]:
    """The frames. ``seed``: what the CRC begins with; ``queued`` as in CanFrame; ``page`` counts on from the first frame."""
    if len(payload) > 7:
        payload = crc_hqx(payload, seed).to_bytes(2, "little") + payload
    count = (len(payload) + 6) // 7 or 1
    frames = []
    for part in range(count):
        tail = START * (part == 0) | END * (part == count - 1) | TOGGLE * (part & 1) | transfer_id
        data = payload[7 * part : 7 * part + 7] + bytes((tail,))
        frames.append(CanFrame(can_id, data, True, page=page + part, queued=queued))
    return frames
