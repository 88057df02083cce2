"""Captures of one run, as a recording."""

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

from kontronik_can_gw.capture.format import (
    Block,
    Damage,
    Entry,
    Kind,
    Scanner,
    read_entries,
    read_json,
    read_number,
)
from kontronik_can_gw.capture.replay import Replay, TimedFrame
from kontronik_can_gw.capture.setup import CaptureSetup
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc, shown_by
from kontronik_can_gw.desk.recordings.recording import CHUNK, Input
from kontronik_can_gw.desk.recordings.samples import RowMaker, Sample
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.signals.plan import Layout

_LOOK_FOR_HEADER = 1 << 25
_MAX_DAMAGE = 50
_LATEST_NS = 1 << 62


class CaptureInput(Input):
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
        self.last_path = self._paths[-1]
        self._offsets: list[tuple[int, int]] = []
        self._devices: list[Any] = list(self.header.get("devices") or [])
        self._describe()

    def frames(self, marked: bool = False) -> Iterator[TimedFrame]:
        """``marked``: the gateway's state in the frames is REPLAY."""
        gateway = self.setup.gateway(self.sent_layout, self._created_ns)
        replay = Replay(gateway, self.header.get("state"), marked)
        yield from replay.follow(self.entries())
        self._add_losses(replay)

    def samples(self, chosen: Sequence[int] | None = None) -> Iterator[Sample]:
        # the caller shows names, pole pairs and gears
        escs = [
            replace(own, name=shown.name, pole_pairs=shown.pole_pairs, gear=shown.gear)
            for own, shown in zip(self.setup.escs, self.bus.escs, strict=True)
        ]
        sections, makers = self._sections(chosen), []

        def make(*of_gateway: Any) -> RowMaker:
            makers.append(RowMaker(sections, *of_gateway))
            return makers[0]

        # without messages; nodes are there, because they may change pole pairs and gear
        gateway = Gateway(
            *(escs, Layout("", "", ()), self._created_ns),
            canopen=self.setup.canopen,
            further=(make,),
        )
        replay = Replay(gateway, self.header.get("state"))
        for entry in self.entries():
            replay.play(entry)
            yield from makers[0].take_rows()
        yield from makers[0].finish()
        self._add_losses(replay)

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
        """All entries of all parts. What is damaged is left out, and reported in ``damage``."""
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
                    # it stands after what was written by the clock before
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
                self._add_damage(f"{path.name}: {found.length} bytes at {found.offset} are damaged")
                continue
            if found.number > expected:
                self._add_damage(
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
                self._add_damage(f"{path.name}: the block at {found.offset} {error}")
        if not ended:
            self._add_damage(
                f"{path.name}: was not closed: up to the last second before its end may be missing"
            )

    def _add_damage(self, text: str) -> None:
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

    def _add_losses(self, replay: Replay) -> None:
        if replay.lost:
            self.damage.append(
                f"{replay.lost} entries could not be recorded: the disk was too slow or full"
            )
        if replay.rejected:
            self.damage.append(f"{replay.rejected} entries make no sense to this version")

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
            known = "device not known"
            if isinstance(device, dict):
                known = f"{device.get('device')} {device.get('variant')}, firmware {device.get('firmware')}, {device.get('layout')} layout"
            words[esc.name] = f"{known}, at {port}"
