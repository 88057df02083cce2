"""The capture file (.kcap): data from the ESCs and the bus, with times. Pure.

A file is a sequence of blocks. Each block is written at once and can be read without the others: a
power loss destroys only the last block, and damage destroys only the blocks that it hits. All
numbers are little-endian. A block::

    4 bytes  "KCB1"
    u8       kind: "H" header (JSON), "I" information (JSON, adds to the header), "D" data,
             "E" end (empty: the file was closed properly)
    u8       1: the payload is deflated (zlib)
    u16      0
    u32      length of the payload as stored
    u32      length of the payload when inflated
    u32      number of the block in this file, from 0
    u32      CRC-32 (zlib) of the 20 bytes above and the payload as stored
    payload

A file begins with a header block. It is repeated after the first data in case the first one is
damaged. The payload of a data block is a table, followed by the data of its entries::

    u32      number of entries
    entries  16 bytes each: u64 time in ns of the recording machine's monotonic clock,
             u8 kind (``EntryKind``), u8 flags, u16 index of the ESC, u32 length of its data

Since version 2 the data of BYTES and FRAME begin with a u64 time on the clock of the entry. For
BYTES it is a time before any of the bytes arrived, for FRAME the arrival of the CAN frame. Version
1 does not have it, so the time of the entry is used.

Information blocks hold facts that become known later: the ``devices`` of the ESCs, and the
``events`` for which a capture was recorded (runtime/files/event_recorder.py). Readers ignore keys
that they do not know.

Times do not decrease. The entries are all calls to the gateway's core, in order. Their replay gives
each CAN frame that was sent, at its time.
"""

import json
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from kontronik_can_gw.entry_kinds import EntryKind as EntryKind
from kontronik_can_gw.frames import EXTENDED, CanFrame
from kontronik_can_gw.status import COUNTERS
from kontronik_can_gw.times import SECOND

SUFFIX = ".kcap"
MAGIC = b"KCB1"
FORMAT = "kontronik-can-gw capture"
VERSION = 2
VERSIONS = (1, 2)
"""Versions that can be read."""
LARGEST_PAYLOAD = 1 << 23
_PATIENCE = 1 << 28
"""Budget of bytes that the checks of false blocks may cost. Each check adds 64 to it."""
_HEAD = struct.Struct("<4scBHIII")
_CRC = struct.Struct("<I")
HEAD_LENGTH = _HEAD.size + _CRC.size
_ENTRY = struct.Struct("<QBBHI")
_COUNT = struct.Struct("<I")
_FRAME = struct.Struct("<IB")
_FD = 1
_REMOTE = 2
_NUMBER = struct.Struct("<Q")

_WITH_ARRIVAL = frozenset({EntryKind.BYTES, EntryKind.FRAME})


CLOCK_FLAGS: Mapping[bool | None, int] = {None: 0, True: 1, False: 2}
"""Flags of a CLOCK entry, for a clock that is synchronised, not synchronised, or unknown."""


SETTLE_NS = 10 * SECOND
"""After this time, a replay without the beginning of its run has the state of the live run.

ESCs send info data every five seconds or more often. Messages with several pages send each of them.
"""


class Entry(NamedTuple):
    """One entry. Its times are on the recording machine's monotonic clock."""

    time_ns: int
    kind: int
    esc: int = 0
    data: bytes = b""
    flags: int = 0
    came_ns: int | None = None
    """For BYTES a time before any of them arrived, for FRAME its arrival.

    If it is None, ``time_ns`` is used.
    """


class Block(NamedTuple):
    """A block whose CRC is correct."""

    kind: bytes
    number: int
    payload: bytes
    """The inflated payload."""
    offset: int
    """Position of the block in the file."""


class Damage(NamedTuple):
    """Bytes that do not belong to an intact block."""

    offset: int
    length: int


def event_in_words(esc: str, reason: str) -> str:
    """Return an event of an information block as text. ``esc`` may be empty."""
    return f"{esc}: {reason}" if esc else reason


class Packed(NamedTuple):
    """The payload of a block as it is stored."""

    is_deflated: bool
    stored: bytes
    size: int
    """Length of the payload when inflated."""


