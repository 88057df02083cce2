"""SDO transfers of several requests, each a generator (CiA 301, 7.2.4.2.3 to 7.2.4.2.16).

A generator yields the answer to each request and is sent the next request. A refusal is raised as
``SdoAbort``. The generator returns the last answer, and before it the data of a download, or None
after an upload.
"""

from binascii import crc_hqx
from collections import deque
from collections.abc import Generator

from kontronik_can_gw.canopen.dictionary import Abort, SdoAbort

BLOCK_SIZE = 127
"""Segments of one sub-block of a block download: the maximum of the standard."""
IN_FLIGHT_NS = 50_000_000
"""Maximum distance of segments that the client sent before it saw the server's abort."""
Transfer = Generator[bytes, bytes, tuple[bytes | None, bytes]]

_SEGMENT_BYTES = 7
_TOGGLE = 0x10
_LAST_SEGMENT = 0x80


class SubBlock:
    """The open sub-block of a block download, and the segments in flight after it was ended early.

    Segments in flight were sent before the client saw the server's abort.
    """

    def __init__(self) -> None:
        self.next_segment: int | None = None
        """Number of the next segment, 0 after the last one. None if no sub-block is open."""
        self.is_in_sequence = True
        """False if the last segment did not have the next number."""
        self._in_flight = 0
        """Number of the next segment in flight. 0 if no more are expected."""
        self._until = 0

    def note_segment(self, now: int) -> None:
        """Note the time of a segment of the open sub-block."""
        self._until = now + IN_FLIGHT_NS

    def close(self) -> None:
        """End the sub-block because its transfer has ended."""
        if self.next_segment is not None:
            self._in_flight = self.next_segment
            self.next_segment = None

    def forget(self) -> None:
        """Expect no more segments in flight."""
        self._in_flight = 0

    def swallow(self, command: int, now: int) -> bool:
        """Return True for a segment in flight, which must be ignored."""
        if not self._in_flight:
            return False
        if command & 0x7F != self._in_flight or now > self._until:
            self._in_flight = 0
            return False
        is_last = command & _LAST_SEGMENT or self._in_flight == BLOCK_SIZE
        self._in_flight = 0 if is_last else self._in_flight + 1
        self._until = now + IN_FLIGHT_NS
        return True


def segmented_download(
    answer: bytes,
    size: int | None,
    limit: int,
) -> Transfer:
    """Receive segments: 000t nnnc, data (7). Answers: 001t 0000, 0 (7)."""
    data = bytearray()
    toggle = 0
    command = 0
    while not command & 1:
        request = yield answer
        command = request[0]
        _check_segment(command, 0, toggle)
        unused = command >> 1 & 7
        data += request[1 : 8 - unused]
        _check_limit(data, limit)
        answer = bytes((0x20 | toggle, 0, 0, 0, 0, 0, 0, 0))
        toggle ^= _TOGGLE
    _check_size(data, size)
    return bytes(data), answer


def segmented_upload(answer: bytes, data: bytes) -> Transfer:
    """Send segments. Requests: 011t xxxx, 0 (7). Answers: 000t nnnc, data (7)."""
    toggle = 0
    length = max(1, len(data))  # even without data, one segment is needed
    for start in range(0, length, _SEGMENT_BYTES):
        request = yield answer
        _check_segment(request[0], 3, toggle)
        end = start + _SEGMENT_BYTES
        segment = data[start:end]
        unused = _SEGMENT_BYTES - len(segment)
        is_last = end >= len(data)
        head = toggle | unused << 1 | is_last
        answer = bytes((head,)) + segment.ljust(_SEGMENT_BYTES, b"\0")
        toggle ^= _TOGGLE
    return None, answer


