"""Finds the format of a recording by its first lines, and reads the log of a CAN tool as one."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from itertools import islice
from pathlib import Path

from kontronik_can_gw.capture.format import MAGIC
from kontronik_can_gw.desk.recordings.can_logs import asc, text
from kontronik_can_gw.desk.recordings.fields import TableColumn
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.recordings.log_clock import LogClock
from kontronik_can_gw.desk.recordings.recording import (
    ERROR,
    LATEST_NS,
    ROWS,
    ClockStep,
    Input,
    LogFrame,
    RowBlock,
)
from kontronik_can_gw.desk.recordings.replay import TimedFrame
from kontronik_can_gw.desk.recordings.samples import RowsOfFrames, fields_of_log
from kontronik_can_gw.desk.recordings.stream import HEAD, Stream, StreamReader
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.frames import EXTENDED
from kontronik_can_gw.printable import counted
from kontronik_can_gw.times import SECOND

_BATCH = 256
"""Number of frames in a batch."""
STREAMED = ("candump",)
"""Formats that are read from a pipe as their data arrive."""
_HEAD_LINES = 2000
"""Number of lines in which the format is looked for."""
_LOOK_FOR_CHANNELS = 10_000
"""Number of frames in which further channels are looked for, once there are too many."""
_BEGINNINGS = {b"LOGG": "blf", b"MDF     ": "mf4", b"UnFinMF ": "mf4"}
_TEXTS: dict[str, tuple[Callable[[bytes], object], type[text.LogReader]]] = {
    "candump": (text.candump_line, text.CandumpReader),
    "asc": (asc.asc_line, asc.AscReader),
    "trc": (text.trc_line, text.TrcReader),
}
"""For each text format: a function that matches its lines, and its reader."""


def log_format(head: bytes) -> str | None:
    """Return the format of a log with these first bytes. None if it is not a log."""
    for magic, found in _BEGINNINGS.items():
        if head.startswith(magic):
            return found
    for line in head.removeprefix(b"\xef\xbb\xbf").split(b"\n", _HEAD_LINES)[:_HEAD_LINES]:
        for found, (is_line, _) in _TEXTS.items():
            if is_line(line):
                return found
    return None


def candump_advice(head: bytes) -> str | None:
    """Return the remedy for the output of candump for the screen. None for other files."""
    for line in head.split(b"\n", _HEAD_LINES)[:_HEAD_LINES]:
        found = text.candump_screen_line(line)
        if found is not None:
            interface = found["interface"].decode("ascii", "replace")
            return (
                "is the output of candump for the screen. Record the log format: "
                f"candump -L {interface} > FILE (or candump -l {interface})."
            )
    return None


CAPTURE = "capture"
BYTES = "bytes"
"""The formats that ``log_format`` does not find."""
UART_MAGIC = b"KOD"
"""The first bytes of every telemetry frame."""
_COMPRESSED = {
    b"\x1f\x8b": ("gzip", "zcat"),
    b"BZh": ("bzip2", "bzcat"),
    b"\xfd7zXZ": ("xz", "xzcat"),
    b"(\xb5/\xfd": ("zstd", "zstdcat"),
    b"PK\x03\x04": ("zip", "unzip -p"),
}
"""Name of a compression and the command that undoes it, by the first bytes of a file."""


def format_of(
    head: bytes,
    name: str,
    *,
    is_capture: bool = False,
    diagnosis: str | None = None,
) -> str:
    """Return the format of a recording with this head. Raises UserError if it is no recording.

    ``diagnosis``: the reason why the bytes are not an ESC's, for the error.
    """
    if not head.strip():
        raise UserError(f"{name}: is empty")
    for magic, (kind, command) in _COMPRESSED.items():
        if head.startswith(magic):
            raise UserError(
                f"{name}: is compressed with {kind}. Give its content through a pipe: "
                f"{command} {name} | kontronik-can-gw COMMAND -"
            )
    if is_capture or MAGIC in head:
        return CAPTURE
    log = log_format(head)
    if log is not None:
        return log
    if UART_MAGIC in head:
        return BYTES
    advice = candump_advice(head)
    if advice is not None:
        raise UserError(f"{name}: {advice}")
    reason = "" if diagnosis is None else f" ({diagnosis})"
    raise UserError(
        f"{name}: is neither a capture nor a CAN log (candump, ASC, BLF, TRC, MF4), "
        f"and has no ESC telemetry in its first {HEAD // 1024} kB{reason}"
    )


class CanLogInput(Input):
    """A log of CAN frames.

    Raises UserError for a table in MF4, and RunError if the log cannot be read.
    """

    def __init__(
        self,
        path: Path,
        layout: BusLayout,
        format_: str,
        stream: Stream | None = None,
    ) -> None:
        super().__init__(str(path), layout)
        self._path = path
        self._format = format_
        self.stream = stream
        self._is_unread = True
        self._selected: str | None = None
        self._channels: dict[str, None] = {}
        """Channels of the frames that have been read."""
        self._chosen: str | None = None
        self._without_data: Counter[tuple[str, str]] = Counter()
        """Error frames and remote frames by channel and kind."""
        self._open()

    def _open(self) -> None:
        try:
            if self.stream is None:
                self._file = self._path.open("rb", buffering=HEAD)
            else:
                self._file = StreamReader(self.stream)
        except OSError as error:
            raise UserError(f"{self._path}: cannot be opened: {error.strerror}.") from None
        if self._format in _TEXTS:
            self._reader: text.LogReader = _TEXTS[self._format][1](self._file)
        else:
            from kontronik_can_gw.desk.recordings.can_logs import library

            kinds = {"blf": library.BlfReader, "mf4": library.Mf4Reader}
            self._reader = kinds[self._format](self._file)
        self._clock = LogClock(self._reader, is_live=self.stream is not None)

    def _rewind(self) -> None:
        """Open the log again, unless nothing of it was read."""
        if not self._is_unread:
            self.close()
            self._open()
        self._is_unread = False

    def select_channel(self, name: str) -> None:
        self._selected = name

    def batches(self) -> Iterator[list[LogFrame]]:
        frames = self._logged()
        size = _BATCH if self.stream is None else 1
        while some := list(islice(frames, size)):
            yield some

    def frames(self) -> Iterator[TimedFrame]:
        for time_ns, frame, received, _ in self._data_frames():
            yield TimedFrame(time_ns, frame, received is True)

    def _data_frames(self) -> Iterator[LogFrame]:
        """Yield the data frames of one channel.

        It is the selected channel, or the only one with messages of the DBC. Frames that are not in
        the DBC are yielded for all channels. Raises UserError if several channels have messages of
        the DBC and no channel is selected.
        """
        ours = self.reader.keys
        chosen = self._selected
        self.others = 0
        logged = self._logged()
        for item in logged:
            frame = item.frame
            can_id = frame.can_id
            if frame.remote or can_id & ERROR:
                self._without_data[item.channel, item.kind] += 1
                continue
            if (can_id | EXTENDED if frame.extended else can_id) not in ours:
                self.others += 1
            elif item.channel != chosen:
                if chosen is not None:
                    raise self._ambiguous(logged)
                self._chosen = chosen = item.channel
            yield item

    def _logged(self) -> Iterator[LogFrame]:
        """Yield all frames, or the frames of the selected channel.

        Raises UserError if the log does not have this channel.
        """
        self._rewind()
        clock = self._clock
        selected = self._selected
        self._channels = {}
        self._chosen = selected
        self._without_data.clear()
        before = None
        try:
            for item in clock.frames():
                if before is None and item.time_ns >= text.OLDEST_WALL_S * SECOND:
                    self._reader.wall_start_ns = 0  # Unix times, even if the head has another start
                if item.channel != before:
                    before = item.channel
                    self._channels[before] = None
                if selected in (None, item.channel):
                    yield item
        except OSError as error:
            raise RunError(f"{self._path}: cannot be read: {error.strerror}.") from None
        self.damage = [*self._reader.damage]
        if clock.impossible:
            frames = counted(clock.impossible, "frame")
            self.damage.append(f"{frames} with an impossible time left out")
        if self._channels and selected not in (None, *self._channels):
            listed = ", ".join(sorted(self._channels))
            raise UserError(f"{self._path}: has no channel {selected}. Available: {listed}.")

    def _ambiguous(self, logged: Iterator[LogFrame]) -> UserError:
        """Return the error for several channels with messages of the DBC. It lists all channels."""
        for _ in islice(logged, _LOOK_FOR_CHANNELS):
            pass
        file = Path(self.bus.layout.file).name
        listed = ", ".join(sorted(self._channels))
        return UserError(
            f"{self._path}: several channels have messages of {file}. "
            f"Choose one with --channel: {listed}."
        )

    @property
    def without_data(self) -> Mapping[str, int]:
        found: Counter[str] = Counter()
        for (channel, kind), number in sorted(self._without_data.items()):
            if self._chosen in (None, channel):
                found[kind] += number
        return found

    @cached_property
    def fields(self) -> Sequence[TableColumn]:
        return fields_of_log(self.reader, self.bus.escs)

    def blocks(self, chosen: Sequence[int] | None = None) -> Iterator[RowBlock]:
        if chosen is None:
            chosen = range(len(self.fields))
        rows = RowsOfFrames(self.reader, chosen)
        count = ROWS if self.stream is None else 1
        for times, columns in rows.blocks(self._data_frames(), count):
            yield RowBlock(times, columns, self.wall_offset_ns(times[0]))

    def esc_bytes(self, esc: int) -> Iterator[bytes]:
        raise UserError(f"{self.name}: is a log of CAN frames, which has no bytes of ESC {esc + 1}")

    def wall_ns(self, time_ns: int) -> int | None:
        """Return the Unix time, which continues if the clock was set back."""
        start = self._reader.wall_start_ns
        if start is None or start > LATEST_NS:
            return None
        return start + time_ns

    @property
    def clock_steps(self) -> Sequence[ClockStep]:
        return self._clock.steps

    def close(self) -> None:
        self._reader.close()
        self._file.close()
