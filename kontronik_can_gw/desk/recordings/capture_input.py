"""Captures of one run, in the order of their parts: header, data blocks, the wall clock, and an account of what is damaged."""

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from kontronik_can_gw.assembly.capture_setup import CaptureSetup
from kontronik_can_gw.capture.format import Block as DataBlock
from kontronik_can_gw.capture.format import (
    Damage,
    Entry,
    Kind,
    Scanner,
    entry_at,
    read_entries,
    read_json,
    read_numbers,
)
from kontronik_can_gw.capture.replay import Replay, TimedFrame
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.core.header_parts import HeaderError
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc, shown_by
from kontronik_can_gw.desk.recordings.played import NO_MESSAGES, PlayedInput
from kontronik_can_gw.desk.recordings.recording import LATEST_NS, ClockStep, timed
from kontronik_can_gw.errors import RunError, UserError

if TYPE_CHECKING:
    from kontronik_can_gw.gateway.gateway import Gateway
    from kontronik_can_gw.native.offline import Frames
    from kontronik_can_gw.native.player import Player

CHUNK = 1 << 18
_PLAYED = frozenset({Kind.BYTES, Kind.ADVANCE, Kind.COUNTERS})
"""What a player plays, and by which frames of the turn before are certain."""
_LOOK_FOR_HEADER = 1 << 25
_MAX_DAMAGE = 50
_STEP_NS = 100_000_000
"""A smaller change of the wall clock is a correction and not reported."""


