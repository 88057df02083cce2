"""Reads the captures of one run: headers, data blocks and wall clock, in the order of the parts.

Damaged blocks are left out and listed.
"""

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from kontronik_can_gw.assembly.capture_setup import CaptureSetup
from kontronik_can_gw.capture.format import Block as DataBlock
from kontronik_can_gw.capture.format import (
    Damage,
    Entry,
    EntryKind,
    Scanner,
    entry_at,
    event_in_words,
    read_entries,
    read_json,
    read_numbers,
)
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.core.header_parts import HeaderError
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc, shown_by
from kontronik_can_gw.desk.recordings.played import NO_MESSAGES, PlayedInput
from kontronik_can_gw.desk.recordings.recording import LATEST_NS, ClockStep, timed
from kontronik_can_gw.desk.recordings.replay import Replay, TimedFrame
from kontronik_can_gw.desk.recordings.trusted_times import TRUSTS, TrustedTimes
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.printable import counted, printable
from kontronik_can_gw.runtime.files.disk import is_locked
from kontronik_can_gw.runtime.system.clock import ClockFacts
from kontronik_can_gw.times import SECOND

if TYPE_CHECKING:
    from kontronik_can_gw.desk.recordings.offline import Frames
    from kontronik_can_gw.desk.recordings.player import Player
    from kontronik_can_gw.gateway.gateway import Gateway

CHUNK = 1 << 18
"""Number of bytes that are read at once."""
_PLAYED = frozenset({EntryKind.BYTES, EntryKind.ADVANCE, EntryKind.COUNTERS})
"""Kinds of entries that a player plays.

After one of these, it is certain that the frames of the previous turn were sent.
"""
_LOOK_FOR_HEADER = 1 << 25
"""Number of bytes of a part in which the header is looked for."""
_NO_HEADER = (
    "has no readable header, so its content cannot be interpreted. "
    "Convert another part of this run, or the whole folder."
)
_STEP_NS = 100_000_000
"""A smaller change of the wall clock is a correction and not reported."""
_MAX_EVENTS = 10
"""Number of events that are listed."""
_MAX_DAMAGE = 50
"""Number of damaged places that are listed."""


