"""Recordings of every kind as one thing: CAN frames in order of time, and rows of values.

A capture (.kcap) goes through the gateway's core with the recorded clock. Plain UART bytes have no time: their live frames are taken to
come at a fixed rate. CAN logs are frames already. ``open_input`` finds out what a file is by its content.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from itertools import islice
from pathlib import Path

from kontronik_can_gw.capture.format import MAGIC, SUFFIX
from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.recordings.can_logs import NAMES, SUFFIXES, UART_MAGIC, CanLog
from kontronik_can_gw.desk.recordings.can_logs.log import log_format
from kontronik_can_gw.desk.recordings.capture_input import CaptureInput
from kontronik_can_gw.desk.recordings.dump_input import LIVE_RATE, DumpInput
from kontronik_can_gw.desk.recordings.fields import Field
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc
from kontronik_can_gw.desk.recordings.more_escs import more_escs
from kontronik_can_gw.desk.recordings.recording import Input
from kontronik_can_gw.desk.recordings.samples import Sample, fields_of_log, samples_of_frames
from kontronik_can_gw.desk.recordings.spool import is_stream, spooled
from kontronik_can_gw.errors import RunError, UserError

__all__ = ["LIVE_RATE", "CanLogInput", "CaptureInput", "DumpInput", "Input", "open_input"]

_HEAD = 1 << 16
_MAX_IDS = 4096
_BATCH = 256
"""Frames."""


def open_input(
    path: Path,
    layout: BusLayout | None = None,
    live_rate: float = LIVE_RATE,
    reached: Callable[[int], None] | None = None,
) -> Input:
    """Open a recording. UserError for other files, RunError for what cannot be read.

    ``path``: a file; a folder of captures, or the beginning of the names of one run's, for all parts of that run; a pipe, or ``-`` for
    standard input, which is read to its end first (``reached`` is called with the bytes so far). ``layout``: of CAN logs and plain
    bytes, the shipped one of one ESC if None; for a capture it replaces the recorded one.
    """
    if is_stream(path):
        path = spooled(path, reached)
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
    if log_format(path) is not None:
        return CanLogInput(path, layout or layout_of_dbc(shipped("dbc/kontronik_esc.dbc")))
    if UART_MAGIC in head:
        return DumpInput(path, layout, live_rate)
    if (called := SUFFIXES.get(path.suffix.lower())) is not None:
        raise UserError(
            f"{path}: is no {NAMES[called]}, whatever its name says, and no other recording"
        )
    raise UserError(
        f"{path}: is no capture, no CAN log (candump, ASC, BLF, TRC, MF4), and has no telemetry of an ESC in its first {_HEAD // 1024} kB"
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


class CanLogInput(Input):
    """Frames as a CAN tool logged them."""

    def __init__(self, path: Path, layout: BusLayout) -> None:
        self._log = CanLog(path)
        super().__init__(str(path), layout, self._log.size)
        self._path = path
        self.others = 0
        """Frames that the layout does not have; complete when it was read to the end."""

    def batches(self) -> Iterator[list[TimedFrame]]:
        frames = self.frames()
        while some := list(islice(frames, _BATCH)):
            yield some

    def frames(self) -> Iterator[TimedFrame]:
        self._log.close()
        self._log = CanLog(self._path)
        ours = self.reader.keys
        seen: set[int] = set()
        others: Counter[int] = Counter()
        self.others = 0
        self.notes = []
        for item in self._log.frames():
            self.position = self._log.position
            key = item.frame.key
            if key in ours:
                seen.add(key)
            else:
                self.others += 1
                if key in others or len(others) < _MAX_IDS:
                    others[key] += 1
            yield item
        self.position = self.size
        self.damage = self._log.damage
        if note := more_escs(self.bus, seen, others):
            self.notes.append(note)

    @cached_property
    def fields(self) -> Sequence[Field]:
        return fields_of_log(self.reader, self.bus.escs)

    def samples_in_python(self, chosen: Sequence[int] | None = None) -> Iterator[Sample]:
        yield from samples_of_frames(self.frames(), self.reader, self._chosen(chosen))

    def esc_bytes(self, esc: int) -> Iterator[bytes]:
        raise UserError(f"{self.name}: is a log of CAN frames, which has no bytes of ESC {esc + 1}")

    def wall_ns(self, time_ns: int) -> int | None:
        start = self._log.wall_start_ns
        return None if start is None else start + time_ns

    def close(self) -> None:
        self._log.close()