def block_download(
    answer: bytes,
    size: int | None,
    limit: int,
    with_crc: bool,
    sub_block: SubBlock,
) -> Transfer:
    """Receive segments in sequence. The client repeats all after the last accepted one.

    Segments: cnnn nnnn (c: last, n: number), data (7). Answer after the last segment of a
    sub-block: A2h, accepted, block size, 0 (5). End: 110n nnx1 (n: unused bytes of the last
    segment), CRC (2), 0 (5). Answer: A1h, 0 (7).
    """
    data = bytearray()
    accepted = 0
    is_complete = False
    sub_block.next_segment = 1
    while not is_complete:
        request = yield answer
        number = request[0] & 0x7F
        is_last = bool(request[0] & _LAST_SEGMENT)
        answer = b""
        sub_block.next_segment = number + 1 if number < BLOCK_SIZE else 0
        if not number:
            raise SdoAbort(Abort.SEQUENCE)
        sub_block.is_in_sequence = number == accepted + 1
        if sub_block.is_in_sequence:
            accepted = number
            data += request[1:]
            if not is_last:  # the end request holds the number of unused bytes of the last one
                _check_limit(data, limit)
        if is_last or number == BLOCK_SIZE:
            answer = bytes((0xA2, accepted, BLOCK_SIZE, 0, 0, 0, 0, 0))
            accepted = 0
            sub_block.next_segment = 1
            is_complete = is_last and sub_block.is_in_sequence
    sub_block.next_segment = None
    request = yield answer
    if request[0] & 0xE1 != 0xC1:
        raise SdoAbort(Abort.COMMAND)
    unused = request[0] >> 2 & 7
    del data[len(data) - unused :]
    _check_limit(data, limit)
    _check_size(data, size)  # before the CRC, which is always wrong over a wrong length
    if with_crc and crc_hqx(data, 0) != int.from_bytes(request[1:3], "little"):
        raise SdoAbort(Abort.CRC)
    return bytes(data), b"\xa1" + bytes(7)


def block_upload(
    answer: bytes,
    data: bytes,
    block_size: int,
    with_crc: bool,
    outgoing: deque[bytes],
) -> Transfer:
    """Send a sub-block at a time by putting it into ``outgoing``.

    A3h starts the upload. A2h, last segment received, next block size continues it. A1h ends it.
    A2h may arrive before the whole sub-block was sent, if the client saw a gap. End frame: 110n
    nn01 (n: unused bytes of the last segment), CRC (2), 0 (5).
    """
    # even without data, one segment is needed to mark the end
    count = max(1, -(-len(data) // _SEGMENT_BYTES))
    confirmed = 0
    request = yield answer
    _check_block_command(request, 3)
    while confirmed < count:
        in_sub_block = min(block_size, count - confirmed)
        outgoing += _segments(data, confirmed, in_sub_block, count)
        request = yield b""
        _check_block_command(request, 2)
        received = request[1]
        if received > in_sub_block - len(outgoing):
            raise SdoAbort(Abort.SEQUENCE)
        block_size = request[2]
        # also after the last segment: the standard limits the field to 1..127 without exception
        check_block_size(block_size)
        confirmed += received
        outgoing.clear()
    crc = crc_hqx(data, 0) if with_crc else 0
    unused = _SEGMENT_BYTES * count - len(data)
    head = 0xC1 | unused << 2
    end_frame = bytes((head,)) + crc.to_bytes(2, "little") + bytes(5)
    request = yield end_frame
    _check_block_command(request, 1)
    return None, b""


def _segments(
    data: bytes,
    confirmed: int,
    in_sub_block: int,
    count: int,
) -> list[bytes]:
    """Return the segments of a sub-block that begins after ``confirmed`` of ``count`` segments."""
    segments = []
    for number in range(1, in_sub_block + 1):
        end = _SEGMENT_BYTES * (confirmed + number)
        last = _LAST_SEGMENT if confirmed + number == count else 0
        content = data[end - _SEGMENT_BYTES : end].ljust(_SEGMENT_BYTES, b"\0")
        segments.append(bytes((last | number,)) + content)
    return segments


def check_block_size(block_size: int) -> None:
    """SdoAbort 05040002h unless the block size is 1..127."""
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
