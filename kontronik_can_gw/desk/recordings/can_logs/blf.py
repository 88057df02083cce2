"""Reader of Vector BLF files. A damaged container or object is left out, up to the next one that can be read.

A BLF file is a header ``LOGG`` and containers ``LOBJ``, each with zlib-compressed objects ``LOBJ``, which may go on in the next container.
No specification is public; the structures are those of python-can (and of Tobias Lorenz' vector_blf).
"""

import struct
import zlib
from collections.abc import Generator, Iterator
from datetime import UTC, datetime
from typing import BinaryIO

from kontronik_can_gw.desk.recordings.can_logs.record import (
    OLDEST_WALL_S,
    SECOND_NS,
    Damage,
    LogFrame,
    is_possible,
)
from kontronik_can_gw.frames import CanFrame

_FILE_HEADER = struct.Struct("<4sL8xQQLL8H8H")
_FILE_HEADER_SIZE = 144
_BASE = struct.Struct("<4sHHLL")
"""Signature, header size, header version, object size, object type."""
_OBJECT = struct.Struct("<LHHQ")
"""Flags, client index, object version, time stamp."""
_CONTAINER = struct.Struct("<H6xL4x")
"""Compression (0 none, 2 zlib), size uncompressed."""
_MESSAGE = struct.Struct("<HBBL8s")
_FD_MESSAGE = struct.Struct("<HBBLLBBB5x64s")
_FD_MESSAGE_64 = struct.Struct("<BBBBLLLLLLLHBBL")
_CAN_MESSAGE, _CAN_ERROR, _LOG_CONTAINER, _CAN_ERROR_EXT = 1, 2, 10, 73
_CAN_MESSAGE2, _CAN_FD_MESSAGE, _CAN_FD_MESSAGE_64 = 86, 100, 101
_FRAMES = (_CAN_MESSAGE, _CAN_MESSAGE2, _CAN_FD_MESSAGE, _CAN_FD_MESSAGE_64)
_MIN_SIZES = {
    _CAN_MESSAGE: _MESSAGE.size,
    _CAN_MESSAGE2: _MESSAGE.size,
    _CAN_FD_MESSAGE: _FD_MESSAGE.size,
    _CAN_FD_MESSAGE_64: _FD_MESSAGE_64.size,
}
_LAST_KIND = 255
_LARGEST_CONTAINER = 1 << 26
_LARGEST_FILE = 1 << 48
_LARGEST_OBJECT = 1 << 20
_PADDING = 8
"""Bytes that may lie between two objects, and one more."""
_EXTENDED = 0x80000000
_ID_MASK = 0x1FFFFFFF
_REMOTE, _TX, _EDL = 0x80, 0x01, 0x01
_SIGNATURE = b"LOBJ"


