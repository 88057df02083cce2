"""Recordings of every kind as one thing: CAN frames in order of time, and rows of all values.

A capture (.kcap) goes through the gateway's core with the recorded clock. Plain UART bytes have no time: their live frames are taken to
come at a fixed rate. CAN logs are frames already. ``open_input`` finds out what a file is by its content.
"""

import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import IO, Any, Protocol, Self

from kontronik_can_gw.capture.format import (
    MAGIC,
    SUFFIX,
    Block,
    Damage,
    Entry,
    Kind,
    Scanner,
    read_entries,
    read_json,
    read_number,
)
from kontronik_can_gw.capture.replay import Replay, TimedFrame, follow_bytes
from kontronik_can_gw.capture.setup import CaptureSetup
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.dbc.compiler import DbcSettings
from kontronik_can_gw.desk.recordings.can_logs import (
    NAMES,
    SUFFIXES,
    UART_MAGIC,
    CanLog,
    log_format,
)
from kontronik_can_gw.desk.recordings.columns import Section, fields_of_values, sections
from kontronik_can_gw.desk.recordings.fields import Field
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc, shown_by
from kontronik_can_gw.desk.recordings.more_escs import more_escs
from kontronik_can_gw.desk.recordings.samples import (
    FoundTelemetry,
    Sample,
    SampledGateway,
    fields_of_log,
    samples_of_bytes,
    samples_of_frames,
)
from kontronik_can_gw.desk.recordings.spool import is_stream, spooled
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.esc.kontronik.codec import Kind as FrameKind
from kontronik_can_gw.esc.kontronik.deframer import Counters, Deframer, Frame
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.signals.plan import Layout
from kontronik_can_gw.signals.unpacker import SignalReader

CHUNK = 1 << 18
LIVE_RATE = 100.0
"""Live frames a second that plain bytes are taken to have come at."""
_LOOK = 1 << 16
_LOOK_FOR_HEADER = 1 << 25
_MAX_DAMAGE = 50
_LATEST_NS = 1 << 62
_MAX_WAITING = 1 << 16
_UNDECIDED = len(UART_MAGIC) - 1
"""Bytes at the end of a read that may begin a header."""
_LONGEST_FRAME = 64
_MAX_IDS = 4096


