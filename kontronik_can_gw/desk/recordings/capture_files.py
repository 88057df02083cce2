"""The files of a run's captures: header, data blocks, entries, the wall clock, and an account of what is damaged."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
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
from kontronik_can_gw.desk.recordings.recording import CHUNK, Input
from kontronik_can_gw.errors import RunError, UserError

Damaged = Callable[[str], None]
_LOOK_FOR_HEADER = 1 << 25
_MAX_DAMAGE = 50
_LATEST_NS = 1 << 62


class CaptureFiles(Input):
    """Captures of one run, in the order of their parts: what is in the files."""

    def _open(self, paths: Sequence[Path]) -> int:
        """Read the header; the size of all parts. What is known of the devices, ``_describe`` is to say."""
        self._paths = list(paths)
        self._headerless: list[str] = []
        self.position = self._last_ns = self._impossible = 0
        self._offsets: list[tuple[int, int]] = []
        self._file: IO[bytes] | None = None
        self.header = self._first_header()
        self._devices: list[Any] = []
        try:
            return sum(path.stat().st_size for path in self._paths)
        except OSError as error:
            raise RunError(f"{error.filename}: cannot be read: {error.strerror}.") from None

    def esc_bytes(self, esc: int) -> Iterator[bytes]:
        for entry in self.entries():
            if entry.kind == Kind.BYTES and entry.esc == esc:
                yield entry.data

    def wall_ns(self, time_ns: int) -> int | None:
        header = self.header
        begun = int(header.get("wall_ns") or 0) - int(header.get("monotonic_ns") or 0)
        offsets = (offset for since, offset in reversed(self._offsets) if since <= time_ns)
        return time_ns + next(offsets, begun)

    def entries(self) -> Iterator[Entry]:
        """All entries of all parts. What is damaged is left out, and reported in ``damage``."""
        for payload, damaged in self._data():
            yield from self._entries_of(payload, damaged)

    def _entries_of(self, payload: bytes, damaged: Damaged) -> Iterator[Entry]:
        try:
            for entry in read_entries(payload, self.header["version"]):
                if (found := self._checked(entry)) is not None:
                    yield found
        except ValueError as error:
            damaged(str(error))

    def _checked(self, entry: Entry) -> Entry | None:
        """The entry; not before the one before. None where it has no possible time."""
        time_ns, is_clock = entry.time_ns, entry.kind == Kind.CLOCK
        if time_ns > _LATEST_NS or (is_clock and len(entry.data) != 8):
            self._impossible += 1
            return None
        if is_clock:
            # it stands after what was written by the clock before
            self._offsets.append((time_ns + 1, read_number(entry.data) - time_ns))
        if time_ns < self._last_ns:
            return entry._replace(time_ns=self._last_ns)
        self._last_ns = time_ns
        return entry

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    @property
    def _created_ns(self) -> int:
        """When the recorded gateway was made: its cycles count from there."""
        return int(self.header.get("created_ns") or self.header.get("monotonic_ns") or 0)

    def _describe(self) -> None:
        """Say in ``provenance`` what is known by now."""
        raise NotImplementedError

    def _first_header(self) -> Mapping[str, Any]:
        """The header of the first part that has one; those before it are left out."""
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

    def _data(self) -> Iterator[tuple[bytes, Damaged]]:
        """The payload of each data block of all parts, and what takes in words how it is damaged."""
        self.position = self._last_ns = self._impossible = 0
        self.damage = list(self._headerless)
        self._offsets = []
        for number, path in enumerate(self._paths):
            yield from self._data_of(path, number)
        if self._impossible:
            self.damage.append(f"{self._impossible} entries have no possible time")

    def _data_of(self, path: Path, part: int) -> Iterator[tuple[bytes, Damaged]]:
        expected, ended = 0, False

        def damaged(text: str) -> None:
            if len(self.damage) <= _MAX_DAMAGE:
                is_last = len(self.damage) == _MAX_DAMAGE
                self.damage.append("and more of that kind" if is_last else f"{path.name}: {text}")

        for found in self._blocks(path):
            if isinstance(found, Damage):
                damaged(f"{found.length} bytes at {found.offset} are damaged")
                continue
            if missing := max(0, found.number - expected):
                damaged(f"{missing} blocks in front of byte {found.offset} are missing")
            expected, ended = found.number + 1, found.kind == b"E"
            try:
                if found.kind == b"D":
                    begin = f"the block at {found.offset} "
                    yield found.payload, lambda text, begin=begin: damaged(begin + text)  # type: ignore[misc]
                elif found.kind == b"I":
                    self._devices = read_json(found.payload).get("devices", self._devices)
                    self._describe()
                elif found.kind == b"H":
                    self._check_part(read_json(found.payload), path, part)
            except ValueError as error:
                damaged(f"the block at {found.offset} {error}")
        if not ended:
            damaged("was not closed: up to the last second before its end may be missing")

    def _check_part(self, header: Mapping[str, Any], path: Path, part: int) -> None:
        if header.get("run") != self.header.get("run"):
            raise UserError(
                f"{path}: is of another run than {self._paths[0]}. Convert each run by itself."
            )
        now, wall = header.get("monotonic_ns"), header.get("wall_ns")
        if all(isinstance(at, int) and 0 <= at <= _LATEST_NS for at in (now, wall)):
            self._offsets.append((int(now or 0), int(wall or 0) - int(now or 0)))
        missing = int(header.get("part", part)) - int(self.header.get("part", 0)) - part
        if missing > 0:
            self.damage.append(
                f"{path.name}: {missing} parts of the run in front of it are not given"
            )
