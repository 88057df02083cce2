"""Frames as a CAN tool logged them, as a recording; the format of a log is found out by its content."""

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from itertools import islice
from pathlib import Path

from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.desk.recordings.can_logs import text
from kontronik_can_gw.desk.recordings.can_logs.text import SECOND_NS
from kontronik_can_gw.desk.recordings.fields import Field
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.recordings.recording import LATEST_NS, Input, Sample
from kontronik_can_gw.desk.recordings.samples import fields_of_log, samples_of_frames
from kontronik_can_gw.errors import RunError, UserError

_BATCH = 256
"""Frames."""
_BACK_NS = 10 * SECOND_NS
_AHEAD_NS = 86_400 * SECOND_NS
"""A step of time that is larger must be confirmed by the frame after it, or it is a damaged time."""
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

    def batches(self) -> Iterator[list[TimedFrame]]:
        frames = self.frames()
        while some := list(islice(frames, _BATCH)):
            yield some

    def frames(self) -> Iterator[TimedFrame]:
        self.close()
        self._open()
        ours = self.reader.keys
        self.others = 0
        try:
            for item in self._in_time():
                self.others += item.frame.key not in ours
                yield item
        except OSError as error:
            raise RunError(f"{self._path}: cannot be read: {error.strerror}.") from None
        self.damage = self._reader.damage

    def _in_time(self) -> Iterator[TimedFrame]:
        """Left out is what has a time that leads far away and back: a digit or a bit of it is damaged."""
        last: TimedFrame | None = None
        wrong = 0
        frames = iter(self._reader)
        item = next(frames, None)
        while item is not None:
            after = next(frames, None)
            # where two agree the clock was set, or the first frame was the damaged one
            if last is None or _follows(item, last) or after is None or _follows(after, item):
                last = item
                yield item
            else:
                wrong += 1
            item = after
        if wrong:
            plural = "s" if wrong > 1 else ""
            self._reader.damage.append(f"{wrong} frame{plural} with an impossible time left out")

    @cached_property
    def fields(self) -> Sequence[Field]:
        return fields_of_log(self.reader, self.bus.escs)

    def samples_in_python(self, chosen: Sequence[int]) -> Iterator[Sample]:
        return samples_of_frames(self.frames(), self.reader, chosen)

    def esc_bytes(self, esc: int) -> Iterator[bytes]:
        raise UserError(f"{self.name}: is a log of CAN frames, which has no bytes of ESC {esc + 1}")

    def wall_ns(self, time_ns: int) -> int | None:
        """0 is the start of a log whose times are Unix times; the start is known with the first frame."""
        start = self._reader.wall_start_ns
        return None if start is None or start > LATEST_NS else start + time_ns

    def close(self) -> None:
        self._reader.close()
        self._file.close()


def _follows(item: TimedFrame, last: TimedFrame) -> bool:
    return -_BACK_NS <= item.time_ns - last.time_ns <= _AHEAD_NS
