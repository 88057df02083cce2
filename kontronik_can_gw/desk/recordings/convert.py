"""Converts a recording to a table, a log of CAN frames or plain bytes.

Each conversion returns a text that describes the written data, or None if the recording has no such
data. In that case nothing was written. Messages are the work of cli/convert.py.
"""

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Self

from kontronik_can_gw.desk.recordings.recording import counted
from kontronik_can_gw.errors import RunError

if TYPE_CHECKING:
    from kontronik_can_gw.desk.recordings.fields import Choice, Table
    from kontronik_can_gw.desk.recordings.recording import Input

TABLES = ("csv", "jsonl", "parquet")
LOGS = {"candump": "candump", "asc": "asc", "blf": "blf", "trc": "trc", "mf4-log": "mf4"}
BYTES = "bin"
FORMATS = (*TABLES, *LOGS, BYTES)
SUFFIXES = {
    ".csv": "csv",
    ".jsonl": "jsonl",
    ".ndjson": "jsonl",
    ".parquet": "parquet",
    ".log": "candump",
    ".candump": "candump",
    ".asc": "asc",
    ".blf": "blf",
    ".trc": "trc",
    ".bin": BYTES,
}
ON_SCREEN = ("csv", "jsonl", "candump", "asc", "trc")
"""Formats that can be written to standard output or a pipe: they are text, written in order."""


class Output:
    """The destination of converted data: a file, or standard output if ``target`` is None.

    A file is written as ``NAME.part`` beside its destination. It is renamed at the end if
    ``is_whole`` was set. Pipes and devices such as /dev/stdout are written directly. ``what`` is
    the noun for the destination in messages.
    """

    keeps_part = False
    """True if ``NAME.part`` is kept when writing fails, because the input cannot be read again."""

    def __init__(self, target: Path | None, what: str = "file") -> None:
        self.is_whole = False
        self.watch: Callable[[Iterable[Any]], Iterable[Any]] = iter
        """All converted data pass through this, block by block."""
        self._target = target
        self._what = what
        self._file: IO[bytes] | None = None
        self._part: Path | None = None
        """The file that may have been created."""

    @property
    def kept_part(self) -> Path | None:
        """The file with the data so far, if it was kept after a failure."""
        if self.keeps_part and self._part is not None and self._part.exists():
            return self._part
        return None

    def open(self) -> IO[bytes]:
        """Open the file for writing. Raises RunError if that fails."""
        target = self._target
        if target is None:
            return sys.stdout.buffer
        try:
            if target.exists() and not target.is_file():
                self._file = target.open("wb")
            else:
                part = Path(os.path.realpath(target)).with_name(f"{target.name}.part")
                part.unlink(missing_ok=True)
                self._part = part  # before the file is opened, because a signal may interrupt
                self._file = part.open("xb")  # does not follow a link that another user made
        except OSError as error:
            raise RunError(
                f"{target}: cannot be written: {error.strerror}. Give another {self._what}."
            ) from None
        return self._file

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        is_kept = kind is None and self.is_whole
        has_failed = kind is not None
        if kind is None and self._target is None:
            sys.stdout.flush()
        try:
            if self._file is not None:
                # the disk may be full, which does not matter if the file is not kept
                ignored = () if is_kept else (OSError,)
                with suppress(*ignored):
                    self._close(self._file, is_kept)
            if is_kept and self._part is not None and self._target is not None:
                self._part.replace(os.path.realpath(self._target))
        except BaseException:
            has_failed = True
            raise
        finally:
            if self._part is not None and not (has_failed and self.keeps_part):
                self._part.unlink(missing_ok=True)

    def _close(self, file: IO[bytes], is_kept: bool) -> None:
        try:
            if is_kept and self._part is not None:
                file.flush()
                os.fsync(file.fileno())
        finally:
            file.close()  # otherwise Python tries again when it exits, and prints an error


