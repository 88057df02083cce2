"""MF4 files by asammdf (an extra), written so that they say nothing of the time of their writing."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from kontronik_can_gw.errors import RunError

if TYPE_CHECKING:
    from types import ModuleType

_ROWS = 8192


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


class Mf4File:
    """An MF4 file that is being written, by way of asammdf's temporary file in the target's folder.

    ``start_ns``: Unix time of time 0. ``provenance``: for the header, as it is known at the end.
    """

    def __init__(self, path: Path, start_ns: int, provenance: Mapping[str, str]) -> None:
        self.module = asammdf_module()
        self._path = path
        self._start_ns = start_ns
        self._provenance = provenance
        self._groups: list[Mf4Group] = []
        with quiet():
            self._mdf: Any = self.module.MDF(version="4.10", temporary_folder=str(path.parent))
            moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=start_ns // 1000)
            self._mdf.header.start_time = moment
            self._mdf.header.abs_time = start_ns  # asammdf itself goes through a float

    def group(self, signals: Sequence[Any], name: str) -> "Mf4Group":
        """A channel group of these signals, which have no samples yet."""
        with quiet():
            words = {"acq_name": name, "comment": name, "common_timebase": True}
            number = self._mdf.append(list(signals), **words)
        return self._add(number, [one.samples.dtype for one in signals])

    def structure(self, signal: Any, kind: Any) -> "Mf4Group":
        """A channel group of one structure, of which a row is written as ``kind``, of the same size."""
        with quiet():
            return self._add(self._mdf.append(signal), [signal.samples.dtype], [kind])

    def _add(
        self, number: int, types: Sequence[Any], written: Sequence[Any] | None = None
    ) -> "Mf4Group":
        self._groups.append(Mf4Group(self._mdf, number, types, written or types))
        return self._groups[-1]

    def save(self) -> None:
        """Write the file and close it."""
        beside = self._path.with_name(f"{self._path.name}.mf4")  # asammdf insists on its suffix
        for group in self._groups:
            group.flush()
        with quiet():
            try:
                if self._provenance:
                    lines = (f"{key}: {value}" for key, value in self._provenance.items())
                    self._mdf.header.comment = "\n".join(lines)
                Path(self._mdf.save(beside, overwrite=True, compression=2)).replace(self._path)
            finally:
                self._mdf.close()
                beside.unlink(missing_ok=True)
        with self._path.open("r+b") as file:
            _set_history_time(file, self._start_ns)

    def discard(self) -> None:
        """Close asammdf's temporary file."""
        with quiet():
            self._mdf.close()


class Mf4Group:
    """A channel group. Its rows go to asammdf many at once."""

    def __init__(self, mdf: Any, number: int, types: Sequence[Any], written: Sequence[Any]) -> None:
        self._mdf = mdf
        self._number = number
        self._types = [*zip(types, written, strict=True)]
        self._times: list[int] = []
        self._rows: list[Sequence[Any]] = []
        self._last = -(1 << 62)

    def write(self, time_ns: int, values: Sequence[Any]) -> None:
        """Add a row; what is earlier than its predecessor gets that one's time, for a master channel only rises."""
        self._last = max(self._last, time_ns)
        self._times.append(self._last)
        self._rows.append(values)
        if len(self._rows) >= _ROWS:
            self.flush()

    def flush(self) -> None:
        """Hand what has gathered to asammdf."""
        if not self._rows:
            return
        import numpy as np

        times = np.array(self._times, dtype=np.int64) / 1_000_000_000
        columns = [
            np.array(list(column), dtype=written).view(kind)
            for column, (kind, written) in zip(
                zip(*self._rows, strict=True), self._types, strict=True
            )
        ]
        with quiet():
            self._mdf.extend(self._number, [(column, None) for column in (times, *columns)])
        self._rows, self._times = [], []


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


def short(error: Exception) -> str:
    """A library's complaint in a few words."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:160].rstrip(".")


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Warnings of numpy and asammdf are not for the one who converts."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
