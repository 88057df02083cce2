"""SDO transfers of several requests (CiA 301, 7.2.4.2.3 to 7.2.4.2.16), each a generator; refusals are ``SdoAbort``.

It yields the answer to each request and is sent the next one. What it returns: the data of a download, None after an upload, and the
last answer.
"""

from binascii import crc_hqx
from collections import deque
from collections.abc import Generator

from kontronik_can_gw.canopen.dictionary import Abort, SdoAbort

BLOCK_SIZE = 127
"""Segments of one sub-block of a block download, the most there can be."""
IN_FLIGHT_NS = 50_000_000
"""Segments sent before the client saw our abort follow one another more closely than this."""
Transfer = Generator[bytes, bytes, tuple[bytes | None, bytes]]

_TOGGLE = 0x10
_LAST_SEGMENT = 0x80


class SubBlock:
    """The sub-block of a block download that is open, and segments in flight: sent before the client saw that one was cut short."""

    def __init__(self) -> None:
        self.next_segment: int | None = None
        """Number of the segment that follows, 0: none; None: no sub-block is open."""
        self.is_in_sequence = True
        """False if the last segment was not the one that had to follow."""
        self._in_flight = 0  # number of the next one, 0: none
        self._until = 0

    def seen(self, now: int) -> None:
        """Notes the time of a segment of the open sub-block."""
        self._until = now + IN_FLIGHT_NS

    def close(self) -> None:
        """The transfer is over."""
        if self.next_segment is not None:
            self._in_flight, self.next_segment = self.next_segment, None

    def forget(self) -> None:
        """The client sends no more segments."""
        self._in_flight = 0

    def swallow(self, command: int, now: int) -> bool:
        """True for a segment in flight."""
        if not self._in_flight:
            return False
        if command & 0x7F != self._in_flight or now > self._until:
            self._in_flight = 0
            return False
        done = command & _LAST_SEGMENT or self._in_flight == BLOCK_SIZE
        self._in_flight = 0 if done else self._in_flight + 1
        self._until = now + IN_FLIGHT_NS
        return True


def segmented_download(answer: bytes, size: int | None, limit: int) -> Transfer:
    """Segments: 000t nnnc, data (7). Answers: 001t 0000, 0 (7)."""
    data, toggle, command = bytearray(), 0, 0
    while not command & 1:
        request = yield answer
        command = request[0]
        _check_segment(command, 0, toggle)
        data += request[1 : 8 - (command >> 1 & 7)]
        _check_limit(data, limit)
        answer = bytes((0x20 | toggle, 0, 0, 0, 0, 0, 0, 0))
        toggle ^= _TOGGLE
    _check_size(data, size)
    return bytes(data), answer


def segmented_upload(answer: bytes, data: bytes) -> Transfer:
    """Requests: 011t xxxx, 0 (7). Answers: 000t nnnc, data (7)."""
    toggle = 0
    for at in range(0, max(1, len(data)), 7):
        request = yield answer
        _check_segment(request[0], 3, toggle)
        segment = data[at : at + 7]
        head = toggle | (7 - len(segment)) << 1 | (at + 7 >= len(data))
        answer = bytes((head,)) + segment.ljust(7, b"\0")
        toggle ^= _TOGGLE
    return None, answer


def block_download(
    answer: bytes, size: int | None, limit: int, with_crc: bool, sub_block: SubBlock
) -> Transfer:
    """Only segments in sequence are taken; the client repeats what follows the last accepted one.

    Segments: cnnn nnnn (c: last, n: number), data (7). Answer after the last one of a sub-block: A2h, accepted, block size, 0 (5).
    End: 110n nnx1 (n: bytes of the last segment that are none), CRC (2), 0 (5). Answer: A1h, 0 (7).
    """
    data, accepted, complete = bytearray(), 0, False
    sub_block.next_segment = 1
    while not complete:
        request = yield answer
        number, last, answer = request[0] & 0x7F, request[0] & _LAST_SEGMENT, b""
        sub_block.next_segment = number + 1 if number < BLOCK_SIZE else 0
        if not number:
            raise SdoAbort(Abort.SEQUENCE)
        sub_block.is_in_sequence = number == accepted + 1
        if sub_block.is_in_sequence:
            accepted = number
            data += request[1:]
            if not last:  # how many bytes of the last segment count is in the end request
                _check_limit(data, limit)
        if last or number == BLOCK_SIZE:
            answer = bytes((0xA2, accepted, BLOCK_SIZE, 0, 0, 0, 0, 0))
            accepted, sub_block.next_segment = 0, 1
            complete = bool(last) and sub_block.is_in_sequence
    sub_block.next_segment = None
    request = yield answer
    if request[0] & 0xE1 != 0xC1:
        raise SdoAbort(Abort.COMMAND)
    del data[len(data) - (request[0] >> 2 & 7) :]
    _check_limit(data, limit)
    _check_size(data, size)  # before the CRC, which over a wrong length is wrong anyway
    if with_crc and crc_hqx(data, 0) != int.from_bytes(request[1:3], "little"):
        raise SdoAbort(Abort.CRC)
    return bytes(data), b"\xa1" + bytes(7)


def block_upload(
    answer: bytes, data: bytes, block_size: int, with_crc: bool, outgoing: deque[bytes]
) -> Transfer:
    """A sub-block at a time is put into ``outgoing``. A3h starts; A2h, last segment received, next block size goes on; A1h ends.

    A2h may come before the sub-block is out, when the client saw a gap. End frame: 110n nn01 (n: bytes of the last segment that are
    none), CRC (2), 0 (5).
    """
    # no bytes still need one segment to say that it is the last
    count, confirmed = max(1, -(-len(data) // 7)), 0
    _check_block_command((yield answer), 3)
    while confirmed < count:
        numbers = range(1, min(block_size, count - confirmed) + 1)
        for number in numbers:
            at = confirmed + number
            last = _LAST_SEGMENT if at == count else 0
            segment = data[7 * at - 7 : 7 * at].ljust(7, b"\0")
            outgoing.append(bytes((last | number,)) + segment)
        request = yield b""
        _check_block_command(request, 2)
        if request[1] > len(numbers) - len(outgoing):
            raise SdoAbort(Abort.SEQUENCE)
        block_size = request[2]
        # also after the last segment, where no block follows: the field is bound to 1..127 without exception
        check_block_size(block_size)
        confirmed += request[1]
        outgoing.clear()
    crc = crc_hqx(data, 0) if with_crc else 0
    head = 0xC1 | 7 * count - len(data) << 2
    _check_block_command((yield bytes((head,)) + crc.to_bytes(2, "little") + bytes(5)), 1)
    return None, b""


def check_block_size(block_size: int) -> None:
    """1..127, else 05040002h."""
    if not 1 <= block_size <= 127:
        raise SdoAbort(Abort.BLOCK_SIZE)


def _check_segment(command: int, specifier: int, toggle: int) -> None:
    if command >> 5 != specifier:
        raise SdoAbort(Abort.COMMAND)
    if command & _TOGGLE != toggle:
        raise SdoAbort(Abort.TOGGLE)


def _check_block_command(request: bytes, subcommand: int) -> None:
    if request[0] >> 5 != 5 or request[0] & 3 != subcommand:
        raise SdoAbort(Abort.COMMAND)


def _check_limit(data: bytes | bytearray, limit: int) -> None:
    if len(data) > limit:
        raise SdoAbort(Abort.TOO_LONG)


def _check_size(data: bytes | bytearray, indicated: int | None) -> None:
    if indicated is not None and len(data) < indicated:
        raise SdoAbort(Abort.TOO_SHORT)
