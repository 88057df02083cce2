"""Converts a recording to a table, a log of CAN frames or plain bytes.

Each conversion returns a text that describes the written data, or None if the recording has no such
data. In that case nothing was written. Messages are the work of cli/convert.py.
"""

import errno
import fcntl
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Self

from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.printable import counted
from kontronik_can_gw.runtime.files.disk import is_locked

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
_STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
ON_SCREEN = ("csv", "jsonl", "candump", "asc", "trc")
"""Formats that can be written to standard output or a pipe: they are text, written in order."""


class OutputFile:
    """The destination of converted data: a file, or standard output if ``target`` is None.

    1. A file is written as ``NAME.part`` beside its destination. It is renamed at the end if
       ``is_whole`` was set.
    2. The part is locked while it is being written. A part that exists is never overwritten,
       except with ``force`` if it is not locked: it may have the rows of an earlier conversion.
    3. A symbolic link is replaced, never followed. Pipes and devices such as /dev/stdout are
       written directly.
    """

    is_part_kept = False
    """True if ``NAME.part`` is kept when writing fails, because the input cannot be read again."""

    def __init__(self, target: Path | None, *, force: bool = False) -> None:
        self.is_whole = False
        self.watch: Callable[[Iterable[Any]], Iterable[Any]] = iter
        """All converted data pass through this, block by block."""
        self._target = target
        self._force = force
        self._file: IO[bytes] | None = None
        self._part: Path | None = None
        """The file that this output has created."""

    @property
    def kept_part(self) -> Path | None:
        """The file with the data so far, if it was kept after a failure."""
        if self.is_part_kept and self._part is not None and self._part.exists():
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
                self._file = self._open_part(part_beside(target))
        except OSError as error:
            raise RunError(
                f"{target}: cannot be written: {error.strerror}. Give another file."
            ) from None
        return self._file

    def _open_part(self, part: Path) -> IO[bytes]:
        """Create and lock the part. Raises UserError if it exists and must not be replaced."""
        check_part(part, force=self._force)
        if self._force:
            part.unlink(missing_ok=True)
        # A signal waits until it is known that the part is ours, so that it is removed.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, _STOPS)
        try:
            file = part.open("xb")  # does not follow a link that another user made
            self._part = part
        except FileExistsError:  # another process was faster
            check_part(part, force=False)
            raise
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        # Some file systems have no locks. Then another process relies on the name.
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return file

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None and self._target is None:
            sys.stdout.flush()
        has_failed = kind is not None
        try:
            if kind is None and self.is_whole:
                has_failed = True  # if it does not reach its end
                self._finish()
        finally:
            # The lock ends when the file is closed, so the name is removed before.
            if self._part is not None and not (has_failed and self.is_part_kept):
                self._part.unlink(missing_ok=True)
            if self._file is not None:
                with suppress(OSError):  # the disk may be full. All kept data are on the disk.
                    self._file.close()

    def _finish(self) -> None:
        """Write all data to the disk, and give the file its name."""
        if self._file is None:
            return
        self._file.flush()
        if self._part is None or self._target is None:
            return
        os.fsync(self._file.fileno())
        if not self._force and os.path.lexists(self._target):
            self.is_part_kept = True
            raise FileExistsError(errno.EEXIST, "another program has created it meanwhile")
        self._part.replace(self._target)
        self._part = None


def part_beside(target: Path) -> Path:
    """Return the name that an output file has until it is complete."""
    return Path(f"{target}.part")


def check_part(part: Path, *, force: bool) -> None:
    """Raise UserError if a part exists and must not be replaced."""
    if is_locked(part):
        raise UserError(
            f"{part}: another process is writing it. Wait for its end, or give another name."
        )
    if not force and os.path.lexists(part):
        raise UserError(
            f"{part}: exists. It may have the data of an earlier command that was interrupted. "
            "Rename it, or give --force to replace it."
        )


def to_table(recording: "Input", out: OutputFile, form: str, choice: "Choice") -> str | None:
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
    table = Table(
        fields,
        has_utc,
        has_trust,
        origin_ns,
        recording.provenance,
    )
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
    out: OutputFile,
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
    writer = CanLogWriter(
        file,
        form,
        wall_ns,
        origin_ns,
        recording.channel,
        recording.provenance,
    )
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


def _write_all(writer: Any, items: Iterator[Any], out: OutputFile) -> tuple[int, int]:
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


def to_bytes(recording: "Input", out: OutputFile, esc: int) -> str | None:
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