class Input(Protocol):
    """A recording. Each of ``frames``, ``samples``, ``esc_bytes`` reads it from its beginning."""

    name: str
    bus: BusLayout
    provenance: dict[str, str]
    """What is known of where it came from, in words."""
    size: int
    position: int
    """Bytes read so far, of ``size``."""
    damage: list[str]
    """What was not intact, a line each; complete when it was read to the end."""
    notes: list[str]
    """What the person should know of how it was read, a line each; complete when it was read to the end."""
    times_assumed: bool
    """True where the recording has no times."""

    @property
    def reader(self) -> SignalReader:
        """Reads frames of ``bus``."""

    @property
    def fields(self) -> Sequence[Field]:
        """The columns of the samples: values by name."""

    def frames(self) -> Iterator[TimedFrame]:
        """The CAN frames that were sent (or would have been) and received."""

    def samples(self, chosen: Sequence[int] | None = None) -> Iterator[Sample]:
        """Rows of the values of ``chosen`` fields, in that order; None: of all."""

    def esc_bytes(self, esc: int) -> Iterator[bytes]:
        """The UART bytes of one ESC. UserError where the recording has none."""

    def wall_ns(self, time_ns: int) -> int | None:
        """Unix time, where it is known."""

    def close(self) -> None:
        """Close the files."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


class _Base:
    """What all of them have."""

    last_path: Path | None = None
    """Of captures: the last part."""

    def __init__(self, name: str, bus: BusLayout, size: int) -> None:
        self.name = name
        self.bus = bus
        self.size = size
        self.position = 0
        self.provenance: dict[str, str] = {}
        self.damage: list[str] = []
        self.notes: list[str] = []
        self.times_assumed = False

    @cached_property
    def reader(self) -> SignalReader:
        return SignalReader(self.bus.layout)

    @cached_property
    def fields(self) -> Sequence[Field]:
        return fields_of_values(self.bus.escs)

    def _sections(self, chosen: Sequence[int] | None) -> list[Section]:
        return sections(self.fields, range(len(self.fields)) if chosen is None else chosen)

    def close(self) -> None:
        pass

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_input(
    path: Path,
    layout: BusLayout | None = None,
    live_rate: float = LIVE_RATE,
    reached: Callable[[int], None] | None = None,
) -> Input:
    """Open a recording. UserError for what is none, RunError for what cannot be read.

    ``path``: a file; a folder of captures, or the beginning of the names of one run's, for all parts of that run; a pipe, or ``-`` for
    standard input, which is read to its end first (``reached`` is told how far that is). ``layout``: of CAN logs and plain bytes, the
    shipped one of one ESC if None; for a capture it replaces the recorded one.
    """
    if is_stream(path):
        path = spooled(path, reached)
    parts = _parts(path)
    if parts is not None:
        return _captures(parts, layout)
    try:
        with path.open("rb") as file:
            head = file.read(_LOOK)
    except OSError as error:
        raise RunError(f"{path}: cannot be opened: {error.strerror}.") from None
    if not head:
        raise UserError(f"{path}: is empty")
    if MAGIC in head or path.suffix == SUFFIX:
        return _captures([path], layout)
    if log_format(path) is not None:
        return CanLogInput(path, layout or layout_of_dbc(shipped("dbc/kontronik_esc.dbc")))
    if b"KOD" in head:
        return DumpInput(path, layout, live_rate)
    if (called := SUFFIXES.get(path.suffix.lower())) is not None:
        raise UserError(
            f"{path}: is no {NAMES[called]}, whatever its name says, and no other recording"
        )
    raise UserError(
        f"{path}: is no capture, no CAN log (candump, ASC, BLF, TRC, MF4), and has no telemetry of an ESC in its first {_LOOK // 1024} kB"
    )


def _captures(paths: Sequence[Path], layout: BusLayout | None) -> "CaptureInput":
    made = CaptureInput(paths, layout)
    made.last_path = paths[-1]
    return made


def _parts(path: Path) -> list[Path] | None:
    """The captures that a folder, or the beginning of a name, means; None for a plain file."""
    if path.is_dir():
        found = sorted(path.glob(f"*{SUFFIX}"))
        if not found:
            raise UserError(f"{path}: has no captures (*{SUFFIX})")
    elif not path.exists():
        found = (
            sorted(p for p in path.parent.glob(f"*{SUFFIX}") if p.name.startswith(path.name))
            if path.name
            else []
        )
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


class CaptureInput(_Base):
    """Captures of one run, in the order of their parts."""

    def __init__(self, paths: Sequence[Path], layout: BusLayout | None = None) -> None:
        self._paths = list(paths)
        self._headerless: list[str] = []
        self.damage = []
        self.position = 0
        self._file: IO[bytes] | None = None
        self.header = self._first_header()
        try:
            size = sum(path.stat().st_size for path in self._paths)
        except OSError as error:
            raise RunError(f"{error.filename}: cannot be read: {error.strerror}.") from None
        try:
            self.setup = CaptureSetup.of(self.header)
            found = self.setup.database()
            self.setup.gateway(Layout("", "", ()) if found is None else found[1], 0)
        except UserError as error:
            raise UserError(
                *(f"{self._paths[0]}: {problem[:400]}" for problem in error.problems)
            ) from None
        except Exception as error:  # a header may hold anything
            raise UserError(f"{self._paths[0]}: {str(error)[:400]}") from None
        name = str(self._paths[0])
        if len(self._paths) > 1:
            name = f"{self._paths[0].parent}/{self._paths[0].stem.rpartition('-')[0]}"
        self.sent_layout = Layout("", "", ()) if found is None else found[1]
        """Of the frames; that of the rows, ``bus``, may be another one."""
        if layout is not None:
            layout = shown_by(layout, self.setup.escs)
        elif found is not None:
            layout = BusLayout(found[0], found[1], self.setup.escs)
        else:
            layout = layout_of_dbc(shipped("dbc/kontronik_esc.dbc"), self.setup.escs)
        super().__init__(name, layout, size)
        self._offsets: list[tuple[int, int]] = []
        self._devices: list[Any] = list(self.header.get("devices") or [])
        self._describe()

    def frames(self, marked: bool = False) -> Iterator[TimedFrame]:
        """``marked``: the gateway's state in the frames is REPLAY."""
        gateway = self.setup.gateway(self.sent_layout, self._created_ns)
        replay = Replay(gateway, self.header.get("state"), marked)
        yield from replay.follow(self.entries())
        self._tell(replay)

    def samples(self, chosen: Sequence[int] | None = None) -> Iterator[Sample]:
        # who shows it tells names, pole pairs and gears
        escs = [
            replace(own, name=shown.name, pole_pairs=shown.pole_pairs, gear=shown.gear)
            for own, shown in zip(self.setup.escs, self.bus.escs, strict=True)
        ]
        gateway = SampledGateway(self.setup, escs, self._sections(chosen), self._created_ns)
        replay = Replay(gateway, self.header.get("state"))
        for entry in self.entries():
            replay.play(entry)
            yield from gateway.maker.take_rows()
        yield from gateway.maker.finish()
        self._tell(replay)

    def esc_bytes(self, esc: int) -> Iterator[bytes]:
        for entry in self.entries():
            if entry.kind == Kind.BYTES and entry.esc == esc:
                yield entry.data

    def wall_ns(self, time_ns: int) -> int | None:
        offset = next(
            (offset for since, offset in reversed(self._offsets) if since <= time_ns), None
        )
        if offset is None:
            offset = int(self.header.get("wall_ns") or 0) - int(
                self.header.get("monotonic_ns") or 0
            )
        return time_ns + offset

    @property
    def channel(self) -> str:
        """The CAN channel that was sent on."""
        try:
            channel = str(tomllib.loads(self.setup.configuration)["can"]["channel"])
        except (ValueError, LookupError, TypeError, RecursionError):
            channel = ""
        return channel if re.fullmatch(r"[\w.:@/-]{1,64}", channel, re.ASCII) else "can0"

    def entries(self) -> Iterator[Entry]:
        """All entries of all parts. What is damaged is passed over, and told in ``damage``."""
        self.position = 0
        self.damage = list(self._headerless)
        self._offsets = []
        last, impossible = 0, 0
        for number, path in enumerate(self._paths):
            for entry in self._entries_of(path, number):
                if entry.time_ns > _LATEST_NS or (
                    entry.kind == Kind.CLOCK and len(entry.data) != 8
                ):
                    impossible += 1
                    continue
                if entry.kind == Kind.CLOCK:
                    # it stands behind what was written by the clock before
                    self._offsets.append(
                        (entry.time_ns + 1, read_number(entry.data) - entry.time_ns)
                    )
                if entry.time_ns < last:
                    entry = entry._replace(time_ns=last)
                last = entry.time_ns
                yield entry
        if impossible:
            self.damage.append(f"{impossible} entries have no possible time")

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    @property
    def _created_ns(self) -> int:
        """When the recorded gateway was made: its cycles count from there."""
        return int(self.header.get("created_ns") or self.header.get("monotonic_ns") or 0)

    def _first_header(self) -> Mapping[str, Any]:
        while True:
            path = self._paths[0]
            for found in self._blocks(path):
                if isinstance(found, Block) and found.kind == b"H":
                    with suppress(ValueError):
                        return read_json(found.payload)
                if self.position > _LOOK_FOR_HEADER:
                    break
            self.close()
            if len(self._paths) == 1:
                raise UserError(
                    f"{path}: has no header that could be read, so nothing is known of what was recorded"
                )
            self._headerless.append(f"{path.name}: has no header that could be read")
            del self._paths[0]

    def _blocks(self, path: Path) -> Iterator[Block | Damage]:
        scanner = Scanner()
        try:
            with path.open("rb") as self._file:
                while data := self._file.read(CHUNK):
                    self.position += len(data)
                    yield from scanner.feed(data)
        except OSError as error:
            raise RunError(f"{path}: cannot be read: {error.strerror}.") from None
        yield from scanner.flush()

    def _entries_of(self, path: Path, part: int) -> Iterator[Entry]:
        expected, ended = 0, False
        for found in self._blocks(path):
            if isinstance(found, Damage):
                self._tell_damage(
                    f"{path.name}: {found.length} bytes at {found.offset} are damaged"
                )
                continue
            if found.number > expected:
                self._tell_damage(
                    f"{path.name}: {found.number - expected} blocks in front of byte {found.offset} are missing"
                )
            expected, ended = found.number + 1, found.kind == b"E"
            try:
                if found.kind == b"D":
                    yield from read_entries(found.payload, self.header["version"])
                elif found.kind == b"I":
                    self._devices = read_json(found.payload).get("devices", self._devices)
                    self._describe()
                elif found.kind == b"H":
                    self._check_part(read_json(found.payload), path, part)
            except ValueError as error:
                self._tell_damage(f"{path.name}: the block at {found.offset} {error}")
        if not ended:
            self._tell_damage(
                f"{path.name}: was not closed: up to the last second before its end may be missing"
            )

    def _tell_damage(self, text: str) -> None:
        if len(self.damage) < _MAX_DAMAGE:
            self.damage.append(text)
        elif len(self.damage) == _MAX_DAMAGE:
            self.damage.append("and more of that kind")

    def _check_part(self, header: Mapping[str, Any], path: Path, part: int) -> None:
        if header.get("run") != self.header.get("run"):
            raise UserError(
                f"{path}: is of another run than {self._paths[0]}. Convert each run by itself."
            )
        now, wall = header.get("monotonic_ns"), header.get("wall_ns")
        if (
            isinstance(now, int)
            and isinstance(wall, int)
            and 0 <= now <= _LATEST_NS
            and 0 <= wall <= _LATEST_NS
        ):
            self._offsets.append((now, wall - now))
        missing = int(header.get("part", part)) - int(self.header.get("part", 0)) - part
        if missing > 0:
            self.damage.append(
                f"{path.name}: {missing} parts of the run in front of it are not given"
            )

    def _tell(self, replay: Replay) -> None:
        if replay.lost:
            self.damage.append(
                f"{replay.lost} entries could not be recorded: the disk was too slow or full"
            )
        if replay.passed_over:
            self.damage.append(f"{replay.passed_over} entries make no sense to this version")

    def _describe(self) -> None:
        header, words = self.header, self.provenance
        program = header.get("program", {})
        words["program"] = (
            f"kontronik-can-gw {program.get('version', '?')}, Python {program.get('python', '?')}"
        )
        words["machine"] = str(program.get("machine", ""))
        words["run"] = f"{header.get('run', '')}, part {int(header.get('part', 0)) + 1}"
        words["configuration"] = self.setup.file
        words["DBC"] = self.setup.dbc[0] if self.setup.dbc else ""
        for index, (esc, port) in enumerate(zip(self.setup.escs, self.setup.ports, strict=False)):
            device = self._devices[index] if index < len(self._devices) else None
            told = "device not known"
            if isinstance(device, dict):
                told = f"{device.get('device')} {device.get('variant')}, firmware {device.get('firmware')}, {device.get('layout')} layout"
            words[esc.name] = f"{told}, at {port}"


