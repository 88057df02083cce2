"""SYNC, consumer side (CiA 301, 7.2.5): objects 1005h COB-ID and 1019h counter overflow."""

from kontronik_can_gw.canopen.abort import Abort, SdoAbort
from kontronik_can_gw.canopen.cob_ids import SYNC, Taken, check_free
from kontronik_can_gw.canopen.dictionary import Dictionary

_PRODUCER_BIT, _FRAME_BIT = 1 << 30, 1 << 29


class SyncConsumer:
    """Which SYNC message a node follows."""

    def __init__(self, dictionary: Dictionary, taken: Taken) -> None:
        self._dictionary = dictionary
        self._taken = taken
        dictionary.bind(0x1005, check=self._check_cob_id)
        dictionary.bind(0x1019, check=_check_overflow)

    @property
    def cob_id(self) -> int:
        """11 bits of 1005h."""
        return self._dictionary.number(0x1005) & 0x7FF

    def counter(self, data: bytes) -> int | None:
        """The counter of a SYNC message, 0 where it has none.

        None if its length is not what 1019h says: 1 byte with a counter, else none.
        """
        if len(data) != (1 if self._dictionary.number(0x1019) else 0):
            return None
        return data[0] if data else 0

    def _check_cob_id(self, value: int) -> None:
        """A new 1005h. SdoAbort 06090030h for a producer (there is none), 29-bit ids, reserved bits and restricted ids."""
        if value & (_PRODUCER_BIT | _FRAME_BIT | 0x1FFFF800):
            raise SdoAbort(Abort.VALUE)
        check_free(value & 0x7FF, SYNC, self._taken)


def _check_overflow(value: int) -> None:
    """A new 1019h: 0 (no counter) or 2..240, else SdoAbort 06090030h."""
    if value == 1 or value > 240:
        raise SdoAbort(Abort.VALUE)
