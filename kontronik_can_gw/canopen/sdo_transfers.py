"""SDO transfers, one object each (CiA 301, 7.2.4.2.3 to 7.2.4.2.16): segments in and out; refusals are ``SdoAbort``."""

from binascii import crc_hqx
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto

from kontronik_can_gw.canopen.abort import Abort, SdoAbort

BLOCK_SIZE = 127
"""Segments of one sub-block of a block download, the most there can be."""
BURST = 4
"""Paced block upload segments sent without a pause."""
IN_FLIGHT_NS = 50_000_000
"""Segments sent before the client saw our abort follow one another more closely than this."""

_TOGGLE = 0x10
_LAST_SEGMENT = 0x80


class Download:
    """What comes in. ``size``: as the client indicated, or None; more than ``limit`` bytes are refused."""

    def __init__(self, size: int | None, limit: int) -> None:
        self.complete = False
        """The last segment is here."""
        self._data = bytearray()
        self._size = size
        self._limit = limit

    def _check_limit(self) -> None:
        if len(self._data) > self._limit:
            raise SdoAbort(Abort.TOO_LONG)

    def whole(self) -> bytes:
        """All data, its length checked."""
        self._check_limit()
        if self._size is not None and len(self._data) < self._size:
            raise SdoAbort(Abort.TOO_SHORT)
        return bytes(self._data)


class SegmentedDownload(Download):
    """Each segment is confirmed."""

    _toggle = 0

    def take(self, data: bytes) -> bytes:
        """000t nnnc, data (7). Answer: 001t 0000, 0 (7)."""
        command = data[0]
        if command & _TOGGLE != self._toggle:
            raise SdoAbort(Abort.TOGGLE)
        self._data += data[1 : 8 - (command >> 1 & 7)]
        self._check_limit()
        answer = bytes((0x20 | self._toggle, 0, 0, 0, 0, 0, 0, 0))
        self._toggle ^= _TOGGLE
        self.complete = bool(command & 1)
        return answer


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


class BlockDownload(Download):
    """Only segments in sequence are taken; the client repeats what follows the last accepted one. The end request comes after the last."""

    def __init__(self, size: int | None, limit: int, with_crc: bool) -> None:
        super().__init__(size, limit)
        self._with_crc = with_crc
        # number of the last segment in sequence and of the last one seen
        self._accepted = self._seen = 0

    @property
    def next_segment(self) -> int:
        """Number of the segment that follows in this sub-block, 0: none."""
        return self._seen + 1 if self._seen < BLOCK_SIZE else 0

    def take(self, data: bytes) -> bytes | None:
        """cnnn nnnn (c: last, n: number), data (7). Answer after the last one of a sub-block: A2h, accepted, block size, 0 (5)."""
        number = data[0] & 0x7F
        last = data[0] & _LAST_SEGMENT
        self._seen = number
        if not number:
            raise SdoAbort(Abort.SEQUENCE)
        taken = number == self._accepted + 1
        if taken:
            self._accepted = number
            self._data += data[1:]
            # how many bytes of the last segment count is not known before the end request
            if not last:
                self._check_limit()
        if not last and number < BLOCK_SIZE:
            return None
        answer = bytes((0xA2, self._accepted, BLOCK_SIZE, 0, 0, 0, 0, 0))
        self._accepted = self._seen = 0
        self.complete = bool(last) and taken
        return answer

    def end(self, data: bytes) -> bytes:
        """110n nnx1 (n: bytes of the last segment that are none), CRC (2), 0 (5). Returns the whole data."""
        del self._data[len(self._data) - (data[0] >> 2 & 7) :]
        whole = self.whole()  # before the CRC, which over a wrong length is wrong anyway
        if self._with_crc and crc_hqx(whole, 0) != int.from_bytes(data[1:3], "little"):
            raise SdoAbort(Abort.CRC)
        return whole


