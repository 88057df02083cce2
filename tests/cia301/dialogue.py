"""Dialogues with CANopen nodes: who says what and when, as text, played against a whole gateway.

One line for each frame or happening, times in ms from power-on, data in hexadecimal::

     time    what
       0 <- 000 01 00                                 a frame from the bus
       0 -> 701 05                                    a frame that the node is to send; ".." stands for any byte
      10 uart 0 live battery_voltage=2442             a UART frame of an ESC, fields as in LiveData and InfoData
      20 read 1 2000:02 = 8A 09                       an upload by SDO from node 1, and its data
      20 read 1 2001:05 ! 08000024                    the same, refused
      30 write 1 1017:00 F4 01                        a download that is confirmed; with "! code" refused
      40 do gateway.port_lost(0, now)                 anything else
     500 -                                            nothing more until then

Between the lines time passes by ``advance`` at each ``next_deadline``; what is due at the time of a line comes before it. Nothing
but what is written may be sent. Text behind ";" is a comment.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from difflib import ndiff
from functools import cache
from typing import Any

from kontronik_can_gw.cia301.eds import Eds, load
from kontronik_can_gw.cia301.node import Node, NodeSettings
from kontronik_can_gw.cia301.nodes import CanopenSetup
from kontronik_can_gw.cia301.storage import Stored
from kontronik_can_gw.config import shipped
from kontronik_can_gw.dbc_output.layout import Layout
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.protocol import codec
from kontronik_can_gw.protocol.fields import InfoData, LiveData
from kontronik_can_gw.sources import CanState
from kontronik_can_gw.telemetry import EscSettings

MS = 1_000_000
EMPTY = Layout("", "", ())
OFF = 0xC0000000
"""A COB-ID of a TPDO that does not exist."""

Changes = Mapping[tuple[int, int], Mapping[str, Any]]
_SAVE, _LOAD = b"save", b"load"


@cache
def shipped_eds() -> Eds:
    return load(shipped("eds/kontronik_esc.eds").read_bytes(), "kontronik_esc.eds")


def changed(eds: Eds, changes: Changes) -> Eds:
    """The EDS with other attributes of some entries, as after an EDS editor."""
    entries = [replace(e, **changes.get((e.index, e.sub), {})) for e in eds.entries]
    return replace(eds, entries=tuple(entries))


def default(index: int, sub: int, value: float | bytes, relative: bool | None = None) -> Changes:
    """One changed default."""
    entry = next(e for e in shipped_eds().entries if (e.index, e.sub) == (index, sub))
    return {(index, sub): {"default": value, "relative": entry.relative if relative is None else relative}}


NO_HEARTBEAT = default(0x1017, 0, 0)
NO_PDOS: Changes = {(0x1800 + n, 1): {"default": OFF, "relative": False} for n in range(6)}
SPARE: Changes = {
    (index, sub): {"default": value}
    for n in (4, 5)
    for index, sub, value in ((0x1A00 + n, 0, 1), (0x1A00 + n, 1, 0x20000210))
}
"""The two spare PDOs with battery voltage mapped, so that they need only a COB-ID to exist."""
QUIET: Changes = {**NO_HEARTBEAT, **NO_PDOS}
"""Changes that leave only frames that are asked for, and EMCY."""


def live(**fields: int) -> bytes:
    """A live frame of the V4 layout. Fields not named are 0."""
    return codec.encode(LiveData(**fields), codec.Layout.V4)


def info(**fields: int) -> bytes:
    """An info frame of the V4 layout."""
    return codec.encode(InfoData(**fields), codec.Layout.V4)


class Bench:
    """A gateway with ``nodes`` ESCs and nodes, node-IDs 1, 2, … and serial numbers 77, 78, …, whose time is turned by hand.

    ``changes`` are made to the shipped EDS. ``settings`` are further fields of every NodeSettings, ``escs`` those of EscSettings.
    """

    def __init__(
        self,
        nodes: int = 1,
        changes: Changes | None = None,
        *,
        eds: Eds | None = None,
        stored: Sequence[Stored] | None = None,
        node_ids: Sequence[int] | None = None,
        layout: Layout = EMPTY,
        escs: Mapping[str, Any] | None = None,
        boot: bool = True,
        **settings: Any,
    ) -> None:
        node_ids = range(1, nodes + 1) if node_ids is None else node_ids
        base = tuple(EscSettings(f"esc{n}", **(escs or {})) for n in range(len(node_ids)))
        self.setup = CanopenSetup(
            changed(eds or shipped_eds(), changes or {}),
            tuple(NodeSettings(i, serial=77 + n, **settings) for n, i in enumerate(node_ids)),
            tuple(stored or [Stored()] * len(node_ids)),
            base,
        )
        self.gateway = Gateway(self.setup.esc_settings(base), layout, 0, canopen=self.setup)
        self.now = 0
        self.heard: list[tuple[int, CanFrame]] = []
        """What was sent and not looked at yet, with its time."""
        self.gateway.start(0)
        self._collect()
        if boot:
            self.take()

    @property
    def nodes(self) -> list[Node]:
        assert self.gateway.nodes is not None
        return self.gateway.nodes.nodes

    @property
    def listened_to(self) -> frozenset[int]:
        """COB-IDs that the nodes take."""
        assert self.gateway.nodes is not None
        return self.gateway.nodes.receive_ids

    # --- step by step

    def pass_time(self, until: int) -> None:
        """Let time pass, ns."""
        while (due := max(self.now, self.gateway.next_deadline())) <= until:
            before = self.gateway.next_deadline()
            self.now = due
            self.gateway.advance(due)
            self._collect()
            assert self.gateway.next_deadline() > before, "a deadline that does not move on"
        self.now = until

    def wait(self, ms: float) -> None:
        self.pass_time(self.now + round(ms * MS))

    def put(self, can_id: int, data: bytes | str, **flags: bool) -> None:
        """A frame from the bus."""
        if isinstance(data, str):
            data = bytes.fromhex(data)
        self.gateway.receive_frame(CanFrame(can_id, data, **flags), self.now)
        self._collect()

    def uart(self, frame: bytes, esc: int = 0) -> None:
        """Bytes from an ESC."""
        self.gateway.receive_bytes(esc, frame, self.now)
        self._collect()

    def start(self, node: int = 0) -> "Bench":
        """NMT start, and what it causes passed over."""
        self.put(0, bytes((1, node)))
        self.take()
        return self

    def take(self) -> list[CanFrame]:
        """What was sent since the last call."""
        heard, self.heard = self.heard, []
        return [frame for _, frame in heard]

    def answer_saves(self, error: str | None = None) -> list[tuple[int, Stored]]:
        """Store what waits to be stored, or let it fail."""
        saves = self.gateway.take_saves()
        for esc, _ in saves:
            self.gateway.saved(esc, error, self.now)
        self._collect()
        return saves

    def can_state(self, name: str) -> None:
        self.gateway.set_can_state(CanState[name], self.now)

    # --- SDO

    def ask(self, node: int, request: bytes) -> bytes:
        """One request and its one answer."""
        self.gateway.receive_frame(CanFrame(0x600 + node, request), self.now)
        self._collect()
        return self._answer(node)

    def read(self, index: int, sub: int = 0, node: int = 1) -> bytes | int:
        """The data of an upload, or its abort code."""
        multiplexer = index.to_bytes(2, "little") + bytes((sub,))
        answer = self.ask(node, b"\x40" + multiplexer + bytes(4))
        if answer[0] == 0x80:
            assert answer[1:4] == multiplexer
            return int.from_bytes(answer[4:], "little")
        assert answer[1:4] == multiplexer
        if answer[0] & 2:
            return answer[4 : 8 - (answer[0] >> 2 & 3)]
        assert answer[0] == 0x41
        size = int.from_bytes(answer[4:], "little")
        data, toggle = b"", 0
        while True:
            answer = self.ask(node, bytes((0x60 | toggle,)) + bytes(7))
            assert answer[0] & 0xF0 == toggle
            data += answer[1 : 8 - (answer[0] >> 1 & 7)]
            toggle ^= 0x10
            if answer[0] & 1:
                assert len(data) == size
                return data

    def write(self, index: int, sub: int, data: bytes | int, node: int = 1, size: int = 4) -> int | None:
        """The abort code of a download, None where it is confirmed. What is to be stored is stored at once."""
        if isinstance(data, int):
            data = data.to_bytes(size, "little", signed=data < 0)
        multiplexer = index.to_bytes(2, "little") + bytes((sub,))
        if 1 <= len(data) <= 4:
            request = bytes((0x23 | 4 - len(data) << 2,)) + multiplexer + data.ljust(4, b"\0")
            if data in (_SAVE, _LOAD) and index in (0x1010, 0x1011):
                self.put(0x600 + node, request)
                self.answer_saves()
                return self._confirmed(self._answer(node), b"\x60" + multiplexer + bytes(4))
            return self._confirmed(self.ask(node, request), b"\x60" + multiplexer + bytes(4))
        answer = self.ask(node, b"\x21" + multiplexer + len(data).to_bytes(4, "little"))
        if answer[0] == 0x80:
            return self._confirmed(answer, b"")
        toggle = 0
        parts = [data[at : at + 7] for at in range(0, len(data), 7)] or [b""]
        for number, part in enumerate(parts, 1):
            command = toggle | (7 - len(part)) << 1 | (number == len(parts))
            answer = self.ask(node, bytes((command,)) + part.ljust(7, b"\0"))
            if answer[0] == 0x80:
                return self._confirmed(answer, b"")
            assert answer == bytes((0x20 | toggle,)) + bytes(7)
            toggle ^= 0x10
        return None

    def number(self, index: int, sub: int = 0, node: int = 1) -> int:
        """An upload as an unsigned number."""
        data = self.read(index, sub, node)
        assert isinstance(data, bytes), f"{index:04X}h:{sub:02X}: {data:08X}h"
        return int.from_bytes(data, "little")

    def store(self, part: int = 1, node: int = 1) -> Stored:
        """What a download to 1010h asks to be stored; it is, and the download is confirmed."""
        self.put(0x600 + node, b"\x23\x10\x10" + bytes((part,)) + _SAVE)
        ((esc, stored),) = self.answer_saves()
        assert esc == next(n for n, other in enumerate(self.nodes) if other.node_id == node)
        assert self._answer(node) == b"\x60\x10\x10" + bytes((part,)) + bytes(4)
        return stored

    def _answer(self, node: int) -> bytes:
        """The one SDO answer that a node has given."""
        answers = [f for _, f in self.heard if f.can_id == 0x580 + node]
        self.heard = [(t, f) for t, f in self.heard if f.can_id != 0x580 + node]
        assert len(answers) == 1, f"{len(answers)} answers of node {node}"
        return answers[0].data

    @staticmethod
    def _confirmed(answer: bytes, expected: bytes) -> int | None:
        if answer[0] == 0x80:
            return int.from_bytes(answer[4:], "little")
        assert answer == expected
        return None

    # --- dialogues

    def talk(self, text: str, **names: Any) -> None:
        """Play a dialogue. ``names``: what its "do" lines may use besides ``gateway``, ``bench`` and ``now``."""
        expected = [_normal(line) for raw in text.splitlines() if (line := raw.partition(";")[0].strip())]
        actual: list[str] = []
        for line in expected:
            time, what = line.split(maxsplit=1)
            self.pass_time(max(self.now, round(float(time) * MS)))
            self._write_down(actual)
            if what.startswith("->"):
                continue
            assert round(float(time) * MS) == self.now, f"lines in the order of time: {line}"
            actual.append(f"{time} {self._play(what, names)}")
            self._collect()
            self._write_down(actual)
        compared = [_with_wildcards(was, wanted) for was, wanted in zip(actual, expected, strict=False)]
        compared += actual[len(compared) :]
        if compared != expected:
            raise AssertionError("expected (-) and heard (+):\n" + "\n".join(ndiff(expected, compared)))

    def _play(self, what: str, names: Mapping[str, Any]) -> str:
        verb, _, rest = what.partition(" ")
        if verb == "<-":
            cob_id, _, data = rest.partition(" ")
            self.gateway.receive_frame(CanFrame(int(cob_id, 16), bytes.fromhex(data)), self.now)
        elif verb == "uart":
            esc, kind, *fields = rest.split()
            values = {name: int(value, 0) for name, value in (field.split("=") for field in fields)}
            self.gateway.receive_bytes(int(esc), (live if kind == "live" else info)(**values), self.now)
        elif verb == "do":
            scope = {"gateway": self.gateway, "bench": self, "now": self.now, **names}
            exec(rest, scope)
        elif verb in ("read", "write"):
            return self._play_sdo(verb, rest)
        else:
            assert verb == "-", f"what is {what!r}?"
        return what

    def _play_sdo(self, verb: str, rest: str) -> str:
        match = re.fullmatch(r"(\d+) ([0-9A-F]{4}):([0-9A-F]{2})((?: [0-9A-F]{2})*)(?: [=!].*)?", rest)
        assert match is not None, f"what is {rest!r}?"
        node, index, sub = int(match[1]), int(match[2], 16), int(match[3], 16)
        data = bytes.fromhex(match[4])
        told = f"{verb} {node} {match[2]}:{match[3]}"
        if verb == "read":
            found = self.read(index, sub, node)
            return f"{told} ! {found:08X}" if isinstance(found, int) else f"{told} = {_hex(found)}".rstrip()
        refused = self.write(index, sub, data, node)
        return f"{told} {_hex(data)}" + ("" if refused is None else f" ! {refused:08X}")

    def _collect(self) -> None:
        self.heard += [(self.now, frame) for frame in self.gateway.take_frames()]

    def _write_down(self, actual: list[str]) -> None:
        for time, frame in self.heard:
            flags = "".join(f" {name}" for name in ("extended", "fd", "remote") if getattr(frame, name))
            actual.append(f"{_ms(time)} -> {frame.can_id:03X} {_hex(frame.data)}{flags}".rstrip())
        self.heard = []


def play(text: str, bench: Bench | None = None, **names: Any) -> Bench:
    """A dialogue with one quiet node that has booted (see QUIET), or with another bench."""
    bench = bench or Bench(changes=QUIET)
    bench.talk(text, **names)
    return bench


def repeated(text: Callable[[int], str], times: Sequence[int]) -> str:
    """Lines for each of some times."""
    return "\n".join(text(time) for time in times)


def _ms(time: int) -> str:
    return f"{round(time / MS, 3):g}" if time < 100_000 * MS else f"{time // MS}"


def _hex(data: bytes) -> str:
    return data.hex(" ").upper()


def _normal(line: str) -> str:
    time, what = line.split(maxsplit=1)
    if what.startswith("do "):
        return f"{float(time):g} {what}"
    return f"{float(time):g} " + " ".join(what.split())


def _with_wildcards(was: str, wanted: str) -> str:
    """``was`` with ".." where ``wanted`` has it."""
    one, other = was.split(), wanted.split()
    if len(one) != len(other) or ".." not in other:
        return was
    return " ".join(".." if b == ".." else a for a, b in zip(one, other, strict=True))
