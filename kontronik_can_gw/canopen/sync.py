"""SYNC, consumer side (CiA 301, 7.2.5; objects 1005h and 1019h)."""

from kontronik_can_gw.canopen.abort import Abort, SdoAbort

PRODUCER_BIT, FRAME_BIT = 1 << 30, 1 << 29


def check_cob_id(value: int, restricted: bool) -> None:
    """A new 1005h. SdoAbort 06090030h for a producer (there is none), 29-bit ids, reserved bits and restricted ids."""
    if value & (PRODUCER_BIT | FRAME_BIT) or value & 0x1FFFF800 or restricted:
        raise SdoAbort(Abort.VALUE)


def check_overflow(value: int) -> None:
    """A new 1019h: 0 (no counter) or 2..240, else SdoAbort 06090030h."""
    if value == 1 or value > 240:
        raise SdoAbort(Abort.VALUE)


def counter(data: bytes, overflow: int) -> int | None:
    """The counter of a SYNC message, 0 where it has none. None if its length is not what 1019h says: 1 byte with a counter, else none."""
    if len(data) != (1 if overflow else 0):
        return None
    return data[0] if data else 0