class CaptureInput(PlayedInput):
    """Captures of one run, played through the gateway's core."""

    def __init__(self, paths: Sequence[Path], layout: BusLayout | None = None) -> None:
        self._paths = list(paths)
        self._headerless: list[str] = []
        self._file: IO[bytes] | None = None
        self.header = self._first_header()
        first = self._paths[0]
        sent_layout = NO_MESSAGES
        try:
            setup = CaptureSetup.of(self.header)
            recorded = setup.database()
            if recorded is not None:
                sent_layout = recorded[1]
            setup.gateway(sent_layout, 0)
        except Exception as error:  # a damaged header can cause any exception
            raise _header_error(first, error) from None
        name = str(first)
        if len(self._paths) > 1:
            run = first.stem.rpartition("-")[0]
            name = f"{first.parent}/{run}"
        if layout is not None:
            layout = shown_by(layout, setup.escs)
        elif recorded is not None:
            layout = BusLayout(recorded[0], sent_layout, setup.escs)
        else:
            layout = layout_of_dbc(shipped("dbc/kontronik_esc.dbc"), setup.escs)
        super().__init__(name, layout, setup)
        self.sent_layout = sent_layout
        created_ns = self.header.get("created_ns") or self.header.get("monotonic_ns")
        self.created_ns = int(created_ns or 0)
        self._begun = _clock_of(self.header) or (0, 0)
        """Time of the recording at its start, and the offset of the wall clock then."""
        self.trust = TrustedTimes(clock_facts(self.header).synchronized)
        self._last_ns = 0
        """Time of the previous entry."""
        self._impossible = 0
        """Number of entries that were left out because of their times."""
        self._place = ""
        """File and position of the block that is being read, for messages."""
        self._unfinished = ""
        """The file that a recorder still writes, as a text."""
        self._devices: list[Any] = list(self.header.get("devices") or [])
        self._events: Any = self.header.get("events")
        self._describe()

    def wall_ns(self, time_ns: int) -> int | None:
        for since_ns, offset_ns in reversed(self._offsets):
            if since_ns <= time_ns:
                return time_ns + offset_ns
        return time_ns + self._begun[1]

    @property
    def clock_steps(self) -> Sequence[ClockStep]:
        return [
            ClockStep(time_ns, after - before)
            for (_, before), (time_ns, after) in pairwise([self._begun, *self._offsets])
            if abs(after - before) > _STEP_NS
        ]

    @property
    def notes(self) -> list[str]:
        return [*filter(None, [self._unfinished]), *super().notes]

    @property
    def channel(self) -> str:
        with suppress(ValueError, LookupError, TypeError, RecursionError):
            channel = str(tomllib.loads(self.setup.configuration)["can"]["channel"])
            if re.fullmatch(r"[\w.:@/-]{1,64}", channel, re.ASCII):
                return channel
        return "can0"

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def entries(self) -> Iterator[Entry]:
        """Yield all entries. Damaged ones are left out and reported in ``damage``."""
        for payload in self._payloads():
            yield from self._entries_of(payload)

    def esc_bytes(self, esc: int) -> Iterator[bytes]:
        for entry in self.entries():
            if entry.kind == EntryKind.BYTES and entry.esc == esc:
                yield entry.data

    def _play(
        self, gateway: "Gateway", player: "Player | None" = None
    ) -> "Iterator[list[TimedFrame] | Frames]":
        replay = Replay(gateway, self.header.get("state"), self.is_marked, self.setup.version)
        for frames in self._steps(replay, player):
            if player is not None:
                sent = player.take_frames()
                if len(sent):
                    yield sent
            yield frames
        if player is not None:
            yield player.take_frames(final=True)
        yield replay.finish()
        if replay.lost:
            self.damage.append(
                f"{_entries(replay.lost)} could not be recorded, "
                "because the disk was too slow or full"
            )
        if replay.rejected:
            rejected = _entries(replay.rejected)
            self.damage.append(f"{rejected} cannot be interpreted by this version")

    def _steps(self, replay: Replay, player: "Player | None") -> Iterator[list[TimedFrame]]:
        """Play all entries on the gateway of ``replay``. Yield the frames of each entry.

        The player, if there is one, plays the frequent kinds of entries. Each other entry and the
        rest of its iteration are played by ``replay``. For the player's entries an empty list is
        yielded; the caller takes their frames from the player.
        """
        if player is None:
            for payload in self._payloads():
                for entry in self._entries_of(payload):
                    yield replay.play(entry)
            return
        in_python = True
        """True if ``replay`` plays the next entry."""
        for payload in self._payloads():
            if not player.begin(payload):
                in_python = True
                yield []
                replay.add_frames(list(timed(player.take_frames(final=True))))
                for entry in self._entries_of(payload):
                    yield replay.play(entry)
                continue
            while (kind := player.next_kind) is not None:
                # waiting frames may still be dropped by an entry that the player does not play
                if in_python or (replay.frames_wait and kind not in _PLAYED):
                    entry = entry_at(payload, *player.skip())
                    checked = self._checked(entry)
                    frames = [] if checked is None else replay.play(checked)
                    if kind != EntryKind.NOT_SENT:
                        gateway = replay.gateway
                        is_free = not (gateway.is_held or gateway.is_limited)
                        in_python = kind != EntryKind.ADVANCE or not is_free
                    yield frames
                else:
                    yield replay.finish()
                    in_python, self._last_ns = player.play(self._last_ns)
                    yield []
                    if in_python:
                        replay.add_frames(list(timed(player.take_frames(final=True))))

    def _entries_of(self, payload: bytes) -> Iterator[Entry]:
        try:
            for entry in read_entries(payload, self.setup.version):
                checked = self._checked(entry)
                if checked is not None:
                    yield checked
        except ValueError as error:
            self._add_damage(f"{self._place} is left out from its damage on: it {error}")

    def _checked(self, entry: Entry) -> Entry | None:
        """Return the entry at a time not before the previous entry. None if its time is impossible.

        A clock entry also sets the offset of the wall clock.
        """
        time_ns = entry.time_ns
        is_clock = entry.kind == EntryKind.CLOCK
        wall_ns = 0
        if is_clock and len(entry.data) == 8:
            (wall_ns,) = read_numbers(entry.data)
        if time_ns > LATEST_NS or (is_clock and not 0 < wall_ns <= LATEST_NS):
            self._impossible += 1
            return None
        if is_clock:
            # entries of the same time were written before the clock was set
            self._offsets.append((time_ns + 1, wall_ns - time_ns))
            self.trust.add(time_ns + 1, TRUSTS.get(entry.flags))
        if time_ns < self._last_ns:
            return entry._replace(time_ns=self._last_ns)
        self._last_ns = time_ns
        return entry

    def _describe(self) -> None:
        """Update ``provenance`` with the data of the header and the devices."""
        header = self.header
        setup = self.setup
        program = header.get("program", {})
        version = program.get("version", "?")
        python = program.get("python", "?")
        part = int(header.get("part", 0)) + 1
        dbc = ""
        if setup.dbc:
            dbc = setup.dbc[0]
            if isinstance(header.get("layout"), str):
                dbc += f", layout {header['layout']}"
        self.provenance |= {
            "program": f"kontronik-can-gw {version}, Python {python}",
            "machine": str(program.get("machine", "")),
            "run": f"{header.get('run', '')}, part {part}",
            "configuration": setup.file,
            "DBC": dbc,
        }
        if isinstance(header.get("clock"), dict):
            self.provenance["clock at the start"] = clock_facts(header).in_words
        if self._events:
            self.provenance["recorded because of"] = _events_in_words(self._events, self._begun[0])
        for index, (esc, port) in enumerate(zip(setup.escs, setup.ports, strict=False)):
            known = "unknown device"
            if index < len(self._devices) and isinstance(self._devices[index], dict):
                device = self._devices[index]
                known = (
                    f"{device.get('device')} {device.get('variant')}, "
                    f"firmware {device.get('firmware')}, {device.get('layout')} layout"
                )
            self.provenance[esc.name] = f"{known}, at {port}"

    def _first_header(self) -> Mapping[str, Any]:
        """Return the header of the first part that has one. Parts before it are left out."""
        while True:
            path = self._paths[0]
            for found in self._blocks(path, _LOOK_FOR_HEADER):
                if isinstance(found, DataBlock) and found.kind == b"H":
                    with suppress(ValueError):
                        return read_json(found.payload)
            self.close()
            if len(self._paths) == 1:
                raise UserError(f"{path}: {_NO_HEADER}")
            self._headerless.append(f"{path.name}: left out, because it has no readable header")
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
        """Yield the data blocks of all parts. Other blocks update the state of this object.

        ``damage`` is filled while the parts are read.
        """
        self._last_ns = 0
        self._impossible = 0
        self._unfinished = ""
        self.damage = list(self._headerless)
        self._offsets = []
        self.trust.restart()
        for number, path in enumerate(self._paths):
            expected = 0
            is_closed = False
            damage: Damage | None = None
            for found in self._blocks(path):
                if damage is not None:
                    self._add_damage(_of_bytes(path, damage))
                damage = None
                if isinstance(found, Damage):
                    damage = found
                    continue
                missing = found.number - expected
                if missing > 0:
                    lost = f"{counted(missing, 'block')} lost before byte {found.offset}"
                    self._add_damage(f"{path.name}: {lost}")
                expected = found.number + 1
                is_closed = found.kind == b"E"
                self._place = f"{path.name}: the block at byte {found.offset}"
                if found.kind == b"D":
                    yield found.payload
                elif found.kind in (b"I", b"H"):
                    self._read_json(found, path, number)
            if not is_closed and is_locked(path):  # a block may be written at this moment
                self._unfinished = f"{path.name}: is still being written, up to here"
                continue
            if damage is not None:
                self._add_damage(_of_bytes(path, damage))
            if not is_closed:
                text = "was not closed, so up to a second may be missing at its end"
                self._add_damage(f"{path.name}: {text}")
        if self._impossible:
            verb = "has" if self._impossible == 1 else "have"
            self.damage.append(f"{_entries(self._impossible)} {verb} an impossible time")

    def _add_damage(self, text: str) -> None:
        if len(self.damage) < _MAX_DAMAGE:
            self.damage.append(text)
        elif len(self.damage) == _MAX_DAMAGE:
            self.damage.append("and further damage")

    def _read_json(self, block: DataBlock, path: Path, part: int) -> None:
        try:
            found = read_json(block.payload)
            if block.kind == b"H":
                self._check_part(found, path, part)
            else:
                self._devices = found.get("devices", self._devices)
                self._events = found.get("events", self._events)
                self._describe()
        except ValueError as error:
            self._add_damage(f"{self._place} is left out from its damage on: it {error}")

    def _check_part(self, header: Mapping[str, Any], path: Path, part: int) -> None:
        if header.get("run") != self.header.get("run"):
            raise UserError(
                f"{path}: is part of another run than {self._paths[0]}. "
                "Convert each run separately."
            )
        clock = _clock_of(header)
        if clock is not None:
            self._offsets.append(clock)
            self.trust.add(clock[0], clock_facts(header).synchronized)
        number = header.get("part", part)
        first = self.header.get("part", 0)
        if type(number) is not int:
            raise ValueError("has a part number that is not an integer")
        missing = number - int(first) - part
        if missing > 0:
            self.damage.append(f"{path.name}: {missing} earlier parts of the run are not given")


