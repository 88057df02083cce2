"""A small object dictionary and an SDO server whose time is turned by hand, for the tests of the server."""

from collections.abc import Iterable
from dataclasses import dataclass, field

from kontronik_can_gw.cia301.abort import Abort, SdoAbort
from kontronik_can_gw.cia301.sdo import SdoServer

MS = 1_000_000

Line = tuple[float, str, str]
"""Time in ms, ">" to the server or "<" from it, the bytes in hexadecimal."""


@dataclass
class Entry:
    """One object. ``size``: fixed length; ``most``: greatest length; ``high``: greatest value; ``late``: confirmed later."""

    value: bytes = b""
    access: str = "rw"
    size: int | None = None
    most: int | None = None
    high: int | None = None
    late: bool = False


def usual_entries() -> dict[tuple[int, int], Entry]:
    return {
        (0x1000, 0): Entry(bytes.fromhex("92010200"), "ro", size=4),
        (0x1001, 0): Entry(b"\x05", "ro", size=1),
        (0x1008, 0): Entry(b"KONTRONIK!", "ro", most=10),
        (0x1017, 0): Entry(b"\xe8\x03", size=2),
        (0x2000, 1): Entry(b"abc", "ro", most=3),
        (0x2001, 0): Entry(b"", "ro"),
        (0x2002, 0): Entry(b"", "wo", size=4),
        (0x2003, 0): Entry(bytes(range(30))),
        (0x2004, 0): Entry(b"", most=10),
        (0x2005, 0): Entry(b"", size=4, late=True),
        (0x2006, 0): Entry(b"\x07", size=1, high=100),
        (0x2008, 0): Entry(bytes(8), size=8),
    }


@dataclass
class Dictionary:
    """Remembers what was asked and written."""

    entries: dict[tuple[int, int], Entry] = field(default_factory=usual_entries)
    uploads: int = 0
    checks: list[tuple[int, int, int | None]] = field(default_factory=list)
    written: list[tuple[int, int, bytes]] = field(default_factory=list)

    def entry(self, index: int, sub: int) -> Entry:
        entry = self.entries.get((index, sub))
        if entry is None:
            known = any(index == other for other, _ in self.entries)
            raise SdoAbort(Abort.NO_SUB_INDEX if known else Abort.NO_OBJECT)
        return entry

    def upload(self, index: int, sub: int, now: int) -> bytes:
        self.uploads += 1
        entry = self.entry(index, sub)
        if entry.access == "wo":
            raise SdoAbort(Abort.WRITE_ONLY)
        return entry.value

    def check_download(self, index: int, sub: int, size: int | None) -> None:
        self.checks.append((index, sub, size))
        entry = self.entry(index, sub)
        if entry.access == "ro":
            raise SdoAbort(Abort.READ_ONLY)
        if size is not None and entry.size is not None and size != entry.size:
            raise SdoAbort(Abort.TOO_LONG if size > entry.size else Abort.TOO_SHORT)

    def download(self, index: int, sub: int, data: bytes, now: int) -> bool:
        entry = self.entry(index, sub)
        if entry.size is not None and len(data) != entry.size:
            raise SdoAbort(Abort.TYPE)
        if entry.high is not None and int.from_bytes(data, "little") > entry.high:
            raise SdoAbort(Abort.TOO_HIGH)
        entry.value = data
        self.written.append((index, sub, data))
        return not entry.late

    def max_size(self, index: int, sub: int) -> int | None:
        entry = self.entry(index, sub)
        return entry.most if entry.size is None else entry.size


class Bench:
    """A server with everything it was told and said."""

    def __init__(self, segment_ns: int = 0) -> None:
        self.objects = Dictionary()
        self.server = SdoServer(self.objects, self._sent, segment_ns)
        self.now = 0
        self.log: list[Line] = []
        self.answers: list[bytes] = []

    def _sent(self, data: bytes) -> None:
        assert len(data) == 8
        self.answers.append(data)
        self.log.append((self.now / MS, "<", data.hex(" ")))

    def wait_until(self, now: int) -> None:
        """Let time pass as the runtime does: from deadline to deadline."""
        while (deadline := self.server.next_deadline()) is not None and deadline <= now:
            self.now = max(self.now, deadline)
            self.server.advance(self.now)
            following = self.server.next_deadline()
            assert following is None or following > self.now, "a deadline that advance does not settle"
        self.now = now

    def request(self, data: bytes) -> list[bytes]:
        """One request now, and what is answered at once."""
        self.answers = []
        self.log.append((self.now / MS, ">", data.hex(" ")))
        self.server.receive(data, self.now)
        return self.answers

    def play(self, lines: Iterable[Line]) -> None:
        """Say the client's lines at their times and expect exactly the server's, no more and no other."""
        lines = list(lines)
        for time, direction, data in lines:
            self.wait_until(round(time * MS))
            if direction == ">":
                self.request(bytes.fromhex(data))
        expected = [(time, direction, bytes.fromhex(data).hex(" ")) for time, direction, data in lines]
        assert self.log == expected, "\n".join(["said:", *map(str, self.log), "expected:", *map(str, expected)])
