"""An SDO server with a small object dictionary, for the tests of the server. The test sets time."""

from collections.abc import Sequence

from script import MS, Talker, bytes_of, hexadecimal, ms

from kontronik_can_gw.canopen.dictionary import Abort, Dictionary, Variable, key
from kontronik_can_gw.canopen.eds import Eds, EdsEntry
from kontronik_can_gw.canopen.sdo import SdoServer
from kontronik_can_gw.times import NEVER

_U8 = 0x05
_U16 = 0x06
_U32 = 0x07
_TEXT = 0x09
_DOMAIN = 0x0F
_U64 = 0x1B
_ENTRIES: list[tuple[int, int, int, str, int | bytes]] = [
    (0x1000, 0, _U32, "ro", 0x00020192),
    (0x1001, 0, _U8, "ro", 5),
    (0x1008, 0, _TEXT, "ro", b"KONTRONIK!"),
    (0x1017, 0, _U16, "rw", 1000),
    (0x2000, 1, _TEXT, "ro", b"abc"),
    (0x2001, 0, _TEXT, "ro", b""),
    (0x2002, 0, _U32, "wo", 0),
    (0x2003, 0, _DOMAIN, "rw", bytes(range(30))),
    (0x2004, 0, _TEXT, "rw", b""),
    (0x2005, 0, _U32, "rw", 0),
    (0x2006, 0, _U8, "rw", 7),
    (0x2008, 0, _U64, "rw", 0),
]
_HIGH = {0x2006: 100}
PLACES = [(index, sub) for index, sub, *_ in _ENTRIES]


class _TenBytes(Variable):
    max_size = 10


class Objects(Dictionary):
    """An object dictionary that records downloads.

    2004h has at most 10 bytes, 2005h is confirmed later, and 2006h is at most 100.
    """

    def __init__(self) -> None:
        entries = [
            EdsEntry(index, sub, "", kind, access, False, None, _HIGH.get(index), default, False)
            for index, sub, kind, access, default in _ENTRIES
        ]
        super().__init__(Eds(b"", "", tuple(entries), {}))
        self.written = self._note
        self.downloads: list[tuple[int, int, bytes]] = []
        self.variables[key(0x2004, 0)] = _TenBytes(self.find(0x2004, 0).entry)
        self.bind(0x2005, written=lambda _now: False)

    def _note(self, variable: Variable, _changed: bool, _now: int) -> None:
        entry = variable.entry
        self.downloads.append((entry.index, entry.sub, variable.encode(variable.value)))


class Bench(Talker):
    """A server that is the talker of dialogues (see script.py). The test sets the time."""

    def __init__(self, segment_ns: int = 0) -> None:
        super().__init__()
        self.objects = Objects()
        self.server = SdoServer(self.objects, self._sent, segment_ns)
        self.answers: list[bytes] = []
        """Answers to the last request, and the frames after them."""
        self._tickets: list[int] = []

    def _sent(self, data: bytes) -> None:
        assert len(data) == 8
        self.answers.append(data)
        self.hear(self.now, hexadecimal(data))

    def pass_time(self, until: int) -> None:
        """Let time pass from deadline to deadline, as the runtime does."""
        while self.server.due <= until:
            self.now = max(self.now, self.server.due)
            self.server.advance(self.now)
            assert self.server.due > self.now, "a deadline that advance does not settle"
        self.now = until

    def jump(self, now: int) -> None:
        self.now = now
        self.server.advance(now)

    def request(self, data: bytes) -> list[bytes]:
        """Send a request now. Return the immediate answers."""
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
                found = self.objects.downloads
                texts = [f"{at:04X}:{sub:02X}={data.hex().upper()}" for at, sub, data in found]
                return " ".join(["written", *texts])
            case "server", _:
                return f"server {'busy' if self.server.busy else 'idle'}"
            case "deadline", _:
                due = self.server.due
                return f"deadline {'none' if due == NEVER else ms(due)}"
            case "value", [place, "=", *data]:
                variable = self.objects.find(int(place[:4], 16), int(place[5:], 16))
                variable.value = bytes_of(" ".join(data))
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
    """Return a bench. The option ``segment N`` sets the pause of a block upload in ms a segment."""
    pause_ms = sum(int(option.removeprefix("segment ")) for option in options)
    return Bench(pause_ms * MS)
