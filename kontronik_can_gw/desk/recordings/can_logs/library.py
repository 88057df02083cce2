"""Readers of BLF and MF4, which use python-can. MF4 also needs asammdf, an extra.

They end at the first damage. python-can would read a BLF object of size 0 for ever (its issue
1584), so such objects are not passed to it. Its times are floats, so they count from the log's
start.
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
    LogReader,
    frame_of,
)
from kontronik_can_gw.desk.recordings.recording import LogFrame
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.light_imports import without_asammdf
from kontronik_can_gw.printable import counted
from kontronik_can_gw.times import MS, SECOND

with without_asammdf():
    from can import BLFReader
    from can.io import blf
    from can.io.blf import BLFParseError

if TYPE_CHECKING:
    from can import Message

logging.getLogger("can.io").setLevel(logging.CRITICAL)  # the readers here report its problems
# Times are signed, because a pre-trigger buffer has frames from before the start. python-can reads
# them as unsigned.
blf.OBJ_HEADER_V1_STRUCT = struct.Struct("<LHHq")
blf.OBJ_HEADER_V2_STRUCT = struct.Struct("<LBxHq8x")
_MIN_OBJECT = 32
_MAX_OBJECT = 1 << 20
"""Limits of an object's size in a BLF container. A larger object would contain all later ones."""
_ERROR_OBJECTS = tuple(number.to_bytes(4, "little") for number in (2, 104))
"""Types CAN_ERROR and CAN_FD_ERROR_64, which python-can does not read."""
_STEP_FRAMES = 10
_STEP_S = 0.1
"""The same limits as in log_clock.py."""


class LibraryReader(LogReader):
    """A log that is read by one of python-can's readers."""

    _reader: Any = None
    _first_channel = 0

    def __iter__(self) -> Iterator[LogFrame]:
        done = 0
        wrong = 0
        try:
            with warnings.catch_warnings(action="ignore"):
                for message in self._reader or ():
                    done += 1
                    try:
                        yield frame_of(message, self._first_channel)
                    except ValueError:
                        wrong += 1
        except Exception as error:  # a damaged file can cause any exception
            self.damage.append(f"damaged after {counted(done, 'frame')} ({_short(error)})")
        if wrong:
            noun = "damaged frames" if wrong > 1 else "damaged frame"
            self.damage.append(f"{wrong} {noun} left out")


class _SoundObjects(BLFReader):
    """python-can's reader, which receives only objects that it can read or skip."""

    def _parse_container(self, data: bytes) -> "Iterator[Message]":
        data = self._tail + data
        self._tail = b""
        at = 0
        begin = 0
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
    """Return the error frame of an object that python-can does not read.

    The channel is the first byte after the object's header.
    """
    from can import Message

    (header_size,) = struct.unpack_from("<H", data, 4)
    flags, time = struct.unpack_from("<L4xq", data, 16)
    unit = 1e-5 if flags == 1 else 1e-9
    return Message(time * unit, is_error_frame=True, channel=data[header_size] - 1)


class BlfReader(LibraryReader):
    """The reader of BLF."""

    _first_channel = 1  # python-can subtracts 1

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(file)
        size = os.fstat(file.fileno()).st_size
        try:
            reader = _SoundObjects(file)
        except (BLFParseError, struct.error, ValueError, OverflowError):
            self.damage.append("its header is damaged")
            return
        self._reader = reader
        if size < reader.file_size < 1 << 48:
            self.damage.append(f"the file is cut off after {size} of {reader.file_size} bytes")
        else:
            problem = _container_problem(file, size)
            if problem:
                self.damage.append(problem)
        if reader.start_timestamp >= OLDEST_WALL_S:
            self.wall_start_ns = round(reader.start_timestamp * 1000) * MS
        reader.start_timestamp = 0.0

    def __iter__(self) -> Iterator[LogFrame]:
        yield from super().__iter__()
        if self._reader is not None and self._reader._tail.strip(b"\0"):
            self.damage.append("the last frame is cut off")


def _container_problem(file: BinaryIO, end: int) -> str | None:
    """Return the problem of a container with an impossible size. None if there is none.

    python-can does not check the sizes. The position in the file is not changed.
    """
    first = file.tell()
    at = first
    problem = None
    while problem is None and len(head := file.read(16)) == 16 and head.startswith(b"LOBJ"):
        size = int.from_bytes(head[8:12], "little")
        if size < len(head) or at + size > end:
            problem = f"the container at byte {at} has the impossible size {size}"
        at = file.seek(at + size + size % 4)
    file.seek(first)
    return problem


