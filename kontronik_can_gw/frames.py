"""The CAN frame as the pure core receives it and hands it out, and ids as numbers in sets."""

from collections.abc import Iterable
from typing import NamedTuple

EXTENDED = 0x80000000
"""Marks a 29-bit id where ids of both lengths are numbers in one set, as SocketCAN does."""
MAX_EXTENDED_ID = 0x1FFFFFFF
FIRST_PART, PARTS = 64, 3
_KEY = 0xFFFFFFFF


def id_block(can_id: int, mask: int) -> int:
    """All 29-bit ids that agree with ``can_id`` in the bits of ``mask``, as one number among keys.

    The bits that are free stand above bit 31.
    """
    return (~mask & MAX_EXTENDED_ID) << 32 | EXTENDED | can_id & mask


def id_and_mask(key: int) -> tuple[int, int]:
    """Key (bit 31: 29 bits) and mask of a key or block; all bits of a key count."""
    return key & _KEY, _KEY & ~(key >> 32)


def block_of(key: int, keys: Iterable[int]) -> int | None:
    """The first block among ``keys`` that holds a key."""
    for each in keys:
        if each > _KEY and not (key ^ each) & _KEY & ~(each >> 32):
            return each
    return None


def ids_in_words(key: int) -> str:
    """A key, or the ids of a block, for people."""
    can_id, mask = (each & MAX_EXTENDED_ID for each in id_and_mask(key))
    if mask != MAX_EXTENDED_ID:
        return f"29-bit ids with {can_id:X}h in their bits {mask:X}h"
    return f"{'29-bit id' if key & EXTENDED else 'id'} {can_id:X}h"


class CanFrame(NamedTuple):
    """A frame: id (11 or 29 bit), data (0 to 8 bytes, CAN FD to 64).

    ``page`` separates frames of one id that do not replace each other (multiplexer pages). ``remote``: a remote frame (RTR), its
    data only says how much is asked for. ``queued``: it is sent in order and never replaced (answers of SDO, LSS and NMT, EMCY);
    where False the newest frame of an id is the one that is sent. From page ``FIRST_PART`` on ``PARTS`` pages each are the frames of
    one transfer, which replace older ones together or not at all.
    """

    can_id: int
    data: bytes
    extended: bool = False
    fd: bool = False
    page: int = 0
    remote: bool = False
    queued: bool = False

    @property
    def key(self) -> int:
        """The id, with ``EXTENDED`` if it has 29 bits."""
        return self.can_id | EXTENDED if self.extended else self.can_id
