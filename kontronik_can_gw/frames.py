"""The CAN frame as the pure core receives it and hands it out."""

from typing import NamedTuple

EXTENDED = 0x80000000
"""Marks a 29-bit id where ids of both lengths are numbers in one set, as SocketCAN does."""


class CanFrame(NamedTuple):
    """A frame: id (11 or 29 bit), data (0 to 8 bytes, CAN FD to 64).

    ``page`` separates frames of one id that do not replace each other (multiplexer pages). ``remote``: a remote frame (RTR), its
    data only says how much is asked for. ``queued``: it is sent in order and never replaced (answers of SDO, LSS and NMT, EMCY);
    where False the newest frame of an id is the one that is sent.
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