def to_table(recording: "Input", out: Output, form: str, choice: "Choice") -> str | None:
    """Convert a recording to a table. ``form`` is one of TABLES."""
    from kontronik_can_gw.desk.recordings.fields import Table
    from kontronik_can_gw.desk.recordings.recording import part_of

    found = part_of(recording.blocks(choice.columns), choice.start_ns, choice.end_ns)
    if found is None:
        return None
    origin_ns, blocks = found
    recording.begin_ns = origin_ns
    fields = [recording.fields[index] for index in choice.columns]
    has_utc = recording.wall_ns(origin_ns) is not None
    has_trust = has_utc and recording.trust.is_known
    table = Table(fields, has_utc, has_trust, origin_ns, recording.provenance)
    file = out.open()
    _flush_before_waits(recording, file)
    writer = _table_writer(file, form, table)
    count, last_ns = _write_all(writer, blocks, out)
    rows = counted(count, "row")
    values = counted(len(fields), "value")
    seconds = (last_ns - origin_ns) / 1e9
    return f"{rows} of {values}, up to {seconds:.3f} s"


def _table_writer(file: IO[bytes], form: str, table: "Table") -> Any:
    """Return a writer of blocks of rows. Raises RunError if a library is missing."""
    from kontronik_can_gw.desk.recordings.tables import ParquetTable, TextTable

    if form == "parquet":
        return ParquetTable(file, table)
    return TextTable(file, table, is_json=form == "jsonl")


def to_log(
    recording: "Input",
    out: Output,
    form: str,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> str | None:
    """Convert a recording to a log of CAN frames. ``form`` is a key of LOGS.

    Frames from ``start_ns`` to ``end_ns`` after the recording's first frame are written.
    """
    from kontronik_can_gw.desk.recordings.can_logs.writer import CanLogWriter
    from kontronik_can_gw.desk.recordings.recording import part_of

    found = part_of(recording.batches(), start_ns, end_ns)
    if found is None:
        return None
    origin_ns, batches = found
    recording.begin_ns = origin_ns
    wall_ns = recording.wall_ns(origin_ns)
    file = out.open()
    _flush_before_waits(recording, file)
    writer = CanLogWriter(file, form, wall_ns, origin_ns, recording.channel, recording.provenance)
    count, last_ns = _write_all(writer, batches, out)
    frames_written = counted(count - sum(writer.left_out.values()), "CAN frame")
    seconds = (last_ns - origin_ns) / 1e9
    summary = f"{frames_written}, up to {seconds:.3f} s"
    for what, number in writer.left_out.items():
        summary += f"; {counted(number, what)} left out, which {form} does not support"
    if writer.channels.changes:
        summary += f"; channels: {writer.channels.changes}"
    return summary


def _flush_before_waits(recording: "Input", file: IO[bytes]) -> None:
    """Write buffered data whenever the recording is a pipe that has no more data at the moment."""
    if recording.stream is not None:
        recording.stream.before_wait = file.flush


def _write_all(writer: Any, items: Iterator[Any], out: Output) -> tuple[int, int]:
    """Write blocks of rows or batches of frames. Return the number of items and the last time."""
    from kontronik_can_gw.desk.recordings.recording import time_at

    count = 0
    last_ns = 0
    try:
        for some in out.watch(items):
            writer.write(some)
            count += len(some)
            last_ns = time_at(some, -1)
        writer.close()
    except BaseException:
        writer.discard()
        raise
    out.is_whole = True
    return count, last_ns


def to_bytes(recording: "Input", out: Output, esc: int) -> str | None:
    """Convert a recording to the plain bytes of one ESC."""
    file = out.open()
    _flush_before_waits(recording, file)
    count = 0
    for data in out.watch(recording.esc_bytes(esc)):
        file.write(data)
        count += len(data)
    if not count:
        return None
    out.is_whole = True
    return f"{counted(count, 'byte')} of {recording.bus.escs[esc].name}"