def clock_facts(header: Mapping[str, Any]) -> ClockFacts:
    """Return the state of the wall clock in a header.

    Values that are missing or make no sense are unknown.
    """
    clock = header.get("clock")
    if not isinstance(clock, dict):
        return ClockFacts()
    synchronized = clock.get("synchronized")
    hardware = clock.get("hardware")
    return ClockFacts(
        synchronized=synchronized if isinstance(synchronized, bool) else None,
        hardware=hardware if isinstance(hardware, str) else None,
    )


def _of_bytes(path: Path, damage: Damage) -> str:
    damaged = counted(damage.length, "damaged byte")
    return f"{path.name}: {damaged} left out, from byte {damage.offset} of the file"


def _clock_of(header: Mapping[str, Any]) -> tuple[int, int] | None:
    """Return the header's monotonic time, and Unix time minus it. None if they are impossible."""
    now = header.get("monotonic_ns")
    wall = header.get("wall_ns")
    if not isinstance(now, int) or not isinstance(wall, int):
        return None
    if not (0 <= now <= LATEST_NS and 0 <= wall <= LATEST_NS):
        return None
    return int(now), int(wall) - int(now)


def _entries(count: int) -> str:
    return "1 entry" if count == 1 else f"{count} entries"


def _events_in_words(events: Any, begin_ns: int) -> str:
    """Return the events of a capture, with their seconds after its beginning."""
    found = []
    with suppress(LookupError, TypeError):  # of a damaged header
        for event in events[:_MAX_EVENTS]:
            seconds = (event["time_ns"] - begin_ns) / SECOND
            about = event_in_words(event["esc"], event["reason"])
            found.append(f"{about} ({seconds:.1f} s)")
        if len(events) > _MAX_EVENTS:
            found.append(f"and {len(events) - _MAX_EVENTS} more")
    return printable(", ".join(found))


def _header_error(path: Path, error: Exception) -> UserError:
    """Return the message for a header that cannot be used because of ``error``."""
    problems = ["the header cannot be used: its format is invalid"]
    if isinstance(error, UserError):
        problems = list(error.problems)
    elif isinstance(error, HeaderError):
        problems = [str(error)]
    remedy = "Use another part of the run, or the version that has recorded it."
    texts = [problem[:400].rstrip(".") for problem in problems]
    return UserError(*(f"{path}: {text}. {remedy}" for text in texts))