def packed(payload: bytes) -> Packed:
    """Return a payload as it is stored. It is deflated if that makes it shorter."""
    deflated = zlib.compress(payload, 1)
    if len(deflated) < len(payload):
        return Packed(True, deflated, len(payload))
    return Packed(False, payload, len(payload))


def block(kind: bytes, number: int, payload: bytes) -> bytes:
    """Return one block."""
    return block_of(kind, number, packed(payload))


def block_of(kind: bytes, number: int, payload: Packed) -> bytes:
    """Return one block with a payload that is already packed."""
    stored = payload.stored
    number &= 0xFFFFFFFF
    head = _HEAD.pack(MAGIC, kind, payload.is_deflated, 0, len(stored), payload.size, number)
    crc = zlib.crc32(stored, zlib.crc32(head))
    return head + _CRC.pack(crc) + stored


def json_payload(content: Mapping[str, Any]) -> bytes:
    """Encode a header or information block."""
    text = json.dumps(content, ensure_ascii=False, sort_keys=True)
    return text.encode("utf-8", "surrogatepass")


def read_json(payload: bytes) -> dict[str, Any]:
    """Return the content of a header or information block.

    Raises ValueError with a text for users if it is not a JSON object.
    """
    try:
        content = json.loads(payload.decode("utf-8", "surrogatepass"))
    except RecursionError:
        raise ValueError("is nested too deep") from None
    except ValueError:  # Python's own text is not for users
        raise ValueError("is not JSON in UTF-8") from None
    if not isinstance(content, dict):
        raise ValueError("is not a JSON object")
    return content


def data_payload(entries: Iterable[tuple[int, int, int, bytes, int, int | None]]) -> bytes:
    """Return the payload of a data block, from tuples with the fields of ``Entry``."""
    table = bytearray()
    data = []
    count = 0
    for time_ns, kind, index, content, flags, came_ns in entries:
        if kind in _WITH_ARRIVAL:
            content = _NUMBER.pack(time_ns if came_ns is None else came_ns) + content
        table += _ENTRY.pack(time_ns, kind, flags, index, len(content))
        if content:
            data.append(content)
        count += 1
    return b"".join((_COUNT.pack(count), table, *data))


def read_entries(payload: bytes, version: int = VERSION) -> Iterator[Entry]:
    """Yield the entries of a data block. Raises ValueError if its table and length disagree."""
    if len(payload) < _COUNT.size:
        raise ValueError("has no table")
    count = _COUNT.unpack_from(payload)[0]
    at = _COUNT.size + count * _ENTRY.size
    if at > len(payload):
        raise ValueError("is shorter than its table")
    for head in _ENTRY.iter_unpack(payload[_COUNT.size : at]):
        yield _entry(head, payload[at : at + head[-1]], version)
        at += head[-1]
    if at != len(payload):
        raise ValueError("does not have the length that its table gives")


def entry_at(payload: bytes, number: int, begin: int) -> Entry:
    """Return one entry of an intact data block (of version 2). ``begin``: position of its data."""
    head = _ENTRY.unpack_from(payload, _COUNT.size + number * _ENTRY.size)
    return _entry(head, payload[begin : begin + head[-1]], VERSION)


def _entry(head: tuple[int, ...], data: bytes, version: int) -> Entry:
    time_ns, kind, flags, index, _ = head
    came_ns = None
    if version > 1 and kind in _WITH_ARRIVAL:
        if len(data) < _NUMBER.size:
            raise ValueError("has an entry without its time of arrival")
        (came_ns,) = _NUMBER.unpack_from(data)
        data = data[_NUMBER.size :]
    return Entry(time_ns, kind, index, data, flags, came_ns)


def frame_data(frame: CanFrame) -> bytes:
    """Return a CAN frame as the data of an entry.

    u32 id (bit 31: 29 bits), u8 flags (1 FD, 2 remote), and the bytes of the frame.
    """
    flags = 0
    if frame.fd:
        flags |= _FD
    if frame.remote:
        flags |= _REMOTE
    return _FRAME.pack(frame.key, flags) + frame.data


def read_frame(data: bytes) -> CanFrame:
    """Return the CAN frame of an entry. Raises ValueError if the data are too short."""
    if len(data) < _FRAME.size:
        raise ValueError("is not a CAN frame")
    key, flags = _FRAME.unpack_from(data)
    extended = bool(key & EXTENDED)
    return CanFrame(
        key & ~EXTENDED,
        data[_FRAME.size :],
        extended,
        bool(flags & _FD),
        remote=bool(flags & _REMOTE),
    )