class DumpInput(_Base):
    """The bytes of one ESC, without times."""

    def __init__(
        self, path: Path, layout: BusLayout | None = None, live_rate: float = LIVE_RATE
    ) -> None:
        layout = layout or layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))
        if len(layout.escs) != 1:
            raise UserError(
                f"{path}: holds the bytes of one ESC, {layout.layout.file} describes {len(layout.escs)}"
            )
        super().__init__(str(path), layout, path.stat().st_size)
        self.times_assumed = True
        self._path = path
        self._period_ns = max(1, round(SECOND / live_rate))
        esc = replace(
            layout.escs[0], timeout_ns=max(layout.escs[0].timeout_ns, 3 * self._period_ns)
        )
        self.setup = CaptureSetup((esc,), (str(path),), None, DbcSettings(), False, False, None)
        self.provenance["times"] = f"assumed: {live_rate:g} live frames a second"
        if layout.config is None:
            self.provenance["motor"] = (
                "pole pairs and gear taken as 1 (a configuration, -c, tells them)"
            )

    def frames(self) -> Iterator[TimedFrame]:
        yield from follow_bytes(self.setup.gateway(self.bus.layout, 0), self.chunks())

    def samples(self, chosen: Sequence[int] | None = None) -> Iterator[Sample]:
        esc = FoundTelemetry(self.setup.escs[0], 0)
        yield from samples_of_bytes(esc, self._found(esc), self._sections(chosen))

    def esc_bytes(self, esc: int) -> Iterator[bytes]:
        if esc:
            raise UserError(f"{self.name}: holds the bytes of one ESC")
        yield from self._read()

    def wall_ns(self, time_ns: int) -> int | None:  # noqa: ARG002  nobody knows when it was
        return None

    def _read(self) -> Iterator[bytes]:
        self.position = 0
        try:
            with self._path.open("rb") as file:
                while data := file.read(CHUNK):
                    self.position += len(data)
                    yield data
        except OSError as error:
            raise RunError(f"{self._path}: cannot be read: {error.strerror}.") from None

    def chunks(self) -> Iterator[tuple[int, bytes]]:
        """The bytes up to each frame's end, at its time: a live frame each period, an info frame half a period behind."""
        self.damage = []
        deframer = Deframer()
        waiting, at = bytearray(), 0
        now, clock = 0, _Clock(self._period_ns)
        for data in chain(self._read(), (None,)):
            if data is not None:
                waiting += data
            if len(waiting) > _MAX_WAITING:
                # no frame for long: what can belong to none any more goes
                keep = len(data or b"") + _LONGEST_FRAME
                if (gone := len(waiting) - keep) > 0:
                    yield now, bytes(waiting[:gone])
                    del waiting[:gone]
                    at += gone
            for frame in deframer.feed(data) if data is not None else deframer.flush():
                now = clock.time_of(frame)
                end = frame.offset + frame.form.length - at
                yield now, bytes(waiting[:end])
                del waiting[:end]
                at += end
        if waiting:
            yield now, bytes(waiting)
        self._tell(deframer.counters)

    def _found(self, esc: FoundTelemetry) -> Iterator[tuple[int, Frame]]:
        """Each frame and its time. ``esc`` is given the bytes up to the next header with it, so that its counters are of that time."""
        self.damage = []
        clock = _Clock(self._period_ns)
        rest = b""
        for data in chain(self._read(), (b"",)):
            first, *others = (rest + data).split(UART_MAGIC)
            pieces = [first, *(UART_MAGIC + other for other in others)]
            if data:
                rest = pieces[-1][-_UNDECIDED:]
                pieces[-1] = pieces[-1][:-_UNDECIDED]
            for piece in filter(None, pieces):
                for frame in esc.find(piece):
                    yield clock.time_of(frame), frame
        for frame in esc.find(b""):
            yield clock.time_of(frame), frame
        self._tell(esc.counters)

    def _tell(self, counters: Counters) -> None:
        if counters.dropped_bytes:
            self.damage.append(
                f"{counters.dropped_bytes} bytes belong to no frame, {counters.crc_errors} CRC errors"
            )
        if not counters.live:
            self.damage.append(counters.diagnosis() or "no live frame")


