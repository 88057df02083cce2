"""Segmented SDO transfers, one object each (CiA 301, 7.2.4.2.3 to 7.2.4.2.8): segments in and out; refusals are ``SdoAbort``."""

from kontronik_can_gw.canopen.abort import Abort, SdoAbort

_TOGGLE = 0x10


class Incoming:
    """The data of a download. ``size``: as the client indicated, or None; more than ``limit`` bytes are refused."""

    def __init__(self, size: int | None, limit: int) -> None:
        self.data = bytearray()
        self._size = size
        self._limit = limit

    def check_limit(self) -> None:
        if len(self.data) > self._limit:
            raise SdoAbort(Abort.TOO_LONG)

    def whole(self) -> bytes:
        """All data, its length checked."""
        self.check_limit()
        if self._size is not None and len(self.data) < self._size:
            raise SdoAbort(Abort.TOO_SHORT)
        return bytes(self.data)


class SegmentedDownload:
    """The segments of one download."""

    def __init__(self, incoming: Incoming) -> None:
        self.complete = False
        """The last segment is here."""
        self._incoming = incoming
        self._toggle = 0

    def take(self, data: bytes) -> bytes:
        """000t nnnc, data (7). Answer: 001t 0000, 0 (7)."""
        command = data[0]
        if command & _TOGGLE != self._toggle:
            raise SdoAbort(Abort.TOGGLE)
        self._incoming.data += data[1 : 8 - (command >> 1 & 7)]
        self._incoming.check_limit()
        answer = bytes((0x20 | self._toggle, 0, 0, 0, 0, 0, 0, 0))
        self._toggle ^= _TOGGLE
        self.complete = bool(command & 1)
        return answer

    def whole(self) -> bytes:
        """All data, its length checked."""
        return self._incoming.whole()


class SegmentedUpload:
    """The segments of one value."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._offset = 0
        self._toggle = 0

    @property
    def complete(self) -> bool:
        """The last segment was given."""
        return bool(self._offset) and self._offset >= len(self._data)

    def give(self, command: int) -> bytes:
        """011t xxxx, 0 (7). Answer: 000t nnnc, data (7)."""
        if command & _TOGGLE != self._toggle:
            raise SdoAbort(Abort.TOGGLE)
        segment = self._data[self._offset : self._offset + 7]
        self._offset += 7
        head = self._toggle | (7 - len(segment)) << 1 | self.complete
        self._toggle ^= _TOGGLE
        return bytes((head,)) + segment.ljust(7, b"\0")
