"""Readers of BLF and MF4 by python-can (MF4: and asammdf, an extra), which end at the first damage.

python-can reads a BLF object of size 0 for ever (its issue 1584): here it is not given such an object. Its times are floats: here they
count from the log's start.
"""

import gc
import importlib
import logging
import os
import struct
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from kontronik_can_gw.desk.libraries import missing_library
from kontronik_can_gw.desk.recordings.can_logs.text import (
    OLDEST_WALL_S,
    SECOND_NS,
    LogReader,
    frame_of,
)
from kontronik_can_gw.desk.recordings.recording import LogFrame
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.light_imports import without_asammdf

with without_asammdf():
    from can import BLFReader
    from can.io.blf import BLFParseError

if TYPE_CHECKING:
    from can import Message

logging.getLogger("can.io").setLevel(logging.CRITICAL)  # what it says is said here
_MIN_OBJECT, _MAX_OBJECT = 32, 1 << 20
"""Bytes of an object in a container of a BLF file: a larger one would gather all that follows it."""
_ERROR_OBJECTS = tuple(number.to_bytes(4, "little") for number in (2, 104))
"""Types CAN_ERROR and CAN_FD_ERROR_64, which python-can does not read."""
_STEP_FRAMES, _STEP_S = 10, 0.1
"""As in log_clock.py."""
_MS = 1_000_000


class LibraryReader(LogReader):
    """Frames of a log by one of python-can's readers."""

    _reader: Any = None
    _first_channel = 0

    def __iter__(self) -> Iterator[LogFrame]:
        done = wrong = 0
        try:
            with warnings.catch_warnings(action="ignore"):
                for message in self._reader or ():
                    done += 1
                    try:
                        yield frame_of(message, self._first_channel)
                    except ValueError:
                        wrong += 1
        except Exception as error:  # whatever a damaged file makes of it
            self.damage.append(f"damaged after {done} frames ({_short(error)})")
        if wrong:
            self.damage.append(f"{wrong} damaged frame{'s' if wrong > 1 else ''} left out")


class _SoundObjects(BLFReader):
    """python-can's reader, given only objects that it gets past."""

    def _parse_container(self, data: bytes) -> "Iterator[Message]":
        data, self._tail = self._tail + data, b""
        at = begin = 0
        while (found := data.find(b"LOBJ", at, at + 8)) >= 0 and found + 12 <= len(data):
            size = int.from_bytes(data[found + 8 : found + 12], "little")
            if not _MIN_OBJECT <= size <= _MAX_OBJECT:
                yield from super()._parse_container(data[begin:found])
                raise BLFParseError(f"an object of {size} bytes")
            at = found + size
            if data[found + 12 : found + 16] in _ERROR_OBJECTS and at <= len(data):
                yield from super()._parse_container(data[begin:found])
                self._tail = b""
                yield _error_message(data[found:at])
                begin = at
        yield from super()._parse_container(data[begin:])


def _error_message(data: bytes) -> "Message":
    """The error frame of an object that python-can does not read. The channel follows its header."""
    from can import Message

    (header_size,) = struct.unpack_from("<H", data, 4)
    flags, time = struct.unpack_from("<L4xQ", data, 16)
    unit = 1e-5 if flags == 1 else 1e-9
    return Message(time * unit, is_error_frame=True, channel=data[header_size] - 1)


class BlfReader(LibraryReader):
    """BLF."""

    _first_channel = 1  # python-can subtracts it

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(file)
        size = os.fstat(file.fileno()).st_size
        try:
            self._reader = reader = _SoundObjects(file)
        except (BLFParseError, struct.error, ValueError, OverflowError):
            self.damage.append("its header is damaged")
            return
        if size < reader.file_size < 1 << 48:
            sizes = f"{size} of its {reader.file_size} bytes are there"
            self.damage.append(f"the file is cut off: {sizes}")
        elif problem := _faulty_size(file, size):
            self.damage.append(problem)
        if reader.start_timestamp >= OLDEST_WALL_S:
            self.wall_start_ns = round(reader.start_timestamp * 1000) * _MS
        reader.start_timestamp = 0.0

    def __iter__(self) -> Iterator[LogFrame]:
        yield from super().__iter__()
        if self._reader is not None and self._reader._tail.strip(b"\0"):
            self.damage.append("the last frame is cut off")


