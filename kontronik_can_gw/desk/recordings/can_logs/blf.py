"""Reader of Vector BLF files: containers, damage and advance are followed here, python-can reads the frames.

A BLF file is a header ``LOGG`` and containers ``LOBJ``, each with zlib-compressed objects ``LOBJ``, which may go on in the next container.
python-can ends at the first damage and reads an object of size 0 for ever (its issue 1584): it is given only objects whose
bounds have been checked.
"""

import io
import struct
import zlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, BinaryIO

from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.desk.recordings.can_logs.record import (
    OLDEST_WALL_S,
    SECOND_NS,
    Damage,
    is_possible,
)
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.lean import without_asammdf

if TYPE_CHECKING:
    from can import BLFReader

_FILE_HEADER_SIZE, _MIN_FILE_HEADER = 144, 72
_BASE = struct.Struct("<4sHHLL")
"""Signature, header size, header version, object size, object type."""
_CONTAINER = struct.Struct("<H6xL4x")
"""Compression (0 none, 2 zlib), size uncompressed."""
_NOT_COMPRESSED, _ZLIB = 0, 2
_LOG_CONTAINER = 10
_MIN_SIZES = {1: 16, 86: 16, 100: 84, 101: 40}
"""Bytes after the headers that python-can reads of CAN_MESSAGE, CAN_MESSAGE2, CAN_FD_MESSAGE and CAN_FD_MESSAGE_64."""
_CLASSIC = (1, 86)
_NO_ID, _MAX_DLC = 0x60000000, 15
_HEADER_SIZES = {1: 32, 2: 40}
"""Bytes of the headers in front of them, by the headers' version."""
_LAST_KIND = 255
_LARGEST_CONTAINER = 1 << 26
_LARGEST_FILE = 1 << 48
_LARGEST_OBJECT = 1 << 20
_PADDING = 8
"""Bytes that may lie between two objects, and one more."""
_BLOCK = 1 << 16
_SIGNATURE = b"LOBJ"
_EMPTY_FILE = struct.pack("<4sL", b"LOGG", _FILE_HEADER_SIZE).ljust(_FILE_HEADER_SIZE, b"\0")