class InFlight:
    """Segments that the client sent before it saw that we had cut its sub-block short."""

    def __init__(self) -> None:
        self._next = 0  # number of the next one, 0: none
        self._until = 0

    def segment_seen(self, now: int) -> None:
        self._until = now + IN_FLIGHT_NS

    def expect(self, number: int) -> None:
        """A sub-block was cut short before this segment; 0: none is in flight."""
        self._next = number

    def swallow(self, command: int, now: int) -> bool:
        """True for such a segment."""
        if not self._next:
            return False
        if command & 0x7F != self._next or now > self._until:
            self._next = 0
            return False
        done = command & _LAST_SEGMENT or self._next == BLOCK_SIZE
        self._next = 0 if done else self._next + 1
        self._until = now + IN_FLIGHT_NS
        return True


class _Phase(Enum):
    START = auto()
    SENDING = auto()
    END = auto()


@dataclass(slots=True)
class Pace:
    """Of all block uploads of a server: one that begins anew has not more of the bus."""

    segment_ns: int
    """Distance that segments keep on average, 0: none."""
    next_burst: int = 0
    """When more of a sub-block may be sent."""


class BlockUpload:
    """The segments of one value, a sub-block at a time."""

    def __init__(
        self,
        data: bytes,
        block_size: int,
        with_crc: bool,
        pace: Pace,
        send: Callable[[bytes], None],
    ) -> None:
        self._data = data
        self._with_crc = with_crc
        self._pace = pace
        self._send = send
        self._phase = _Phase.START
        # in segments: of the whole, confirmed, of this sub-block, of this sub-block sent
        # no bytes still need one segment to say that it is the last
        self._segments = max(1, -(-len(data) // 7))
        self._confirmed = 0
        self._sub_block = min(block_size, self._segments)
        self._sent = 0

    @property
    def bursts(self) -> bool:
        """Whether ``advance`` sends more of a sub-block; False: it is out, or none was asked for."""
        return self._phase is _Phase.SENDING and self._sent < self._sub_block

    def start(self, now: int) -> None:
        """1010 0011, 0 (7). Answer: the first sub-block."""
        self._expect(_Phase.START)
        self._phase = _Phase.SENDING
        self.advance(now)

    def acknowledge(self, accepted: int, block_size: int, now: int) -> None:
        """1010 0010, last segment received, next block size, 0 (5). Answer: the next sub-block, or the end frame.

        It may come before the sub-block is out, when the client saw a gap. End frame: 110n nn01 (n: bytes of the last segment
        that are none), CRC (2), 0 (5).
        """
        self._expect(_Phase.SENDING)
        if accepted > self._sent:
            raise SdoAbort(Abort.SEQUENCE)
        # also after the last segment, where no block follows: the field is bound to 1..127 without exception
        check_block_size(block_size)
        self._confirmed += accepted
        if self._confirmed < self._segments:
            self._sub_block = min(block_size, self._segments - self._confirmed)
            self._sent = 0
            self.advance(now)
            return
        unused = 7 * self._segments - len(self._data)
        crc = crc_hqx(self._data, 0) if self._with_crc else 0
        self._phase = _Phase.END
        self._send(bytes((0xC1 | (unused << 2),)) + crc.to_bytes(2, "little") + bytes(5))

    def end(self) -> None:
        """1010 0001, 0 (7). No answer."""
        self._expect(_Phase.END)

    def advance(self, now: int) -> None:
        """Send of a sub-block what its time has come for."""
        if now < self._pace.next_burst:
            return
        count = self._sub_block - self._sent
        if self._pace.segment_ns:
            count = min(count, BURST)
        for _ in range(count):
            at = self._confirmed + self._sent
            self._sent += 1
            last = _LAST_SEGMENT if at + 1 == self._segments else 0
            segment = self._data[7 * at : 7 * at + 7].ljust(7, b"\0")
            self._send(bytes((last | self._sent,)) + segment)
        self._pace.next_burst = now + count * self._pace.segment_ns

    def _expect(self, phase: _Phase) -> None:
        if self._phase is not phase:
            raise SdoAbort(Abort.COMMAND)


def check_block_size(block_size: int) -> None:
    """1..127, else 05040002h."""
    if not 1 <= block_size <= 127:
        raise SdoAbort(Abort.BLOCK_SIZE)