RECORDED_COUNTERS = (*COUNTERS[:7], "started_ns", *COUNTERS[7:])
"""Attributes of GatewayStatus in a COUNTERS entry, in its order.

The last one is missing in captures of version 0.5.
"""


def numbers_data(*numbers: int) -> bytes:
    """Return numbers as the data of an entry. Each is a u64; negative numbers become 0."""
    not_negative = [max(0, number) for number in numbers]
    return struct.pack(f"<{len(numbers)}Q", *not_negative)


def read_numbers(data: bytes) -> tuple[int, ...]:
    """Return the numbers of an entry. Raises ValueError if the length does not fit."""
    count, rest = divmod(len(data), _NUMBER.size)
    if rest:
        raise ValueError("is not a list of numbers")
    return struct.unpack(f"<{count}Q", data)


class Scanner:
    """Finds all intact blocks in a stream of bytes, with any data between them.

    It is used like a deframer: ``feed``, then ``flush``.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._offset = 0
        """File offset of the buffer's first byte."""
        self._bad_from: int | None = None
        """File offset of the damage before the present position. None without damage."""
        self._patience = _PATIENCE

    def feed(self, data: bytes) -> list[Block | Damage]:
        """Add the next bytes. Return the blocks and damages that are certain."""
        self._buffer += data
        return self._scan(final=False)

    def flush(self) -> list[Block | Damage]:
        """Return the rest at the end of the stream."""
        found = self._scan(final=True)
        self._skip(len(self._buffer))
        self._close_damage(found)
        return found

    def _scan(self, final: bool) -> list[Block | Damage]:
        found: list[Block | Damage] = []
        buffer = self._buffer
        while True:
            at = buffer.find(MAGIC)
            if at < 0:
                kept = 0 if final else _partial_magic(buffer)
                self._skip(len(buffer) - kept)
                return found
            self._skip(at)
            if len(buffer) < HEAD_LENGTH:
                if not final:
                    return found
                self._skip(1)
                continue
            _, kind, deflated, zero, stored, size, number = _HEAD.unpack_from(buffer)
            if deflated > 1 or zero or stored > LARGEST_PAYLOAD or size > LARGEST_PAYLOAD:
                self._skip(1)
                continue
            if len(buffer) < HEAD_LENGTH + stored:
                if not final:
                    return found
                self._skip(1)
                continue
            payload = _payload(buffer, deflated, stored, size)
            if payload is None:
                # checking a false block costs its length; the budget bounds the total cost
                self._patience += 64 - stored
                self._skip(1 if self._patience > 0 else HEAD_LENGTH + stored)
                continue
            self._close_damage(found)
            found.append(Block(kind, number, payload, self._offset))
            self._drop(HEAD_LENGTH + stored)

    def _skip(self, count: int) -> None:
        if count:
            if self._bad_from is None:
                self._bad_from = self._offset
            self._drop(count)

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
        self._offset += count

    def _close_damage(self, found: list[Block | Damage]) -> None:
        if self._bad_from is not None:
            if self._offset > self._bad_from:
                found.append(Damage(self._bad_from, self._offset - self._bad_from))
            self._bad_from = None


def _partial_magic(buffer: bytearray) -> int:
    """Return the number of bytes at the buffer's end with which MAGIC may begin."""
    for length in (3, 2, 1):
        if buffer.endswith(MAGIC[:length]):
            return length
    return 0


def _payload(
    buffer: bytearray,
    deflated: int,
    stored: int,
    size: int,
) -> bytes | None:
    """Return the inflated payload of the block at the buffer's beginning.

    None if the CRC or the length is wrong.
    """
    payload = bytes(buffer[HEAD_LENGTH : HEAD_LENGTH + stored])
    crc = zlib.crc32(payload, zlib.crc32(buffer[: _HEAD.size]))
    if crc != _CRC.unpack_from(buffer, _HEAD.size)[0]:
        return None
    if not deflated:
        return payload if stored == size else None
    try:
        inflater = zlib.decompressobj()
        inflated = inflater.decompress(payload, size + 1)
    except zlib.error:
        return None
    return inflated if len(inflated) == size and inflater.eof else None
