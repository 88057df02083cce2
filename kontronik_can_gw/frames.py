"""The CAN frame as the pure core receives it and hands it out.

What follows each telemetry frame is made as an image instead: the bytes of SocketCAN's struct can_frame, which cost a quarter of a CanFrame
and go to the socket as they are. Among the frames of one turn an image is the only one with its id.
"""

import struct
import sys
from typing import NamedTuple

EXTENDED = 0x80000000
"""Marks a 29-bit id where ids of both lengths are numbers in one set, as SocketCAN does."""


class CanFrame(NamedTuple):
    """A frame: id (11 or 29 bit), data (0 to 8 bytes, CAN FD to 64).

    ``page`` tells frames of one id apart that do not stand for each other (multiplexer pages). ``remote``: a remote frame (RTR), its
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


_IMAGE = struct.Struct("=IB3x8s")
IMAGE = struct.Struct("<IB3xQ")
"""An image from ``image_id``, length, and the frame's bits as a number (bit 0 is bit 0 of byte 0)."""


def image_id(can_id: int, extended: bool) -> int:
    """The id as the first number of ``IMAGE``."""
    return int.from_bytes((can_id | (EXTENDED if extended else 0)).to_bytes(4, sys.byteorder), "little")


def frame_of(frame: CanFrame | bytes) -> CanFrame:
    """A frame or the image of one as a frame."""
    if isinstance(frame, CanFrame):
        return frame
    key, length, data = _IMAGE.unpack(frame)
    return CanFrame(key & ~EXTENDED, data[:length], bool(key & EXTENDED))
