"""MF4 bus logging by asammdf (an extra): groups CAN_DataFrame, as python-can, CANedge and Vector's loggers write them."""

import contextlib
import gc
import heapq
import os
import sys
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.desk.recordings.can_logs.record import (
    FD_LENGTHS,
    OLDEST_WALL_S,
    SECOND_NS,
    Damage,
    is_possible,
)
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.frames import CanFrame

if TYPE_CHECKING:
    from types import ModuleType

_CHUNK = 8192
_GROUP = "CAN_DataFrame"
_BUS = {_GROUP, f"{_GROUP}.ID", "CAN_ErrorFrame", "CAN_RemoteFrame"}
_COLUMNS = {
    "BusChannel": "<u1",
    "ID": "<u4",
    "IDE": "<u1",
    "DLC": "<u1",
    "DataLength": "<u1",
    "DataBytes": "(64,)u1",
    "Dir": "<u1",
    "EDL": "<u1",
    "BRS": "<u1",
    "ESI": "<u1",
}


def asammdf_module() -> "ModuleType":
    """asammdf. RunError where it is not installed."""
    try:
        import asammdf
    except ImportError:
        raise RunError("MF4 needs asammdf: pip install 'kontronik-can-gw[mf4]'") from None
    import logging

    # what it says is said again by us, in one line
    logging.getLogger("asammdf").setLevel(logging.CRITICAL + 1)
    module: ModuleType = asammdf
    return module


class Mf4Reader:
    """CAN frames of an MF4 file, merged by time. ``position``: records read, in bytes of the file by estimate."""

    def __init__(self, path: Path, damage: Damage) -> None:
        module = asammdf_module()
        self._damage = damage
        self._size = path.stat().st_size
        self.position = 0
        self.wall_start_ns: int | None = None
        self._mdf = _opened(module, path)
        self._groups = [
            (index, int(group.channel_group.cycles_nr), {one.name for one in group.channels})
            for index, group in enumerate(self._mdf.groups)
        ]
        filled = [names for _, cycles, names in self._groups if cycles]
        if filled and not any(_BUS & names for names in filled):
            self.close()
            raise UserError(
                f"{path}: is a table of values (an MF4 measurement), no log of a CAN bus. Give the recording it was made of."
            )
        start = self._mdf.header.start_time.timestamp()
        if start >= OLDEST_WALL_S:
            # a file may say local time, which asammdf works out; the exact fraction of a second is in the number
            fraction = int(self._mdf.header.abs_time) % SECOND_NS
            self.wall_start_ns = round(start - fraction / SECOND_NS) * SECOND_NS + fraction

    def __iter__(self) -> Iterator[TimedFrame]:
        groups = [group for group in self._groups if {_GROUP, f"{_GROUP}.ID"} & group[2]]
        total = max(1, sum(cycles for _, cycles, _ in groups))
        if not groups:
            self._damage.notes.append("no CAN frames are logged in it (no group CAN_DataFrame)")
        merged = heapq.merge(*(self._frames(*one) for one in groups), key=lambda one: one.time_ns)
        for done, item in enumerate(merged):
            if not done % 256:
                self.position = self._size * done // total
            yield item
        self.position = self._size

    def _frames(self, index: int, cycles: int, names: set[str]) -> Iterator[TimedFrame]:
        notes = self._damage.notes
        for start in range(0, cycles, _CHUNK):
            count = min(_CHUNK, cycles - start)
            which = f"{start + 1} to {start + count}"
            try:
                with quiet():
                    rows = self._rows(index, start, count, names)
            except Exception as error:  # whatever a damaged file makes of it
                notes.append(f"frames {which} are damaged: {_short(error)}")
                continue
            bad = 0
            for stamp, can_id, data, length, extended, fd, received in rows:
                pure = can_id & 0x1FFFFFFF
                if length > len(data) or not is_possible(pure, bool(extended), length, bool(fd)):
                    bad += 1
                    continue
                frame = CanFrame(pure, data[:length], bool(extended), bool(fd))
                yield TimedFrame(stamp, frame, received)
            if bad:
                notes.append(f"{bad} frames of {which} are damaged")

    def _rows(self, index: int, start: int, count: int, names: set[str]) -> Iterator[Any]:
        """Time in ns, id, data, length, extended, FD and received of some frames of a group; any error."""
        import numpy as np

        columns: dict[str, Any] = {}
        for part in ("ID", "DataBytes", "DataLength", "IDE", "Dir", "EDL"):
            if (name := f"{_GROUP}.{part}") in names:
                signal = self._mdf.get(name, group=index, record_offset=start, record_count=count)
                columns[part] = signal.samples
                times = signal.timestamps

        def column(part: str, default: list[Any]) -> list[Any]:
            return columns[part].tolist() if part in columns else default

        ids = columns["ID"].astype(np.int64).tolist()
        content = columns["DataBytes"]
        if content.dtype.kind in "SO":  # of varying length, without the zeros at its end
            size = 64
            data = [bytes(row).ljust(size, b"\0") for row in content]
        else:
            size = content.shape[1]
            data = [bytes(row) for row in content.astype(np.uint8)]
        lengths = column("DataLength", [size] * count)
        return zip(
            np.rint(times * 1e9).astype(np.int64).tolist(),
            ids,
            data,
            lengths,
            column("IDE", [can_id > 0x7FF for can_id in ids]),
            column("EDL", [length > 8 for length in lengths]),
            [value in (0, b"Rx", "Rx") for value in column("Dir", [None] * count)],
            strict=False,
        )

    def close(self) -> None:
        """Close the file and asammdf's temporary one."""
        with quiet():
            self._mdf.close()


