"""MF4 bus logging by asammdf (an extra). python-can's writer takes thirty times as long."""

import contextlib
import logging
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.desk.recordings.can_logs.text import FD_LENGTHS
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.frames import CanFrame

if TYPE_CHECKING:
    from types import ModuleType

_ROWS = 8192
_NAME = "CAN_DataFrame"
_COLUMNS = {
    "BusChannel": "<u1",
    "ID": "<u4",
    "IDE": "<u1",
    "DLC": "<u1",
    "DataLength": "<u1",
    "DataBytes": "S64",
    "Dir": "<u1",
    "EDL": "<u1",
    "BRS": "<u1",
    "ESI": "<u1",
}
"""As python-can has them."""


def asammdf_module() -> "ModuleType":
    """asammdf. RunError where it is not installed."""
    try:
        import asammdf
    except ImportError:
        raise RunError("MF4 needs asammdf: pip install 'kontronik-can-gw[mf4]'") from None
    # what it says is said again by us, in one line
    logging.getLogger("asammdf").setLevel(logging.CRITICAL + 1)
    module: ModuleType = asammdf
    return module


class Mf4Log:
    """A log that is being written, by way of asammdf's temporary file in the target's folder.

    ``start_ns``: Unix time of time 0. ``provenance``: for the header, as it is known at the end.
    """

    def __init__(self, path: Path, start_ns: int, provenance: Mapping[str, str]) -> None:
        module = asammdf_module()
        import numpy as np

        self._path = path
        self._provenance = provenance
        self._times: list[int] = []
        self._rows: list[tuple[Any, ...]] = []
        self._last = 0
        self._written = np.dtype(",".join(_COLUMNS.values()))
        names = [f"{_NAME}.{name}" for name in _COLUMNS]
        kinds = [kind.replace("S64", "(64,)u1") for kind in _COLUMNS.values()]
        self._kind = np.dtype([*zip(names, kinds, strict=True)])
        # a bus, CAN
        source = module.blocks.v4_blocks.SourceInformation(source_type=2, bus_type=2)
        nothing, no_times = np.array([], dtype=self._kind), np.array([], dtype="<f8")
        with quiet():
            self._mdf: Any = module.MDF(version="4.10", temporary_folder=str(path.parent))
            moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=start_ns // 1000)
            self._mdf.header.start_time = moment
            self._mdf.header.abs_time = start_ns  # asammdf itself goes through a float
            signal = module.Signal(name=_NAME, samples=nothing, timestamps=no_times, source=source)
            self._group = self._mdf.append(signal)

    def write(self, time_ns: int, frame: CanFrame, received: bool) -> None:
        """Add a frame; one that is earlier than its predecessor gets that one's time, for a master channel only rises."""
        self._last = max(self._last, time_ns)
        self._times.append(self._last)
        size, fd = len(frame.data), int(frame.fd)
        head = (1, frame.can_id, int(frame.extended), FD_LENGTHS.index(size), size)
        self._rows.append((*head, frame.data, int(not received), fd, fd, 0))
        if len(self._rows) >= _ROWS:
            self._flush()

    def save(self) -> None:
        """Write the file and close it."""
        beside = self._path.with_name(f"{self._path.name}.mf4")  # asammdf insists on its suffix
        self._flush()
        with quiet():
            try:
                lines = (f"{key}: {value}" for key, value in self._provenance.items())
                self._mdf.header.comment = "\n".join(lines)
                Path(self._mdf.save(beside, overwrite=True, compression=2)).replace(self._path)
            finally:
                self._mdf.close()
                beside.unlink(missing_ok=True)

    def discard(self) -> None:
        """Close asammdf's temporary file."""
        with quiet():
            self._mdf.close()

    def _flush(self) -> None:
        if not self._rows:
            return
        import numpy as np

        times = np.array(self._times, dtype=np.int64) / 1_000_000_000
        rows = np.array(self._rows, dtype=self._written).view(self._kind)
        with quiet():
            self._mdf.extend(self._group, [(times, None), (rows, None)])
        self._rows, self._times = [], []


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