class CaptureInput(PlayedInput):
    """Captures of one run, played through the gateway's core."""

    def __init__(self, paths: Sequence[Path], layout: BusLayout | None = None) -> None:
        self._paths = list(paths)
        self._headerless: list[str] = []
        self._file: IO[bytes] | None = None
        self.header = self._first_header()
        first = self._paths[0]
        try:
            setup = CaptureSetup.of(self.header)
            found = setup.database()
            setup.gateway(NO_MESSAGES if found is None else found[1], 0)
        except Exception as error:  # a header may hold anything
            problems = ["the header cannot be used: it is not as a recorder writes it"]
            if isinstance(error, UserError):
                problems = list(error.problems)
            elif isinstance(error, HeaderError):
                problems = [str(error)]
            raise UserError(*(f"{first}: {problem[:400]}" for problem in problems)) from None
        name = str(first)
        if len(self._paths) > 1:
            name = f"{first.parent}/{first.stem.rpartition('-')[0]}"
        if layout is not None:
            layout = shown_by(layout, setup.escs)
        elif found is not None:
            layout = BusLayout(found[0], found[1], setup.escs)
        else:
            layout = layout_of_dbc(shipped("dbc/kontronik_esc.dbc"), setup.escs)
        super().__init__(name, layout, setup)
        self.sent_layout = NO_MESSAGES if found is None else found[1]
        self.created_ns = int(self.header.get("created_ns") or self.header.get("monotonic_ns") or 0)
        self._begun = _clock_of(self.header) or (0, 0)
        self._last_ns = self._impossible = 0
        self._place = ""
        """Of the block that is being read, in words."""
        self._devices: list[Any] = list(self.header.get("devices") or [])
        self._describe()

    def wall_ns(self, time_ns: int) -> int | None:
        offsets = (offset for since, offset in reversed(self._offsets) if since <= time_ns)
        return time_ns + next(offsets, self._begun[1])

    @property
    def clock_steps(self) -> Sequence[ClockStep]:
        steps = []
        offset = self._begun[1]
        for time_ns, after in self._offsets:
            if abs(after - offset) > _STEP_NS:
                steps.append(ClockStep(time_ns, after - offset))
            offset = after
        return steps

    @property
    def channel(self) -> str:
        try:
            channel = str(tomllib.loads(self.setup.configuration)["can"]["channel"])
        except (ValueError, LookupError, TypeError, RecursionError):
            channel = ""
        return channel if re.fullmatch(r"[\w.:@/-]{1,64}", channel, re.ASCII) else "can0"

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def entries(self) -> Iterator[Entry]:
        """All entries. What is damaged is left out, and reported in ``damage``."""
        for payload in self._payloads():
            yield from self._entries_of(payload)

    def esc_bytes(self, esc: int) -> Iterator[bytes]:
        for entry in self.entries():
            if entry.kind == Kind.BYTES and entry.esc == esc:
                yield entry.data

    def _play(
        self, gateway: "Gateway", player: "Player | None" = None
    ) -> "Iterator[list[TimedFrame] | Frames]":
        replay = Replay(gateway, self.header.get("state"), self.marked)
        for frames in self._steps(replay, player):
            if player is not None and len(sent := player.take_frames()):
                yield sent
            yield frames
        if player is not None:
            yield player.take_frames(final=True)
        yield replay.finish()
        if replay.lost:
            self.damage.append(
                f"{replay.lost} entries could not be recorded: the disk was too slow or full"
            )
        if replay.rejected:
            self.damage.append(f"{replay.rejected} entries make no sense to this version")

    def _steps(self, replay: Replay, player: "Player | None") -> Iterator[list[TimedFrame]]:
        """Give all entries to a replay's gateway; the frames that Python made of each, or nothing where ``player`` gave some.

        The player plays what comes all the time. Any other entry, and the rest of its turn, is played here.
        """
        here = True
        for payload in self._payloads():
            if player is None or not player.begin(payload):
                if player is not None:
                    here = True
                    yield []
                    replay.go_on(list(timed(player.take_frames(final=True))))
                for entry in self._entries_of(payload):
                    yield replay.play(entry)
                continue
            while (kind := player.next_kind) is not None:
                if here or (replay.frames_wait and kind not in _PLAYED):  # it may still drop them
                    here = here if kind == Kind.NOT_SENT else kind != Kind.ADVANCE
                    if (found := self._checked(entry_at(payload, *player.skip()))) is not None:
                        yield replay.play(found)
                else:
                    yield replay.finish()
                    here, self._last_ns = player.play(self._last_ns)
                    yield []
                    if here:
                        replay.go_on(list(timed(player.take_frames(final=True))))

    def _entries_of(self, payload: bytes) -> Iterator[Entry]:
        try:
            for entry in read_entries(payload, self.setup.version):
                if (found := self._checked(entry)) is not None:
                    yield found
        except ValueError as error:
            self._damaged(f"{self._place} {error}")

    def _checked(self, entry: Entry) -> Entry | None:
        """The entry; not before the one before. None where it has no possible time."""
        time_ns, is_clock = entry.time_ns, entry.kind == Kind.CLOCK
        wall_ns = 0
        if is_clock and len(entry.data) == 8:
            (wall_ns,) = read_numbers(entry.data)
        if time_ns > LATEST_NS or (is_clock and not 0 < wall_ns <= LATEST_NS):
            self._impossible += 1
            return None
        if is_clock:
            # it stands after what was written by the clock before
            self._offsets.append((time_ns + 1, wall_ns - time_ns))
        if time_ns < self._last_ns:
            return entry._replace(time_ns=self._last_ns)
        self._last_ns = time_ns
        return entry

    def _describe(self) -> None:
        """Say in ``provenance`` what is known by now."""
        header, setup, program = self.header, self.setup, self.header.get("program", {})
        version, python = program.get("version", "?"), program.get("python", "?")
        layout = f", layout {header['layout']}" if isinstance(header.get("layout"), str) else ""
        self.provenance |= {
            "program": f"kontronik-can-gw {version}, Python {python}",
            "machine": str(program.get("machine", "")),
            "run": f"{header.get('run', '')}, part {int(header.get('part', 0)) + 1}",
            "configuration": setup.file,
            "DBC": setup.dbc[0] + layout if setup.dbc else "",
        }
        for index, (esc, port) in enumerate(zip(setup.escs, setup.ports, strict=False)):
            device = self._devices[index] if index < len(self._devices) else None
            known = "device not known"
            if isinstance(device, dict):
                known = f"{device.get('device')} {device.get('variant')}, firmware {device.get('firmware')}, {device.get('layout')} layout"
            self.provenance[esc.name] = f"{known}, at {port}"

    def _first_header(self) -> Mapping[str, Any]:
        """The header of the first part that has one; those before it are left out."""
        while True:
            path = self._paths[0]
            for found in self._blocks(path, _LOOK_FOR_HEADER):
                if isinstance(found, DataBlock) and found.kind == b"H":
                    with suppress(ValueError):
                        return read_json(found.payload)
            self.close()
            if len(self._paths) == 1:
                raise UserError(
                    f"{path}: has no header that could be read, so nothing is known of what was recorded"
                )
            self._headerless.append(f"{path.name}: has no header that could be read")
            del self._paths[0]

    def _blocks(self, path: Path, limit: int = 1 << 62) -> Iterator[DataBlock | Damage]:
        scanner = Scanner()
        try:
            with path.open("rb") as self._file:
                while self._file.tell() < limit and (data := self._file.read(CHUNK)):
                    yield from scanner.feed(data)
        except OSError as error:
            raise RunError(f"{path}: cannot be read: {error.strerror}.") from None
        yield from scanner.flush()

    def _payloads(self) -> Iterator[bytes]:
        """The data blocks of all parts. What the other blocks tell goes into ``damage`` and ``provenance``."""
        self._last_ns = self._impossible = 0
        self.damage = list(self._headerless)
        self._offsets = []
        for number, path in enumerate(self._paths):
            expected, ended = 0, False
            for found in self._blocks(path):
                if isinstance(found, Damage):
                    text = f"{found.length} bytes at {found.offset} are damaged"
                    self._damaged(f"{path.name}: {text}")
                    continue
                if missing := max(0, found.number - expected):
                    text = f"{missing} blocks in front of byte {found.offset} are missing"
                    self._damaged(f"{path.name}: {text}")
                expected, ended = found.number + 1, found.kind == b"E"
                self._place = f"{path.name}: the block at {found.offset}"
                if found.kind == b"D":
                    yield found.payload
                elif found.kind in (b"I", b"H"):
                    self._read_json(found, path, number)
            if not ended:
                text = "was not closed: up to the last second before its end may be missing"
                self._damaged(f"{path.name}: {text}")
        if self._impossible:
            self.damage.append(f"{self._impossible} entries have no possible time")

    def _damaged(self, text: str) -> None:
        if len(self.damage) <= _MAX_DAMAGE:
            is_last = len(self.damage) == _MAX_DAMAGE
            self.damage.append("and more of that kind" if is_last else text)

    def _read_json(self, block: DataBlock, path: Path, part: int) -> None:
        try:
            found = read_json(block.payload)
            if block.kind == b"H":
                self._check_part(found, path, part)
            else:
                self._devices = found.get("devices", self._devices)
                self._describe()
        except ValueError as error:
            self._damaged(f"{self._place} {error}")

    def _check_part(self, header: Mapping[str, Any], path: Path, part: int) -> None:
        if header.get("run") != self.header.get("run"):
            raise UserError(
                f"{path}: is of another run than {self._paths[0]}. Convert each run by itself."
            )
        if (clock := _clock_of(header)) is not None:
            self._offsets.append(clock)
        number, first = header.get("part", part), self.header.get("part", 0)
        if type(number) is not int:
            raise ValueError("has a part that is no number")
        missing = number - int(first) - part
        if missing > 0:
            self.damage.append(
                f"{path.name}: {missing} parts of the run in front of it are not given"
            )


def _clock_of(header: Mapping[str, Any]) -> tuple[int, int] | None:
    """A moment, and how much more Unix time was then; None where the header's times are none."""
    now, wall = header.get("monotonic_ns"), header.get("wall_ns")
    if all(isinstance(at, int) and 0 <= at <= LATEST_NS for at in (now, wall)):
        return int(now or 0), int(wall or 0) - int(now or 0)
    return None
