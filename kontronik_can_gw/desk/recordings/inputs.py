"""Recordings of every kind as one thing: CAN frames in order of time, and rows of values.

A capture (.kcap) goes through the gateway's core with the recorded clock. Plain UART bytes have no time: their live frames are taken to
come at a fixed rate. CAN logs are frames already. ``open_input`` finds out what a file is by its content.
"""

from pathlib import Path

from kontronik_can_gw.capture.format import MAGIC, SUFFIX
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.recordings.bytes_input import UART_MAGIC, BytesInput
from kontronik_can_gw.desk.recordings.capture_input import CaptureInput
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc
from kontronik_can_gw.desk.recordings.log_input import CanLogInput, candump_advice, log_format
from kontronik_can_gw.desk.recordings.recording import Input
from kontronik_can_gw.errors import RunError, UserError

__all__ = ["BytesInput", "CanLogInput", "CaptureInput", "Input", "open_input"]

_HEAD = 1 << 16


def open_input(path: Path, layout: BusLayout | None = None) -> Input:
    """Open a recording. UserError for other files, RunError for what cannot be read.

    ``path``: a file; a folder of captures, or the beginning of the names of one run's, for all parts of that run. ``layout``: of CAN
    logs and plain bytes, the shipped one of one ESC if None; for a capture it replaces the recorded one.
    """
    _check_kind(path)
    parts = _parts(path)
    if parts is not None:
        return CaptureInput(parts, layout)
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except OSError as error:
        raise RunError(f"{path}: cannot be opened: {error.strerror}.") from None
    if not head.strip():
        raise UserError(f"{path}: is empty")
    if MAGIC in head or path.suffix == SUFFIX:
        return CaptureInput([path], layout)
    if (found := log_format(head)) is not None:
        layout = layout or layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))
        return CanLogInput(path, layout, found)
    if UART_MAGIC in head:
        return BytesInput(path, layout)
    if (advice := candump_advice(head)) is not None:
        raise UserError(f"{path}: {advice}")
    raise UserError(
        f"{path}: is no capture, no CAN log (candump, ASC, BLF, TRC, MF4), and has no telemetry of an ESC in its first {_HEAD // 1024} kB"
    )


def open_bytes(path: Path, layout: BusLayout | None) -> Input:
    """Open the bytes of one ESC, whatever is in them."""
    _check_kind(path)
    return BytesInput(path, layout)


def _check_kind(path: Path) -> None:
    """UserError for a pipe or a device. None is opened: it might be the port of an ESC."""
    if str(path) == "-" or (path.exists() and not path.is_file() and not path.is_dir()):
        raise UserError(
            f"{path}: is no file. What comes through a pipe is written into one first: COMMAND > FILE"
        )


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
