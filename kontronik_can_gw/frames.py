"""The CAN frame of the core, and CAN ids as numbers."""

from collections.abc import Iterable
from typing import NamedTuple

EXTENDED = 0x80000000
"""Marks a 29-bit id among ids of both lengths, as SocketCAN does. Such a number is called a key."""
MAX_EXTENDED_ID = 0x1FFFFFFF
FIRST_PART = 64
PARTS = 3
_KEY = 0xFFFFFFFF


def id_block(can_id: int, mask: int) -> int:
    """Return a number that stands for all 29-bit ids equal to ``can_id`` in the bits of ``mask``.

    Such a block can be in one set with keys: its free bits are above bit 31.
    """
    return (~mask & MAX_EXTENDED_ID) << 32 | EXTENDED | can_id & mask


def id_and_mask(key: int) -> tuple[int, int]:
    """Return id (bit 31 marks 29 bits) and mask of a key or a block. The mask of a key is full."""
    return key & _KEY, _KEY & ~(key >> 32)


def block_of(key: int, keys: Iterable[int]) -> int | None:
    """Return the first block among ``keys`` that contains a key, or None."""
    for each in keys:
        if each > _KEY and not (key ^ each) & _KEY & ~(each >> 32):
            return each
    return None


def ids_in_words(key: int) -> str:
    """Return a text for the id of a key or the ids of a block."""
    can_id, mask = (each & MAX_EXTENDED_ID for each in id_and_mask(key))
    if mask != MAX_EXTENDED_ID:
        return f"29-bit ids with {can_id:X}h in their bits {mask:X}h"
    return f"{'29-bit id' if key & EXTENDED else 'id'} {can_id:X}h"


class CanFrame(NamedTuple):
    """A CAN frame that was received or is to be sent.

    A newer frame replaces a waiting one with the same id and page, unless it is ``queued``.
    """

    can_id: int
    """11 or 29 bits."""
    data: bytes
    """0 to 8 bytes, or up to 64 with ``fd``."""
    extended: bool = False
    """True if the id has 29 bits."""
    fd: bool = False
    """True for a CAN FD frame."""
    page: int = 0
    """Separates frames of one id that do not replace each other, for example multiplexer pages.

    From page ``FIRST_PART``, each ``PARTS`` pages are the frames of one transfer. They replace
    older ones together or not at all.
    """
    remote: bool = False
    """True for a remote frame (RTR). The length of its data is the requested length."""
    queued: bool = False
    """True if it is sent in order and never replaced: answers of SDO, LSS and NMT, emergencies."""

    @property
    def key(self) -> int:
        """The id, with ``EXTENDED`` if it has 29 bits."""
        return self.can_id | EXTENDED if self.extended else self.can_id