class BlfReader:
    """Frames of a BLF file, in its order."""

    def __init__(self, file: BinaryIO, damage: Damage) -> None:
        self._file = file
        self._damage = damage
        self.wall_start_ns: int | None = None
        self._first = self._full = 0
        head = file.read(_FILE_HEADER_SIZE)
        if len(head) >= _MIN_FILE_HEADER and head.startswith(b"LOGG"):
            header = _library_reader(head)
            self._full = header.file_size if header.file_size <= _LARGEST_FILE else 0
            if header.start_timestamp >= OLDEST_WALL_S:
                self.wall_start_ns = round(header.start_timestamp * 1000) * 1_000_000
            size = int.from_bytes(head[4:8], "little")
            self._first = size if _MIN_FILE_HEADER <= size <= _BLOCK else _FILE_HEADER_SIZE
        self._end = file.seek(0, io.SEEK_END)
        file.seek(0)

    def __iter__(self) -> Iterator[TimedFrame]:
        tail = b""
        follows = self._first
        for offset, end, content in self._containers():
            is_next = 0 <= offset - follows < _PADDING
            if tail and not is_next:
                self._damage.notes.append(f"an object is cut off before offset {offset}")
                tail = b""
            data = tail + content
            objects, done = self._objects(data, offset, is_next or offset == self._first)
            yield from self._frames(objects, offset)
            tail = data[done:]
            follows = end
        if tail.strip(b"\0"):
            self._damage.notes.append("the last frame is cut off")

    def _containers(self) -> Iterator[tuple[int, int, bytes]]:
        """Offset, end and content of each container that can be read, in order; what lies between is reported as damage."""
        end, damage = self._end, self._damage
        if self._full > end:
            damage.notes.append(f"the file is cut off: {end} of its {self._full} bytes are there")
        position = lost = self._first
        while position < end:
            found = self._container(position)
            if found is None:
                position = self._next_signature(position + 1)
                continue
            if position - lost >= _PADDING or lost == 0:
                damage.stretch(lost, position)
            content, after = found
            yield position, after, content
            position = lost = after
        if end - lost >= _PADDING:
            damage.stretch(lost, end)

    def _container(self, position: int) -> tuple[bytes, int] | None:
        """The content of the container at ``position``, and where it ends; None where it cannot be read."""
        self._file.seek(position)
        head = self._file.read(_BASE.size + _CONTAINER.size)
        if len(head) < _BASE.size + _CONTAINER.size:
            return None
        signature, _, _, size, kind = _BASE.unpack_from(head)
        method, full = _CONTAINER.unpack_from(head, _BASE.size)
        if signature != _SIGNATURE or not _BASE.size <= size <= _LARGEST_CONTAINER:
            return None
        after = min(position + size, self._end)
        is_cut = position + size > self._end
        if kind != _LOG_CONTAINER:
            return None if is_cut or kind > _LAST_KIND else (b"", after)
        content = self._file.read(max(0, after - position - len(head)))
        if method == _ZLIB:
            unpacker = zlib.decompressobj()
            try:
                content = unpacker.decompress(content, _LARGEST_CONTAINER)
            except zlib.error:
                return None
            # where its length is wrong, what follows is not lost
            after -= len(unpacker.unused_data)
            is_cut = is_cut and not unpacker.eof
            if not unpacker.eof and not is_cut:
                return None
        elif method != _NOT_COMPRESSED or (is_cut and _SIGNATURE not in content):
            return None
        if is_cut:
            self._damage.notes.append(
                f"the last container, at offset {position}, is cut off: {len(content)} of its {full} bytes are there"
            )
        return content, after

    def _next_signature(self, start: int) -> int:
        """Where the next LOBJ stands; the file's end if nowhere."""
        while start < self._end:
            self._file.seek(start)
            found = self._file.read(_BLOCK + len(_SIGNATURE) - 1).find(_SIGNATURE)
            if found >= 0:
                return start + found
            start += _BLOCK
        return self._end

    def _objects(self, data: bytes, offset: int, from_start: bool) -> tuple[list[bytes], int]:
        """The objects of frames in a container's content whose bounds are sound, and how far it came.

        ``from_start``: the first byte begins an object.
        """
        objects: list[bytes] = []
        position, end = 0, len(data)
        while True:
            found = data.find(_SIGNATURE, position)
            if from_start and not 0 <= found - position < _PADDING:
                if position + _PADDING > end:
                    return objects, min(position, end)
                self._damaged(offset)
            if found < 0:
                return objects, end
            from_start = True
            if found + _BASE.size > end:
                return objects, found
            _, _, version, size, kind = _BASE.unpack_from(data, found)
            after = found + size
            following = data.find(_SIGNATURE, found + len(_SIGNATURE))
            if following < 0:
                if after > end and size <= _LARGEST_OBJECT:
                    return objects, found  # it goes on in the next container
                following = end
            least = _HEADER_SIZES.get(version, size + 1) + _MIN_SIZES.get(kind, 0)
            # "LOBJ" may stand in an object's data: then the length decides
            is_followed = after <= following < after + _PADDING or following == end
            if (
                size < least
                or kind > _LAST_KIND
                or not (is_followed or data.startswith(_SIGNATURE, after))
            ):
                self._damaged(offset)
                after = following
            elif kind in _MIN_SIZES:
                if _has_impossible_bits(data, found + _HEADER_SIZES[version], kind):
                    self._damaged(offset)
                else:
                    objects.append(data[found:after])
            position = after

    def _frames(self, objects: list[bytes], offset: int) -> Iterator[TimedFrame]:
        """The frames of objects of the container at ``offset``, by python-can."""
        content = b"".join(objects)
        size = _BASE.size + _CONTAINER.size + len(content)
        head = _BASE.pack(_SIGNATURE, _BASE.size, 1, size, _LOG_CONTAINER)
        container = head + _CONTAINER.pack(_NOT_COMPRESSED, len(content)) + content
        for message in _library_reader(_EMPTY_FILE + container):
            can_id, extended, fd = message.arbitration_id, message.is_extended_id, message.is_fd
            if message.is_remote_frame:
                continue
            if not is_possible(can_id, extended, len(message.data), fd):
                self._damaged(offset)
                continue
            frame = CanFrame(can_id, bytes(message.data), extended, fd)
            yield TimedFrame(round(message.timestamp * SECOND_NS), frame, message.is_rx)

    def _damaged(self, offset: int) -> None:
        note = f"frames are damaged in the container at offset {offset}"
        if note not in self._damage.notes[-1:]:
            self._damage.notes.append(note)


def _library_reader(content: bytes) -> "BLFReader":
    with without_asammdf():
        from can import BLFReader
    return BLFReader(io.BytesIO(content))


def _has_impossible_bits(data: bytes, at: int, kind: int) -> bool:
    """True where a frame's id or DLC has bits that none has, which python-can leaves out."""
    can_id = int.from_bytes(data[at + 4 : at + 8], "little")
    return bool(can_id & _NO_ID) or (kind in _CLASSIC and data[at + 3] > _MAX_DLC)