class BlfReader:
    """Frames of a BLF file, in its order."""

    def __init__(self, file: BinaryIO, damage: Damage) -> None:
        self._file = file
        self._damage = damage
        self.wall_start_ns: int | None = None
        self._first = self._full = 0
        head = file.read(_FILE_HEADER_SIZE)
        if len(head) >= _FILE_HEADER.size:
            fields = _FILE_HEADER.unpack_from(head)
            if fields[0] == b"LOGG":
                self._full = fields[2] if fields[2] <= _LARGEST_FILE else 0
                self.wall_start_ns = system_time_ns(fields[6:14])
                self._first = (
                    fields[1] if _FILE_HEADER.size <= fields[1] <= 1 << 16 else _FILE_HEADER_SIZE
                )
        file.seek(0)

    def __iter__(self) -> Iterator[LogFrame]:
        tail = b""
        follows = self._first
        for offset, end, content in self._containers():
            whole = 0 <= offset - follows < _PADDING
            if tail and not whole:
                self._damage.notes.append(f"an object is cut off before offset {offset}")
                tail = b""
            data = tail + content
            done = yield from self._objects(data, offset, whole or offset == self._first)
            tail = data[done:]
            follows = end
        if tail.strip(b"\0"):
            self._damage.notes.append("the last frame is cut off")

    def _containers(self) -> Iterator[tuple[int, int, bytes]]:
        """Offset, end and content of each container that can be read, in order; what lies between is reported as damage."""
        file, damage = self._file, self._damage
        file.seek(0, 2)
        end = file.tell()
        if self._full > end:
            damage.notes.append(f"the file is cut off: {end} of its {self._full} bytes are there")
        position = self._first
        lost = position
        while position < end:
            file.seek(position)
            head = file.read(_BASE.size)
            found = None
            if len(head) == _BASE.size:
                signature, _, _, size, kind = _BASE.unpack(head)
                if signature == _SIGNATURE and _BASE.size <= size <= _LARGEST_CONTAINER:
                    found = self._container(head, position, size, kind, end)
            if found is None:
                position = self._next_signature(position + 1, end)
                continue
            if position - lost >= _PADDING or lost == 0:
                damage.stretch(lost, position)
            content, after = found
            yield position, after, content
            position = lost = after
        if end - lost >= _PADDING:
            damage.stretch(lost, end)

    def _container(
        self, head: bytes, position: int, size: int, kind: int, end: int
    ) -> tuple[bytes, int] | None:
        """The content of what stands at ``position``, and where it ends; None where it cannot be read."""
        body = self._file.read(min(size, end - position) - _BASE.size)
        is_cut = position + size > end
        after = min(position + size, end)
        if kind != _LOG_CONTAINER:
            if is_cut or kind > _LAST_KIND:
                return None
            # an object that is in no container is read as one that is
            return (head + body if kind in _FRAMES else b""), after
        if len(body) < _CONTAINER.size:
            return None
        method, full = _CONTAINER.unpack_from(body)
        packed = body[_CONTAINER.size :]
        if method == 0:
            if is_cut and _SIGNATURE not in packed:
                return None
            content = packed
        elif method == 2:
            unpacker = zlib.decompressobj()
            try:
                content = unpacker.decompress(packed, _LARGEST_CONTAINER)
            except zlib.error:
                return None
            if unpacker.eof:
                is_cut = False
                if len(unpacker.unused_data) >= _PADDING:
                    # its length is wrong, what follows is not lost
                    after -= len(unpacker.unused_data)
                    self._damage.notes.append(
                        f"the length of the container at offset {position} is wrong"
                    )
            elif not is_cut:
                return None
        else:
            return None
        if is_cut:
            self._damage.notes.append(
                f"the last container, at offset {position}, is cut off: {len(content)} of its {full} bytes are there"
            )
        return content, after

    def _next_signature(self, start: int, end: int) -> int:
        """Where the next LOBJ stands; ``end`` if nowhere."""
        file = self._file
        block = 1 << 16
        while start < end:
            file.seek(start)
            data = file.read(block + 3)
            found = data.find(_SIGNATURE)
            if found >= 0:
                return start + found
            start += block
        return end

    def _objects(
        self, data: bytes, offset: int, from_start: bool
    ) -> Generator[LogFrame, None, int]:
        """The frames in a container's content; returns how far it came. ``from_start``: the first byte begins an object."""
        position, end = 0, len(data)
        while True:
            found = data.find(_SIGNATURE, position, position + _PADDING)
            if found < 0:
                if position + _PADDING > end and from_start:
                    return min(position, end)
                if from_start:
                    self._damaged(offset)
                found = data.find(_SIGNATURE, position)
                if found < 0:
                    return end
            from_start = True
            position = found
            if found + _BASE.size > end:
                return found
            _, header_size, version, size, kind = _BASE.unpack_from(data, found)
            after = found + size
            following = data.find(_SIGNATURE, found + 4)
            if following < 0:
                following = end
            if after > end and following == end and size <= _LARGEST_OBJECT:
                return found  # it goes on in the next container
            if (
                size < _BASE.size
                or version not in (1, 2)
                or kind > _LAST_KIND
                or not _fits(data, after, following)
            ):
                self._damaged(offset)
                position = following
                continue
            try:
                frame = self._frame(data, found, header_size, version, size, kind)
            except struct.error:
                self._damaged(offset)
            else:
                if frame is not None:
                    yield frame
            position = after

    def _damaged(self, offset: int) -> None:
        note = f"frames are damaged in the container at offset {offset}"
        if note not in self._damage.notes[-1:]:
            self._damage.notes.append(note)

    def _frame(
        self, data: bytes, start: int, header_size: int, version: int, size: int, kind: int
    ) -> LogFrame | None:
        flags, _, _, stamp = _OBJECT.unpack_from(data, start + _BASE.size)
        time_ns = stamp * 10_000 if flags == 1 else stamp
        at = start + _BASE.size + _OBJECT.size + (8 if version == 2 else 0)
        if start + size < at + _MIN_SIZES.get(kind, 0):
            raise struct.error
        if kind in (_CAN_MESSAGE, _CAN_MESSAGE2):
            channel, bits, length, can_id, content = _MESSAGE.unpack_from(data, at)
            remote, received, fd = bits & _REMOTE, not bits & _TX, False
            if 8 < length < 16:  # a raw DLC; it means 8 bytes
                length = 8
        elif kind == _CAN_FD_MESSAGE:
            channel, bits, _, can_id, _, _, fd_flags, length, content = _FD_MESSAGE.unpack_from(
                data, at
            )
            remote, received, fd = bits & _REMOTE, not bits & _TX, bool(fd_flags & _EDL)
        elif kind == _CAN_FD_MESSAGE_64:
            fields = _FD_MESSAGE_64.unpack_from(data, at)
            channel, length, can_id, fd_flags, direction, more = (
                fields[0],
                fields[2],
                fields[4],
                fields[6],
                fields[12],
                fields[13],
            )
            remote, received, fd = fd_flags & 0x10, not direction, bool(fd_flags & 0x1000)
            at += _FD_MESSAGE_64.size
            held = min(length, (more or size) - header_size - _FD_MESSAGE_64.size)
            content = data[at : at + max(0, held)].ljust(length, b"\0")
        else:
            if kind in (_CAN_ERROR, _CAN_ERROR_EXT):
                self._damage.skip("error frames")
            return None
        if remote:
            self._damage.skip("remote frames")
            return None
        extended = bool(can_id & _EXTENDED)
        if not is_possible(can_id & ~_EXTENDED, extended, length, fd):
            raise struct.error
        return LogFrame(
            time_ns,
            CanFrame(can_id & _ID_MASK, content[:length], extended, fd),
            received,
            str(channel),
        )


def _fits(data: bytes, after: int, following: int) -> bool:
    """True where an object that ends at ``after`` is followed by the next one, or by the end."""
    # "LOBJ" may stand in an object's data: then the length decides
    return (
        after <= following < after + _PADDING
        or data.startswith(_SIGNATURE, after)
        or following == len(data)
    )


def system_time_ns(fields: tuple[int, ...]) -> int | None:
    """Unix time in ns of a SYSTEMTIME (UTC, as python-can writes it); None where it is none."""
    year, month, _, day, hour, minute, second, ms = fields
    try:
        moment = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return None
    seconds = int(moment.timestamp())
    return seconds * SECOND_NS + min(ms, 999) * 1_000_000 if seconds >= OLDEST_WALL_S else None
