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

from kontronik_can_gw.desk.recordings.can_logs.record import (
    FD_LENGTHS,
    OLDEST_WALL_S,
    SECOND_NS,
    Damage,
    LogFrame,
    is_possible,
)
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.frames import CanFrame

if TYPE_CHECKING:
    from types import ModuleType

_CHUNK = 8192
_GROUP = "CAN_DataFrame"
_ERRORS, _REMOTES = "CAN_ErrorFrame", "CAN_RemoteFrame"


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
        if not self._is_bus_log():
            self.close()
            raise UserError(
                f"{path}: is a table of values (an MF4 measurement), no log of a CAN bus. Give the recording it was made of."
            )
        start: datetime = self._mdf.header.start_time
        stored = int(self._mdf.header.abs_time)
        if start.timestamp() >= OLDEST_WALL_S:
            # a file may say local time, which asammdf works out; the exact fraction of a second is in the number
            self.wall_start_ns = _seconds(start, stored) * SECOND_NS + stored % SECOND_NS

    def _is_bus_log(self) -> bool:
        """False where it holds values, but nothing of a bus."""
        bus = (_GROUP, f"{_GROUP}.ID", _ERRORS, _REMOTES)
        groups = [group for group in self._mdf.groups if int(group.channel_group.cycles_nr)]
        return not groups or any(
            channel.name in bus for group in groups for channel in group.channels
        )

    def __iter__(self) -> Iterator[LogFrame]:
        groups = []
        total = 0
        for index, group in enumerate(self._mdf.groups):
            names = {channel.name for channel in group.channels}
            cycles = int(group.channel_group.cycles_nr)
            if _GROUP in names or f"{_GROUP}.ID" in names:
                groups.append(self._frames(index, cycles, names))
                total += cycles
            elif cycles and _ERRORS in names:
                self._damage.skip("error frames", cycles)
            elif cycles and _REMOTES in names:
                self._damage.skip("remote frames", cycles)
        if not groups:
            self._damage.notes.append("no CAN frames are logged in it (no group CAN_DataFrame)")
        for done, item in enumerate(heapq.merge(*groups, key=lambda item: item.time_ns)):
            if not done % 256:
                self.position = self._size * done // max(total, 1)
            yield item
        self.position = self._size

    def _frames(self, index: int, cycles: int, names: set[str]) -> Iterator[LogFrame]:
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
            for stamp, can_id, data, length, extended, fd, received, channel in rows:
                pure = can_id & 0x1FFFFFFF
                if length > len(data) or not is_possible(pure, bool(extended), length, bool(fd)):
                    bad += 1
                    continue
                frame = CanFrame(pure, data[:length], bool(extended), bool(fd))
                yield LogFrame(stamp, frame, received, str(channel))
            if bad:
                notes.append(f"{bad} frames of {which} are damaged")

    def _rows(self, index: int, start: int, count: int, names: set[str]) -> Iterator[Any]:
        """Time in ns, id, data, length, extended, FD, received and channel of some frames of a group; any error."""
        import numpy as np

        columns: dict[str, Any] = {}
        for part in ("ID", "DataBytes", "DataLength", "IDE", "Dir", "EDL", "BusChannel"):
            name = f"{_GROUP}.{part}"
            if name in names:
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
            column("BusChannel", [1] * count),
            strict=False,
        )

    def close(self) -> None:
        """Close the file and asammdf's temporary one."""
        with quiet():
            self._mdf.close()


class Mf4Writer:
    """Writes CAN frames as python-can's MF4Writer does, in chunks. ``start_ns``: Unix time of time 0; None: 1970."""

    def __init__(
        self, path: Path, start_ns: int | None, provenance: Mapping[str, str] | None = None
    ) -> None:
        module = asammdf_module()
        import numpy as np

        self._path = path
        self._provenance = provenance or {}
        self._np = np
        kinds = {
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
        self._dtype = np.dtype([(f"{_GROUP}.{name}", kind) for name, kind in kinds.items()])
        self._rows: list[tuple[Any, ...]] = []
        self._times: list[float] = []
        self._last = 0
        with quiet():
            self._mdf: Any = module.MDF(version="4.10", temporary_folder=str(path.parent))
            set_start(self._mdf, start_ns or 0)
            # a bus, CAN
            source = module.blocks.v4_blocks.SourceInformation(source_type=2, bus_type=2)
            self._mdf.append(
                module.Signal(
                    name=_GROUP,
                    samples=np.array([], dtype=self._dtype),
                    timestamps=np.array([], dtype="<f8"),
                    source=source,
                )
            )

    def write(self, time_ns: int, frame: CanFrame, received: bool) -> None:
        """Add a frame; what is earlier than its predecessor gets that one's time, for a master channel only rises."""
        self._last = max(self._last, time_ns)
        size = len(frame.data)
        dlc, data = FD_LENGTHS.index(size), frame.data.ljust(64, b"\0")
        extended, sent, fd = int(frame.extended), int(not received), int(frame.fd)
        self._rows.append((1, frame.can_id, extended, dlc, size, data, sent, fd, fd, 0))
        self._times.append(self._last / SECOND_NS)
        if len(self._rows) >= _CHUNK:
            self._flush()

    def _flush(self) -> None:
        np = self._np
        if not self._rows:
            return
        table = np.zeros(len(self._rows), dtype=self._dtype)
        for name, column in zip(
            self._dtype.names or (), zip(*self._rows, strict=True), strict=True
        ):
            if name.endswith("DataBytes"):
                table[name] = np.frombuffer(b"".join(column), dtype=np.uint8).reshape(-1, 64)
            else:
                table[name] = column
        with quiet():
            self._mdf.extend(0, [(np.array(self._times), None), (table, None)])
        self._rows.clear()
        self._times.clear()

    def close(self) -> None:
        """Write the file."""
        self._flush()
        save_mf4(self._mdf, self._path, self._provenance)

    def discard(self) -> None:
        """Close asammdf's temporary file."""
        with quiet():
            self._mdf.close()


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


def set_start(mdf: Any, start_ns: int) -> None:
    """Unix time in ns of the recording's start, as UTC. asammdf itself goes through a float, which is not exact."""
    mdf.header.start_time = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(
        microseconds=start_ns // 1000
    )
    mdf.header.abs_time = start_ns


def save_mf4(mdf: Any, path: Path, provenance: Mapping[str, str]) -> None:
    """Save and close. ``provenance``: for the header, as it is known at the end.

    The file says nothing of the time of its writing, so that it is the same each time."""
    with quiet():
        try:
            if provenance:
                mdf.header.comment = "\n".join(
                    f"{key}: {value}" for key, value in provenance.items()
                )
            start = mdf.header.abs_time
            beside = path.with_name(f"{path.name}.mf4")  # asammdf insists on its suffix
            Path(mdf.save(beside, overwrite=True, compression=2)).replace(path)
        finally:
            mdf.close()
            beside.unlink(missing_ok=True)
    with path.open("r+b") as file:
        _set_history_time(file, start)


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


def _seconds(moment: datetime, stored_ns: int) -> int:
    """Whole seconds of a moment that asammdf may have rounded in its last digits."""
    return round(moment.timestamp() - stored_ns % SECOND_NS / SECOND_NS)


def _short(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:160].rstrip(".")


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Warnings of numpy and asammdf are not for the one who converts."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