def _faulty_size(file: BinaryIO, end: int) -> str | None:
    """What is wrong with the size of a container, which python-can believes; the file stays where it is."""
    first = at = file.tell()
    problem = None
    while problem is None and len(head := file.read(16)) == 16 and head.startswith(b"LOBJ"):
        size = int.from_bytes(head[8:12], "little")
        if size < len(head) or at + size > end:
            problem = f"a container of {size} bytes at byte {at}"
        at = file.seek(at + size + size % 4)
    file.seek(first)
    return problem


class Mf4Reader(LibraryReader):
    """MF4 bus logging. RunError where asammdf is missing or cannot read it; UserError for a table."""

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(file)
        path = Path(file.name)
        self._reader = reader = _opened(_reader_in_order(mf4_library()), path)
        start = reader._mdf.header.start_time.timestamp()
        groups = [group for group in reader._mdf.groups if group.channel_group.cycles_nr]
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

    def close(self) -> None:
        with warnings.catch_warnings(action="ignore"):
            self._reader.stop()


def mf4_library() -> Any:
    """python-can's module for MF4. RunError where asammdf is not installed."""
    try:
        import asammdf  # noqa: F401
    except ImportError:
        raise missing_library("MF4", "mf4") from None
    # what it says is said again by us, in one line
    logging.getLogger("asammdf").setLevel(logging.CRITICAL + 1)
    library = importlib.import_module("can.io.mf4")
    # imported without it, for a quick start
    return importlib.reload(library) if library.asammdf is None else library


def _reader_in_order(library: Any) -> Any:
    """python-can's reader of MF4, with the records of each group in the order of their times."""

    class InOrder:
        """Part of an iterator over the records of a group."""

        _mdf: Any
        _group_index: int
        _name: str
        _chunk_size: int
        _sorted: Any = None
        _is_known = False

        def _get_data(self, offset: int) -> Any:
            if not self._is_known:
                self._is_known = True
                order = _order_of(self._mdf.get_master(self._group_index))
                if order is not None:
                    data = self._mdf.get(self._name, self._group_index, raw=False)
                    samples, times = data.samples[order], data.timestamps[order]
                    self._sorted = type(data)(samples, times, name=self._name)
            if self._sorted is None:
                return super()._get_data(offset)  # type: ignore[misc]
            part = slice(offset, offset + self._chunk_size)
            data = self._sorted
            return type(data)(data.samples[part], data.timestamps[part], name=self._name)

    class Reader(library.MF4Reader):  # type: ignore[misc]
        """python-can makes its iterators by these names."""

    for name in ("_CANDataFrameIterator", "_CANErrorFrameIterator", "_CANRemoteFrameIterator"):
        made = getattr(library.MF4Reader, name)
        setattr(Reader, name, type(name, (InOrder, made), {}))
    return Reader


def _order_of(times: Any) -> Any:
    """Indices of times (s, numpy) in ascending order; None if they are.

    If the clock was set back the times before the step stay in front of the others: ten of them, of
    which one may be wrong, are more than 100 ms later than the ten after it.
    """
    import numpy as np

    falls = np.flatnonzero(np.diff(times) < 0) + 1
    if not len(falls):
        return None
    steps = [
        at
        for at in falls
        if at >= _STEP_FRAMES
        and len(times) - at >= _STEP_FRAMES
        and np.sort(times[at - _STEP_FRAMES : at])[-2] - _STEP_S
        > times[at : at + _STEP_FRAMES].max()
    ]
    parts = np.split(np.arange(len(times)), steps)
    return np.concatenate([part[np.argsort(times[part], kind="stable")] for part in parts])


def _opened(mf4_reader: Any, path: Path) -> Any:
    """The reader; RunError where asammdf cannot read the file."""
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        with warnings.catch_warnings(action="ignore"):
            reader = mf4_reader(os.fspath(path))
            reader._mdf.header.start_time.timestamp()
            return reader
    except Exception as error:  # whatever a damaged file makes of it
        reason = _short(error)
    finally:
        gc.collect()  # what is half made complains when it is thrown away
        sys.unraisablehook = hook
    raise RunError(f"{path}: cannot be read as MF4: {reason}.")


def _short(error: Exception) -> str:
    """A library's complaint in a few words."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:160].rstrip(".")
