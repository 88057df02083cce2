"""A small object dictionary and an SDO server whose time is turned by hand, for the tests of the server."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, cast

from script import MS, Heard, bytes_of, hexadecimal, ms

from kontronik_can_gw.canopen.abort import Abort, SdoAbort
from kontronik_can_gw.canopen.sdo import SdoServer
from kontronik_can_gw.output import NEVER


@dataclass
class Entry:
    """One object. ``size``: fixed length; ``most``: greatest length; ``high``: greatest value; ``late``: confirmed later."""

    value: bytes = b""
    access: str = "rw"
    size: int | None = None
    most: int = 65536
    high: int | None = None
    late: bool = False

    def check_size(self, size: int | None) -> int:
        """Returns the greatest length."""
        most = self.most if self.size is None else self.size
        if size is not None and not (self.size or 0) <= size <= most:
            raise SdoAbort(Abort.TOO_LONG if size > most else Abort.TOO_SHORT)
        return most


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

    def check_download(self, index: int, sub: int, size: int | None) -> int:
        self.checks.append((index, sub, size))
        entry = self.entry(index, sub)
        if entry.access == "ro":
            raise SdoAbort(Abort.READ_ONLY)
        return entry.check_size(size)

    def download(self, index: int, sub: int, data: bytes, now: int) -> bool:
        entry = self.entry(index, sub)
        entry.check_size(len(data))
        if entry.high is not None and int.from_bytes(data, "little") > entry.high:
            raise SdoAbort(Abort.TOO_HIGH)
        entry.value = data
        self.written.append((index, sub, data))
        return not entry.late


class Bench(Heard):
    """A server whose time is turned by hand; a talker of dialogues (see script.py)."""

    def __init__(self, segment_ns: int = 0) -> None:
        super().__init__()
        self.objects = Dictionary()
        self.server = SdoServer(cast(Any, self.objects), self._sent, segment_ns)
        self.now = 0
        self.answers: list[bytes] = []
        """Those of the last request, and what followed it."""
        self._tickets: list[int] = []

    def _sent(self, data: bytes) -> None:
        assert len(data) == 8
        self.answers.append(data)
        self.hear(self.now, hexadecimal(data))

    def pass_time(self, until: int) -> None:
        """Let time pass as the runtime does: from deadline to deadline."""
        while (due := self.server.due) <= until:
            self.now = max(self.now, due)
            self.server.advance(self.now)
            assert self.server.due > self.now, "a deadline that advance does not settle"
        self.now = until

    def jump(self, now: int) -> None:
        self.now = now
        self.server.advance(now)

    def request(self, data: bytes) -> list[bytes]:
        """One request now, and what is answered at once."""
        self.answers = []
        self.server.receive(data, self.now)
        if self.server.waiting is not None:
            self._tickets.append(self.server.waiting)
        return self.answers

    def say(self, what: str) -> str:
        verb, _, rest = what.partition(" ")
        match verb, rest.split():
            case "<-", _:
                self.request(bytes_of(rest))
            case "written", _:
                texts = [
                    f"{index:04X}:{sub:02X}={data.hex().upper()}"
                    for index, sub, data in self.objects.written
                ]
                return " ".join(["written", *texts])
            case "checks", _:
                return " ".join(
                    [
                        "checks",
                        *(
                            f"{index:04X}:{sub:02X}={size}"
                            for index, sub, size in self.objects.checks
                        ),
                    ]
                )
            case "uploads", _:
                return f"uploads {self.objects.uploads}"
            case "server", _:
                return f"server {'busy' if self.server.busy else 'idle'}"
            case "deadline", _:
                due = self.server.due
                return f"deadline {'none' if due == NEVER else ms(due)}"
            case "value", [place, "=", *data]:
                self.objects.entries[int(place[:4], 16), int(place[5:], 16)].value = bytes_of(
                    " ".join(data)
                )
            case "reset", []:
                self.server.reset()
            case "confirm", []:
                self.server.confirm(None)
            case "confirm", ["!", code]:
                self.server.confirm(Abort[code])
            case "confirm", ["the", "first"]:
                assert len(set(self._tickets)) == len(self._tickets) > 1
                self.server.confirm(None, self._tickets[0])
            case _:
                raise AssertionError(f"what is {what!r}?")
        return what


def sdo_bench_of(options: Sequence[str]) -> Bench:
    """``segment N``: pauses of a block upload, ms a segment."""
    return Bench(sum(int(option.removeprefix("segment ")) for option in options) * MS)
