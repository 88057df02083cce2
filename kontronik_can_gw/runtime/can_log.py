"""A CAN log beside a capture, by python-can's writers, so that every tool reads it. Called by the recorder's thread only.

MF4 is none of them: its writer wants asammdf in the gateway's process and seconds at the end. ``convert`` makes it from a capture.
"""

import contextlib
import os
from importlib import import_module
from pathlib import Path
from typing import Any

from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.lean import without_asammdf

SUFFIXES = {"candump": ".log", "asc": ".asc", "blf": ".blf", "trc": ".trc"}
_WRITERS = {
    "candump": "CanutilsLogWriter",
    "asc": "ASCWriter",
    "blf": "BLFWriter",
    "trc": "TRCWriter",
}


class CanLog:
    """One log. OSError where it cannot be written."""

    def __init__(self, path: Path, kind: str, channel: str) -> None:
        self._path = path
        # never over something else, nor through a link
        os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o640))
        with without_asammdf():
            can = import_module("can")
        self._message = can.Message
        writer = getattr(import_module("can.io"), _WRITERS[kind])
        options: dict[str, Any] = {"channel": channel} if kind == "candump" else {}
        self._writer = writer(str(path), **options)
        # candump names the interface, the others count channels from 1
        self._channel: str | int = channel if kind == "candump" else 0

    @property
    def exists(self) -> bool:
        """False where somebody removed the file."""
        return self._path.exists()

    def add(self, frame: CanFrame, unix_ns: int, received: bool) -> None:
        """A frame at a Unix time; it is kept to the microsecond."""
        self._writer.on_message_received(
            self._message(
                timestamp=(unix_ns + 500) // 1000 / 1e6,
                arbitration_id=frame.can_id,
                is_extended_id=frame.extended,
                data=b"" if frame.remote else frame.data,
                dlc=len(frame.data),
                is_remote_frame=frame.remote,
                is_fd=frame.fd,
                is_rx=received,
                channel=self._channel,
            )
        )

    def flush(self) -> None:
        """Force to the disk what the writer hands over before its end: a candump log line by line, a BLF next to nothing."""
        file = getattr(self._writer, "file", None)
        if file is not None:
            file.flush()
            os.fdatasync(file.fileno())

    def close(self) -> None:
        """Close in good order: a BLF file is readable only then."""
        self._writer.stop()

    def abandon(self) -> None:
        """Close whatever happens."""
        with contextlib.suppress(Exception):
            self._writer.stop()
