"""Opens recordings of every kind: captures, logs of CAN frames, and plain UART bytes of one ESC.

A capture (.kcap) is played through the gateway's core with the recorded clock. Plain UART bytes
have no times: their live frames are assumed to arrive at a fixed rate. ``open_input`` finds the
format from the content.

A pipe is read as its data arrive if it carries UART bytes or candump text. Other formats are copied
to a temporary file first.
"""

import io
import shutil
import tempfile
from contextlib import ExitStack
from pathlib import Path

from kontronik_can_gw.capture.format import MAGIC, SUFFIX
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.recordings.bytes_input import BytesInput
from kontronik_can_gw.desk.recordings.capture_input import CaptureInput
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc
from kontronik_can_gw.desk.recordings.log_input import (
    BYTES,
    CAPTURE,
    STREAMED,
    CanLogInput,
    format_of,
    log_format,
)
from kontronik_can_gw.desk.recordings.recording import Input
from kontronik_can_gw.desk.recordings.stream import HEAD, Stream, open_stream
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.esc.protocols import PROTOCOLS

__all__ = ["BytesInput", "CanLogInput", "CaptureInput", "Input", "open_input"]


def open_input(path: Path, layout: BusLayout | None = None) -> Input:
    """Open a recording. Raises UserError if it is missing, unreadable or not a recording.

    ``path``: a file, a named pipe, or ``-`` for standard input. A folder of captures, or the common
    prefix of their names, stands for all parts of one run.

    ``layout``: the layout of the frames in a CAN log, and of the frames made from plain bytes. The
    default is the shipped DBC of one ESC. For a capture it replaces the recorded layout.
    """
    stream = open_stream(path)
    if stream is not None:
        return _open_stream(stream, layout)
    parts = _parts(path)
    if parts is not None:
        return CaptureInput(parts, layout)
    return _open_file(path, layout)


def open_bytes(path: Path, layout: BusLayout | None) -> Input:
    """Open a file or a pipe as the bytes of one ESC, regardless of its content.

    Raises UserError if it is missing or cannot be opened. If it is not a recording, ``refusal`` is
    set after its end was read.
    """
    stream = open_stream(path)
    if stream is None and not path.exists():
        raise _missing(path)
    return BytesInput(path, layout, stream)


def _open_file(path: Path, layout: BusLayout | None) -> Input:
    try:
        with path.open("rb") as file:
            head = file.read(HEAD)
    except OSError as error:
        raise UserError(f"{path}: cannot be opened: {error.strerror}.") from None
    found = format_of(head, str(path), is_capture=path.suffix == SUFFIX)
    if found == CAPTURE:
        return CaptureInput([path], layout)
    if found == BYTES:
        return BytesInput(path, layout)
    layout = layout or layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))
    return CanLogInput(path, layout, found)


# --- pipes


def _open_stream(stream: Stream, layout: BusLayout | None) -> Input:
    with ExitStack() as on_error:
        on_error.callback(stream.close)
        found = _format_of_stream(stream)
        if found == BYTES:
            opened: Input = BytesInput(Path(stream.name), layout, stream)
        elif found in STREAMED:
            layout = layout or layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))
            opened = CanLogInput(Path(stream.name), layout, found, stream)
        else:
            return _open_spooled(stream, layout)
        on_error.pop_all()
    return opened


def _format_of_stream(stream: Stream) -> str:
    """Wait until the format is certain.

    A whole line of a log, or one intact frame of an ESC, is enough.
    """
    decoder = PROTOCOLS[0].make()
    done = 0
    while len(stream.head) < HEAD and stream.look():
        head = stream.head
        if head.startswith(MAGIC):
            return CAPTURE
        whole_lines = head[: head.rfind(b"\n") + 1]
        found = log_format(whole_lines or head[:8])
        if found is not None:
            return found
        if decoder.feed(head[done:]):
            return BYTES
        done = len(head)
    return format_of(stream.head, stream.name)


def _open_spooled(stream: Stream, layout: BusLayout | None) -> Input:
    """Copy a stream to a temporary file without a name, and open that."""
    file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115  stays open with the recording
    with ExitStack() as on_error:
        on_error.enter_context(file)
        try:
            shutil.copyfileobj(io.BufferedReader(stream, HEAD), file, HEAD)
        except OSError as error:
            raise RunError(
                f"{tempfile.gettempdir()}: {stream.name} cannot be stored: "
                f"{error.strerror}. Set TMPDIR to a folder with more space."
            ) from None
        path = Path(f"/proc/self/fd/{file.fileno()}")
        try:
            opened = _open_file(path, layout)
        except UserError as error:
            problems = [problem.replace(str(path), stream.name) for problem in error.problems]
            raise type(error)(*problems) from None
        opened.name = stream.name
        opened.resources.enter_context(on_error.pop_all())
    return opened


# --- captures of several parts


def _parts(path: Path) -> list[Path] | None:
    """Return the captures in a folder or with a common prefix. None if the path is a file."""
    if path.is_dir():
        found = sorted(path.glob(f"*{SUFFIX}"))
        if not found:
            raise UserError(f"{path}: has no captures (*{SUFFIX})")
    elif not path.exists():
        captures = path.parent.glob(f"*{SUFFIX}") if path.name else ()
        found = sorted(part for part in captures if part.name.startswith(path.name))
        if not found:
            raise _missing(path)
    else:
        return None
    names = [part.name.removesuffix(SUFFIX) for part in found]
    runs = list(dict.fromkeys(name.rpartition("-")[0] for name in names))
    if len(runs) > 1:
        raise UserError(
            f"{path}: has captures of {len(runs)} runs. "
            f"Give the common prefix of one run: {', '.join(runs[-8:])}"
        )
    return found


def _missing(path: Path) -> UserError:
    return UserError(f"{path}: does not exist.")