class Mf4Reader(LibraryReader):
    """The reader of MF4 bus logging.

    Raises RunError if asammdf is missing or cannot read the file, and UserError for a table.
    """

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(file)
        path = Path(file.name)
        reader = _opened(_reader_in_order(mf4_library()), path)
        self._reader = reader
        start_s = reader._mdf.header.start_time.timestamp()
        groups = [group for group in reader._mdf.groups if group.channel_group.cycles_nr]
        names = {channel.name for group in groups for channel in group.channels}
        if groups and not any(name.startswith("CAN_") for name in names):
            self.close()
            raise UserError(
                f"{path}: is a table of values (an MF4 measurement), not a log of a CAN bus. "
                "Give the recording from which it was made."
            )
        if start_s >= OLDEST_WALL_S:
            # asammdf converts local times, but only ``abs_time`` has the exact fraction of a second
            fraction_ns = int(reader._mdf.header.abs_time) % SECOND
            whole_s = round(start_s - fraction_ns / SECOND)
            self.wall_start_ns = whole_s * SECOND + fraction_ns
        reader._start_timestamp = 0.0

    def close(self) -> None:
        with warnings.catch_warnings(action="ignore"):
            self._reader.stop()


def mf4_library() -> Any:
    """Return python-can's module for MF4. Raises RunError if asammdf is not installed."""
    try:
        import asammdf  # noqa: F401
    except ImportError:
        raise missing_library("MF4", "mf4") from None
    # the readers here report its problems in one line
    logging.getLogger("asammdf").setLevel(logging.CRITICAL + 1)
    library = importlib.import_module("can.io.mf4")
    if library.asammdf is None:  # it was imported without asammdf for a quick start
        return importlib.reload(library)
    return library


def _reader_in_order(library: Any) -> Any:
    """Return python-can's reader of MF4, with the records of each group sorted by time."""

    class InOrder:
        """A mixin of python-can's iterators over the records of a group."""

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
                    samples = data.samples[order]
                    times = data.timestamps[order]
                    self._sorted = type(data)(samples, times, name=self._name)
            if self._sorted is None:
                return super()._get_data(offset)  # type: ignore[misc]
            part = slice(offset, offset + self._chunk_size)
            data = self._sorted
            return type(data)(data.samples[part], data.timestamps[part], name=self._name)

    class Reader(library.MF4Reader):  # type: ignore[misc]
        """A reader whose iterators, found by their names, are the sorted ones."""

    for name in ("_CANDataFrameIterator", "_CANErrorFrameIterator", "_CANRemoteFrameIterator"):
        made = getattr(library.MF4Reader, name)
        setattr(Reader, name, type(name, (InOrder, made), {}))
    return Reader


def _order_of(times: Any) -> Any:
    """Return the indices of times (s, numpy) in ascending order. None if they are in order.

    If the clock was set back, the times before the step stay before the others. A step is a place
    at which ten times are more than 100 ms later than the next ten. One of them may be wrong.
    """
    import numpy as np

    falls = np.flatnonzero(np.diff(times) < 0) + 1
    if not len(falls):
        return None
    steps = []
    for at in falls:
        before = times[max(0, at - _STEP_FRAMES) : at]
        after = times[at : at + _STEP_FRAMES]
        if len(before) < _STEP_FRAMES or len(after) < _STEP_FRAMES:
            continue
        second_latest = np.sort(before)[-2]
        if second_latest - _STEP_S > after.max():
            steps.append(at)
    sorted_parts = []
    for part in np.split(np.arange(len(times)), steps):
        order = np.argsort(times[part], kind="stable")
        sorted_parts.append(part[order])
    return np.concatenate(sorted_parts)


def _opened(mf4_reader: Any, path: Path) -> Any:
    """Return an open reader. Raises RunError if asammdf cannot read the file."""
    hook = sys.unraisablehook
    sys.unraisablehook = lambda _: None
    try:
        with warnings.catch_warnings(action="ignore"):
            reader = mf4_reader(os.fspath(path))
            reader._mdf.header.start_time.timestamp()
            return reader
    except Exception as error:  # a damaged file can cause any exception
        reason = _short(error)
    finally:
        gc.collect()  # incomplete objects would print errors later, when they are deleted
        sys.unraisablehook = hook
    raise RunError(f"{path}: cannot be read as MF4: {reason}.")


def _short(error: Exception) -> str:
    """Return the first line of a library's error, or its type."""
    lines = str(error).strip().splitlines()
    text = lines[0] if lines else type(error).__name__
    return text[:160].rstrip(".")
