"""Recordings of every kind as one thing: CAN frames in order of time, and rows of values.

A capture (.kcap) goes through the gateway's core with the recorded clock. Plain UART bytes have no time: their live frames are taken to
come at a fixed rate. CAN logs are frames already. ``open_input`` finds out what a file is by its content.
"""

import os
import shutil
import stat
import tempfile
from pathlib import Path, PosixPath
from typing import IO

from kontronik_can_gw.capture.format import MAGIC, SUFFIX
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.recordings.bytes_input import UART_MAGIC, BytesInput
from kontronik_can_gw.desk.recordings.can_logs.log import NAMES, SUFFIXES, log_format
from kontronik_can_gw.desk.recordings.capture_input import CaptureInput
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc
from kontronik_can_gw.desk.recordings.log_input import CanLogInput
from kontronik_can_gw.desk.recordings.recording import Input
from kontronik_can_gw.errors import RunError, UserError

__all__ = ["BytesInput", "CanLogInput", "CaptureInput", "Input", "open_input"]

_HEAD = 1 << 16


def open_input(path: Path, layout: BusLayout | None = None) -> Input:
    """Open a recording. UserError for other files, RunError for what cannot be read.

    ``path``: a file; a folder of captures, or the beginning of the names of one run's, for all parts of that run; a pipe, or ``-`` for
    standard input, which is read to its end first. ``layout``: of CAN logs and plain
    bytes, the shipped one of one ESC if None; for a capture it replaces the recorded one.
    """
    path = spooled(path)
    parts = _parts(path)
    if parts is not None:
        return CaptureInput(parts, layout)
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except OSError as error:
        raise RunError(f"{path}: cannot be opened: {error.strerror}.") from None
    if not head:
        raise UserError(f"{path}: is empty")
    if MAGIC in head or path.suffix == SUFFIX:
        return CaptureInput([path], layout)
    if (found := log_format(head, path.suffix)) is not None:
        layout = layout or layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))
        return CanLogInput(path, layout, found)
    if UART_MAGIC in head:
        return BytesInput(path, layout)
    if (called := SUFFIXES.get(path.suffix.lower())) is not None:
        raise UserError(
            f"{path}: is no {NAMES[called]}, whatever its name says, and no other recording"
        )
    raise UserError(
        f"{path}: is no capture, no CAN log (candump, ASC, BLF, TRC, MF4), and has no telemetry of an ESC in its first {_HEAD // 1024} kB"
    )


def open_bytes(path: Path, layout: BusLayout | None) -> Input:
    """Open the bytes of one ESC, whatever is in them."""
    return BytesInput(spooled(path), layout)


def _parts(path: Path) -> list[Path] | None:
    """The captures that a folder, or the beginning of a name, means; None for a plain file."""
    if path.is_dir():
        found = sorted(path.glob(f"*{SUFFIX}"))
        if not found:
            raise UserError(f"{path}: has no captures (*{SUFFIX})")
    elif not path.exists():
        every = path.parent.glob(f"*{SUFFIX}") if path.name else ()
        found = sorted(part for part in every if part.name.startswith(path.name))
        if not found:
            raise RunError(f"{path}: there is no such file.")
    else:
        return None
    runs = list(dict.fromkeys(p.name.removesuffix(SUFFIX).rpartition("-")[0] for p in found))
    if len(runs) > 1:
        raise UserError(
            f"{path}: has captures of {len(runs)} runs; give the beginning of the names of one: {', '.join(runs[-8:])}"
        )
    return found


# --- what can be read only once


class SpooledPath(PosixPath):
    """A path that is shown under another name. It keeps its file open: that exists no longer than this."""

    shown = ""
    kept: IO[bytes] | None = None

    def __str__(self) -> str:
        return self.shown or super().__str__()

    def __fspath__(self) -> str:
        return super().__str__()

    @property
    def name(self) -> str:
        return self.shown.rpartition("/")[2] or super().name


def spooled(path: Path) -> Path:
    """All that comes of ``-`` or of a pipe, in a temporary file without a name; any other path as it is.

    UserError for a device, RunError where there is no room.
    """
    is_input = str(path) == "-"
    shown = "standard input" if is_input else str(path)
    try:
        about = os.fstat(0) if is_input else path.stat()
    except (OSError, ValueError):
        return path
    kind = stat.S_IFMT(about.st_mode)
    if not is_input and kind in (stat.S_IFREG, stat.S_IFDIR):
        return path
    is_pipe = kind in (stat.S_IFIFO, stat.S_IFREG, stat.S_IFSOCK)
    if not is_pipe and about.st_rdev != Path(os.devnull).stat().st_rdev:
        # it is not opened: it might be the port of an ESC
        raise UserError(
            f"{shown}: is a terminal or another device. Give a file, or a pipe that brings a recording."
        )
    file = tempfile.TemporaryFile()  # noqa: SIM115  as long as its path
    try:
        with open(0 if is_input else path, "rb", closefd=not is_input) as stream:
            shutil.copyfileobj(stream, file)
        file.flush()
    except OSError as error:
        raise RunError(
            f"{shown}: cannot be read into {tempfile.gettempdir()} (TMPDIR): {error.strerror}."
        ) from None
    made = SpooledPath(f"/proc/self/fd/{file.fileno()}")
    made.shown, made.kept = shown, file
    return made
