"""The CAN frame as the pure core hands it out."""

from typing import NamedTuple


class CanFrame(NamedTuple):
    """A data frame: id (11 or 29 bit), data (0 to 8 bytes, CAN FD to 64).

    ``page`` tells frames of one id apart that do not stand for each other (multiplexer pages).
    """

    can_id: int
    data: bytes
    extended: bool = False
    fd: bool = False
    page: int = 0