class Mf4File:
    """An MF4 file that is being written, by way of asammdf's temporary file in the target's folder.

    ``start_ns``: Unix time of time 0. ``provenance``: for the header, as it is known at the end. The file says nothing of the time of its
    writing, so that it is the same each time.
    """

    def __init__(self, path: Path, start_ns: int, provenance: Mapping[str, str]) -> None:
        self.module = asammdf_module()
        self._path = path
        self._start_ns = start_ns
        self._provenance = provenance
        with quiet():
            self.mdf: Any = self.module.MDF(version="4.10", temporary_folder=str(path.parent))
            moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=start_ns // 1000)
            self.mdf.header.start_time = moment
            self.mdf.header.abs_time = start_ns  # asammdf itself goes through a float

    def extend(self, group: int, times_ns: list[int], columns: list[Any]) -> None:
        """Add rows to a channel group: their times, which must not fall, and an array for each channel."""
        import numpy as np

        times = np.array(times_ns, dtype=np.int64) / SECOND_NS
        with quiet():
            self.mdf.extend(group, [(column, None) for column in (times, *columns)])

    def save(self) -> None:
        """Write the file and close it."""
        beside = self._path.with_name(f"{self._path.name}.mf4")  # asammdf insists on its suffix
        with quiet():
            try:
                if self._provenance:
                    lines = (f"{key}: {value}" for key, value in self._provenance.items())
                    self.mdf.header.comment = "\n".join(lines)
                Path(self.mdf.save(beside, overwrite=True, compression=2)).replace(self._path)
            finally:
                self.mdf.close()
                beside.unlink(missing_ok=True)
        with self._path.open("r+b") as file:
            _set_history_time(file, self._start_ns)

    def discard(self) -> None:
        """Close asammdf's temporary file."""
        with quiet():
            self.mdf.close()


class Mf4Writer:
    """Writes CAN frames as python-can's MF4Writer does, in chunks."""

    def __init__(self, path: Path, start_ns: int, provenance: Mapping[str, str]) -> None:
        import numpy as np

        self._file = file = Mf4File(path, start_ns, provenance)
        self._np = np
        self._dtype = np.dtype([(f"{_GROUP}.{name}", kind) for name, kind in _COLUMNS.items()])
        self._rows: list[tuple[Any, ...]] = []
        self._times: list[int] = []
        self._last = 0
        self.discard = file.discard
        with quiet():
            # a bus, CAN
            source = file.module.blocks.v4_blocks.SourceInformation(source_type=2, bus_type=2)
            samples, times = np.array([], dtype=self._dtype), np.array([], dtype="<f8")
            file.mdf.append(
                file.module.Signal(name=_GROUP, samples=samples, timestamps=times, source=source)
            )

    def write(self, time_ns: int, frame: CanFrame, received: bool) -> None:
        """Add a frame; what is earlier than its predecessor gets that one's time, for a master channel only rises."""
        self._last = max(self._last, time_ns)
        size = len(frame.data)
        dlc, data = FD_LENGTHS.index(size), frame.data.ljust(64, b"\0")
        extended, sent, fd = int(frame.extended), int(not received), int(frame.fd)
        self._rows.append((1, frame.can_id, extended, dlc, size, data, sent, fd, fd, 0))
        self._times.append(self._last)
        if len(self._rows) >= _CHUNK:
            self._flush()

    def _flush(self) -> None:
        np = self._np
        if not self._rows:
            return
        table = np.zeros(len(self._rows), dtype=self._dtype)
        for name, column in zip(_COLUMNS, zip(*self._rows, strict=True), strict=True):
            if name == "DataBytes":
                column = np.frombuffer(b"".join(column), dtype=np.uint8).reshape(-1, 64)
            table[f"{_GROUP}.{name}"] = column
        self._file.extend(0, self._times, [table])
        self._rows.clear()
        self._times.clear()

    def close(self) -> None:
        """Write the file."""
        self._flush()
        self._file.save()


def _opened(module: "ModuleType", path: Path) -> Any:
    """The MDF file; RunError where asammdf cannot read it."""
    hook = sys.unraisablehook
    sys.unraisablehook = lambda _: None  # what is half made complains when it is thrown away
    try:
        with quiet():
            try:
                mdf = module.MDF(os.fspath(path))
                mdf.header.start_time.timestamp()
                return mdf
            except Exception as error:  # whatever a damaged file makes of it
                reason = _short(error)
        gc.collect()
        raise RunError(f"{path}: cannot be read as MF4: {reason}.")
    finally:
        sys.unraisablehook = hook


def _set_history_time(file: IO[bytes], time_ns: int) -> None:
    """Give the file's history (blocks FH) this time: the header HD at 64 has the link to the first at its second place."""
    file.seek(64 + 24 + 8)
    address = int.from_bytes(file.read(8), "little")
    while address:
        file.seek(address + 24)
        following = int.from_bytes(file.read(8), "little")
        file.seek(address + 40)
        file.write(time_ns.to_bytes(8, "little"))
        address = following


def _short(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:160].rstrip(".")


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Warnings of numpy and asammdf are not for the one who converts."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
