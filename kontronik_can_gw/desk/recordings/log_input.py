"""Frames as a CAN tool logged them, as a recording; the format of a log is found out by its content."""

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from itertools import islice
from pathlib import Path

from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.desk.recordings.can_logs import text
from kontronik_can_gw.desk.recordings.fields import Field
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.recordings.log_clock import LogClock
from kontronik_can_gw.desk.recordings.recording import LATEST_NS, ClockStep, Input, Sample
from kontronik_can_gw.desk.recordings.samples import fields_of_log, samples_of_frames
from kontronik_can_gw.errors import RunError, UserError

_BATCH = 256
"""Frames."""
_HEAD_LINES = 2000
_BEGINNINGS = {b"LOGG": "blf", b"MDF     ": "mf4", b"UnFinMF ": "mf4"}
_TEXTS: dict[str, tuple[Callable[[bytes], object], type[text.TextReader]]] = {
    "candump": (text.candump_line, text.CandumpReader),
    "asc": (text.asc_line, text.AscReader),
    "trc": (text.trc_line, text.TrcReader),
}
"""What matches a line of a format, and what reads it."""


def log_format(head: bytes) -> str | None:
    """The format of a log by its first bytes; None: no log."""
    for magic, found in _BEGINNINGS.items():
        if head.startswith(magic):
            return found
    for line in head.removeprefix(b"\xef\xbb\xbf").split(b"\n", _HEAD_LINES)[:_HEAD_LINES]:
        for found, (is_line, _) in _TEXTS.items():
            if is_line(line):
                return found
    return None


def _reader_of(format_: str) -> type[text.LogReader]:
    if format_ in _TEXTS:
        return _TEXTS[format_][1]
    from kontronik_can_gw.desk.recordings.can_logs import library

    return library.BlfReader if format_ == "blf" else library.Mf4Reader


class CanLogInput(Input):
    """A log of CAN frames. UserError for a table in MF4, RunError where it cannot be read."""

    def __init__(self, path: Path, layout: BusLayout, format_: str) -> None:
        super().__init__(str(path), layout)
        self._path, self._format = path, format_
        self._open()

    def _open(self) -> None:
        try:
            self._file = self._path.open("rb")
        except OSError as error:
            raise RunError(f"{self._path}: cannot be opened: {error.strerror}.") from None
        self._reader = _reader_of(self._format)(self._file)
        self._clock = LogClock(self._reader)

    def batches(self) -> Iterator[list[TimedFrame]]:
        frames = self.frames()
        while some := list(islice(frames, _BATCH)):
            yield some

    def frames(self) -> Iterator[TimedFrame]:
        self.close()
        self._open()
        ours = self.reader.keys
        self.others = 0
        clock = self._clock
        try:
            for item in clock.frames():
                self.others += item.frame.key not in ours
                yield item
        except OSError as error:
            raise RunError(f"{self._path}: cannot be read: {error.strerror}.") from None
        self.damage = [*self._reader.damage]
        if clock.impossible:
            plural = "s" if clock.impossible > 1 else ""
            self.damage.append(f"{clock.impossible} frame{plural} with an impossible time left out")

    @cached_property
    def fields(self) -> Sequence[Field]:
        return fields_of_log(self.reader, self.bus.escs)

    def samples_in_python(self, chosen: Sequence[int]) -> Iterator[Sample]:
        return samples_of_frames(self.frames(), self.reader, chosen)

    def esc_bytes(self, esc: int) -> Iterator[bytes]:
        raise UserError(f"{self.name}: is a log of CAN frames, which has no bytes of ESC {esc + 1}")

    def wall_ns(self, time_ns: int) -> int | None:
        """Unix time as the log has it: it jumps where the clock was set."""
        start = self._reader.wall_start_ns
        if start is None or start > LATEST_NS:
            return None
        return start + self._clock.logged_ns(time_ns)

    @property
    def clock_steps(self) -> Sequence[ClockStep]:
        return self._clock.steps

    def close(self) -> None:
        self._reader.close()
        self._file.close()