class _Clock:
    """The assumed times of frames: a live frame each period, an info frame half a period after it."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._now = self._lives = 0

    def time_of(self, frame: Frame) -> int:
        """The time of the next frame."""
        next_live = self._lives * self._period_ns
        if frame.form.kind is FrameKind.LIVE:
            self._now = next_live
            self._lives += 1
        else:
            self._now = max(self._now, next_live - self._period_ns // 2)
        return self._now


class CanLogInput(_Base):
    """Frames as a CAN tool logged them."""

    def __init__(self, path: Path, layout: BusLayout) -> None:
        self._log = CanLog(path)
        super().__init__(str(path), layout, self._log.size)
        self._path = path
        self.others = 0
        """Frames that the layout does not have; complete when it was read to the end."""

    def frames(self) -> Iterator[TimedFrame]:
        self._log.close()
        self._log = CanLog(self._path)
        ours = self.reader.keys
        seen: set[int] = set()
        others: dict[int, int] = {}
        self.others = 0
        self.notes = []
        for time_ns, frame, received in self._log.frames():
            self.position = self._log.position
            key = frame.key
            if key in ours:
                seen.add(key)
            else:
                self.others += 1
                if key in others or len(others) < _MAX_IDS:
                    others[key] = others.get(key, 0) + 1
            yield TimedFrame(time_ns, frame, received)
        self.position = self.size
        self.damage = list(self._log.damage)
        if note := more_escs(self.bus, seen, others):
            self.notes.append(note)

    @cached_property
    def fields(self) -> Sequence[Field]:
        return fields_of_log(self.reader, self.bus.escs)

    def samples(self, chosen: Sequence[int] | None = None) -> Iterator[Sample]:
        columns = range(len(self.fields)) if chosen is None else chosen
        yield from samples_of_frames(self.frames(), self.reader, columns)

    def esc_bytes(self, esc: int) -> Iterator[bytes]:
        raise UserError(f"{self.name}: is a log of CAN frames, which has no bytes of ESC {esc + 1}")

    def wall_ns(self, time_ns: int) -> int | None:
        if self._log.wall:
            return time_ns
        start = self._log.wall_start_ns
        return None if start is None else start + time_ns

    def close(self) -> None:
        self._log.close()
