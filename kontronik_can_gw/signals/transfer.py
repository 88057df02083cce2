"""Splits a payload into classic CAN frames with a 29-bit id: DroneCAN's transfers (4.1).

The last byte of each frame, its tail, has bits for start and end of the transfer, a bit that
toggles, and the number of the transfer. A payload longer than one frame begins with its
CRC-16/CCITT. Twin in C: make_transfer of native/core.c.
"""

from binascii import crc_hqx

from kontronik_can_gw.frames import CanFrame

START = 0x80
END = 0x40
TOGGLE = 0x20
TRANSFER_ID = 0x1F
"""Bits of a tail. The last is the mask of the transfer's number."""
_BYTES_PER_FRAME = 7


def transfer(
    can_id: int,
    seed: int,
    payload: bytes,
    transfer_id: int,
    queued: bool = False,
    page: int = 0,
) -> list[CanFrame]:
    """Return the frames of a transfer.

    ``seed`` is the start value of the CRC. ``queued`` is as in CanFrame. ``page`` is the group of
    the first frame; each further frame has the next group.
    """
    if len(payload) > _BYTES_PER_FRAME:
        payload = crc_hqx(payload, seed).to_bytes(2, "little") + payload
    frames = []
    last = max(len(payload) - 1, 0) // _BYTES_PER_FRAME
    for part in range(last + 1):
        tail = transfer_id
        if part == 0:
            tail |= START
        if part == last:
            tail |= END
        if part % 2 == 1:
            tail |= TOGGLE
        begin = part * _BYTES_PER_FRAME
        data = payload[begin : begin + _BYTES_PER_FRAME] + bytes([tail])
        frames.append(CanFrame(can_id, data, True, page=page + part, queued=queued))
    return frames
