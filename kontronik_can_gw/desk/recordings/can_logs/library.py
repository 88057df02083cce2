"""Readers of BLF and MF4 by python-can (MF4: and asammdf, an extra), with an account of what it cannot read.

python-can ends at the first damage, and reads a BLF object of size 0 for ever (its issue 1584): here it is asked again from the next
container on, and is not given such an object. Its times are floats: here they count from the log's start.
"""

import gc
import importlib
import logging
import os
import struct
import sys
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.desk.recordings.can_logs.mf4 import asammdf_module, quiet, short
from kontronik_can_gw.desk.recordings.can_logs.text import (
    OLDEST_WALL_S,
    SECOND_NS,
    Damage,
    is_possible,
)
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.lean import without_asammdf

with without_asammdf():
    from can import BLFReader
    from can.io.blf import BLFParseError

if TYPE_CHECKING:
    from can import Message

logging.getLogger("can.io").setLevel(logging.CRITICAL)  # what it says is said here
_SIGNATURE = b"LOBJ"
_MIN_OBJECT, _MAX_OBJECT = 32, 1 << 20
_BLOCK = 1 << 16
_MS = 1_000_000


class LibraryReader:
    """Frames of a log by python-can."""

    wall_start_ns: int | None = None
    position = 0

    def __init__(self, file: BinaryIO, damage: Damage) -> None:
        self._file = file
        self._damage = damage

    def __iter__(self) -> Iterator[TimedFrame]:
        for message in self._messages():
            if message.is_error_frame or message.is_remote_frame:
                continue
            frame = CanFrame(
                *(message.arbitration_id, bytes(message.data), message.is_extended_id),
                fd=message.is_fd,
            )
            is_cut = (
                not frame.fd and not min(message.dlc, 8) <= len(frame.data) <= message.dlc <= 15
            )
            if is_cut or not is_possible(frame):
                self._damaged()
            else:
                yield TimedFrame(round(message.timestamp * SECOND_NS), frame, message.is_rx)

    def _messages(self) -> "Iterator[Message]":
        raise NotImplementedError

    def close(self) -> None:
        """Release what the library holds."""

    def _damaged(self) -> None:
        """What was read last is no frame."""
        note = f"frames are damaged before offset {self._file.tell()}"
        if note not in self._damage.notes[-1:]:
            self._damage.notes.append(note)


class _Containers(BLFReader):
    """python-can's reader, given only objects whose bounds are sound."""

    damaged: Callable[[], None]

    def _parse_container(self, data: bytes) -> "Iterator[Message]":
        data, self._tail = self._tail + data, b""
        begin = at = 0
        while (found := data.find(_SIGNATURE, at)) >= 0 and found + 12 <= len(data):
            size, is_next = int.from_bytes(data[found + 8 : found + 12], "little"), found - at < 8
            if is_next and _MIN_OBJECT <= size <= _MAX_OBJECT:
                at = found + size
                continue
            yield from super()._parse_container(data[begin:at])
            self._tail = b""
            self.damaged()
            begin = at = found + 4 if is_next else found
        yield from super()._parse_container(data[begin:])


class BlfReader(LibraryReader):
    """BLF. What is damaged costs the rest of its container."""

    def __init__(self, file: BinaryIO, damage: Damage) -> None:
        super().__init__(file, damage)
        self._reader: _Containers | None = None
        size = file.seek(0, 2)
        file.seek(0)
        try:
            self._reader = reader = _Containers(file)
        except (BLFParseError, struct.error, ValueError, OverflowError):
            damage.notes.append("its header is damaged")
            return
        reader.damaged = self._damaged
        if size < reader.file_size < 1 << 48:
            damage.notes.append(
                f"the file is cut off: {size} of its {reader.file_size} bytes are there"
            )
        if reader.start_timestamp >= OLDEST_WALL_S:
            self.wall_start_ns = round(reader.start_timestamp * 1000) * _MS
        reader.start_timestamp = 0.0

    def _messages(self) -> "Iterator[Message]":
        if (reader := self._reader) is None:
            return
        while True:
            try:
                for message in reader:
                    self.position = self._file.tell()
                    yield message
                if reader._tail.strip(b"\0"):
                    self._damage.notes.append("the last frame is cut off")
                return
            except (BLFParseError, struct.error, zlib.error, ValueError, OverflowError) as error:
                self._damage.notes.append(
                    f"damaged before offset {self._file.tell()} ({short(error)})"
                )
            reader._tail = b""
            if not self._find_container():
                return

    def _find_container(self) -> bool:
        """Go on to the next LOBJ; False where there is none."""
        while data := self._file.read(_BLOCK):
            found = data.find(_SIGNATURE)
            if found >= 0 or len(data) > 3:
                self._file.seek((found if found >= 0 else len(data) - 3) - len(data), 1)
            if found >= 0 or len(data) < _BLOCK:
                return found >= 0
        return False


class Mf4Reader(LibraryReader):
    """MF4 bus logging. RunError where asammdf is missing or cannot read it; UserError for a table."""

    def __init__(self, file: BinaryIO, damage: Damage) -> None:
        super().__init__(file, damage)
        path = Path(file.name)
        asammdf_module()
        library = importlib.import_module("can.io.mf4")
        if library.asammdf is None:  # imported without it, for a quick start
            library = importlib.reload(library)
        self._reader = reader = _opened(library.MF4Reader, path)
        start = reader._mdf.header.start_time.timestamp()
        groups = [group for group in reader._mdf.groups if group.channel_group.cycles_nr]
        self._total = sum(group.channel_group.cycles_nr for group in groups)
        self._size = path.stat().st_size
        names = {channel.name for group in groups for channel in group.channels}
        if groups and not any(name.startswith("CAN_") for name in names):
            self.close()
            raise UserError(
                f"{path}: is a table of values (an MF4 measurement), no log of a CAN bus. Give the recording it was made of."
            )
        if start >= OLDEST_WALL_S:
            # a file may say local time, which asammdf works out; the exact fraction of a second is in the number
            fraction = int(reader._mdf.header.abs_time) % SECOND_NS
            self.wall_start_ns = round(start - fraction / SECOND_NS) * SECOND_NS + fraction
        reader._start_timestamp = 0.0

    def _messages(self) -> "Iterator[Message]":
        done = 0
        try:
            with quiet():
                for done, message in enumerate(self._reader):
                    self.position = self._size * done // self._total
                    yield message
        except Exception as error:  # whatever a damaged file makes of it
            self._damage.notes.append(f"damaged after {done} frames ({short(error)})")

    def close(self) -> None:
        """Close the file."""
        with quiet():
            self._reader.stop()


def _opened(mf4_reader: Any, path: Path) -> Any:
    """The reader; RunError where asammdf cannot read the file."""
    hook = sys.unraisablehook
    sys.unraisablehook = lambda _: None  # what is half made complains when it is thrown away
    try:
        try:
            with quiet():
                reader = mf4_reader(os.fspath(path))
                reader._mdf.header.start_time.timestamp()
                return reader
        except Exception as error:  # whatever a damaged file makes of it
            reason = short(error)
        gc.collect()
        raise RunError(f"{path}: cannot be read as MF4: {reason}.")
    finally:
        sys.unraisablehook = hook
