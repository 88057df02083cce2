"""A whole gateway with CANopen nodes, for tests in Python and for dialogues.

The test sets the time, and ``advance`` runs at each ``next_deadline``. Only frames that a dialogue
expects or a test takes may be sent. dialogues/README.md has the format of dialogues.
"""

import ast
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import cache, partial
from types import MappingProxyType
from typing import Any

from script import MS, Talker, bytes_of, hexadecimal, ms
from sdo_client import Refused, download, upload

from kontronik_can_gw.canopen.eds import Eds, load
from kontronik_can_gw.canopen.eds_changes import without
from kontronik_can_gw.canopen.node import Node
from kontronik_can_gw.canopen.node_settings import NodeSettings
from kontronik_can_gw.canopen.nodes import Nodes
from kontronik_can_gw.canopen.setup import CanopenSetup
from kontronik_can_gw.canopen.storage import Stored, decode
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.esc.kontronik import codec
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData
from kontronik_can_gw.esc.kontronik.states import Device
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.status import CanState

EMPTY = MessageLayout("", "", ())
OFF = 0xC0000000
"""A COB-ID of a TPDO that does not exist."""

FLAGS = ("extended", "fd", "remote")

Changes = Mapping[tuple[int, int], Mapping[str, Any]]
_SAVE = b"save"
_LOAD = b"load"


@cache
def shipped_eds() -> Eds:
    return load(shipped("eds/kontronik_esc.eds").read_bytes(), "kontronik_esc.eds")


def changed(eds: Eds, changes: Changes) -> Eds:
    """Return the EDS with other attributes of some entries, as an EDS editor may write it."""
    entries = [replace(e, **changes.get((e.index, e.sub), {})) for e in eds.entries]
    return replace(eds, entries=tuple(entries))


def default(
    index: int,
    sub: int,
    value: float | bytes,
    is_relative: bool | None = None,
) -> Changes:
    """Return the change of one default."""
    if is_relative is None:
        (entry,) = (e for e in shipped_eds().entries if (e.index, e.sub) == (index, sub))
        is_relative = entry.is_relative
    return {(index, sub): {"default": value, "is_relative": is_relative}}


NO_HEARTBEAT = default(0x1017, 0, 0)
NO_PDOS: Changes = {(0x1800 + n, 1): {"default": OFF, "is_relative": False} for n in range(6)}
SPARE: Changes = {
    (0x1A04, 0): {"default": 1},
    (0x1A04, 1): {"default": 0x20000210},
    (0x1A05, 0): {"default": 1},
    (0x1A05, 1): {"default": 0x20000210},
}
"""The two spare PDOs with battery voltage mapped, so that they only need a COB-ID to exist."""
QUIET: Changes = {**NO_HEARTBEAT, **NO_PDOS}
"""Changes after which nodes send only requested frames and EMCY."""


def live(**fields: int) -> bytes:
    """Return a live frame of the V4 layout. Fields that are not given are 0."""
    return codec.encode(LiveData(**fields), codec.WireLayout.V4)


def info(**fields: int) -> bytes:
    """Return an info frame of the V4 layout."""
    return codec.encode(InfoData(**fields), codec.WireLayout.V4)


class Bench(Talker):
    """A gateway with ``nodes`` ESCs and nodes. The test sets the time.

    The node-IDs are 1, 2, … and the serial numbers 77, 78, and so on. ``changes`` are made to the
    shipped EDS. ``settings`` are further fields of every NodeSettings. ``escs`` has further fields
    of every EscSettings, or is a list of EscSettings.
    """

    def __init__(
        self,
        nodes: int = 1,
        changes: Changes | None = None,
        *,
        eds: Eds | None = None,
        stored: Sequence[Stored] | None = None,
        node_ids: Sequence[int] | None = None,
        layout: MessageLayout = EMPTY,
        escs: Mapping[str, Any] | Sequence[EscSettings] = MappingProxyType({}),
        boot: bool = True,
        **settings: Any,
    ) -> None:
        super().__init__()
        if isinstance(escs, Mapping):
            count = nodes if node_ids is None else len(node_ids)
            escs = [EscSettings(f"esc{n}", **escs) for n in range(count)]
        base = tuple(escs)
        node_ids = node_ids or range(1, len(base) + 1)
        self._arguments = dict(
            changes=changes,
            eds=eds,
            node_ids=node_ids,
            layout=layout,
            escs=escs,
            **settings,
        )
        node_settings = []
        for serial, node_id in enumerate(node_ids, 77):
            node_settings.append(NodeSettings(node_id, serial=serial, **settings))
        self.setup = CanopenSetup(
            changed(eds or shipped_eds(), changes or {}),
            tuple(node_settings),
            tuple(stored or [Stored()] * len(node_ids)),
            base,
        )
        self.gateway = Gateway(
            CoreSettings(self.setup.esc_settings(base), layout), 0, outputs=[self.setup]
        )
        self.on_disk = list(self.setup.stored)
        self.now = 0
        self.heard: list[tuple[int, CanFrame]] = []
        """Frames that were sent and not taken yet, with their times."""
        self.gateway.start(0)
        self._collect()
        if boot:
            self.take()

    @property
    def output(self) -> Nodes:
        (output,) = self.gateway.outputs
        assert isinstance(output, Nodes)
        return output

    @property
    def nodes(self) -> list[Node]:
        return self.output.nodes

    def restart(self) -> None:
        """End the program and start it with the data on disk. The time begins at 0 again."""
        self.__init__(**self._arguments, stored=self.on_disk)  # type: ignore[misc]

    # --- step by step

    def pass_time(self, until: int) -> None:
        """Let time pass until this time in ns."""
        while True:
            before = self.gateway.next_deadline()
            due = max(self.now, before)
            if due > until:
                break
            self.now = due
            self.gateway.advance(due)
            self._collect()
            assert self.gateway.next_deadline() > before, "a deadline that does not move on"
        self.now = until

    def wait(self, ms: float) -> None:
        self.pass_time(self.now + round(ms * MS))

    def put(self, can_id: int, data: bytes | str, **flags: bool) -> None:
        """Receive a frame from the bus."""
        if isinstance(data, str):
            data = bytes.fromhex(data)
        self.gateway.receive_frame(CanFrame(can_id, data, **flags), self.now, self.now)
        self._collect()

    def uart(self, frame: bytes, esc: int = 0) -> None:
        """Receive bytes from an ESC."""
        self.gateway.receive_bytes(esc, frame, self.now, self.now)
        self._collect()

    def start(self, node: int = 0) -> "Bench":
        """Send NMT start, and discard the frames that it causes."""
        self.put(0, bytes((1, node)))
        self.take()
        return self

    def take(self) -> list[CanFrame]:
        """Return the frames that were sent since the last call."""
        heard = self.heard
        self.heard = []
        return [frame for _, frame in heard]

    def answer_saves(self, error: str | None = None) -> list[tuple[int, Stored]]:
        """Store the waiting parameters, or let storing fail with an error."""
        saves = self.gateway.take_saves()
        stored = [(esc, decode(content)) for esc, content in saves]
        for esc, parameters in stored:
            self.gateway.saved(esc, error, self.now)
            if error is None:
                self.on_disk[esc] = parameters
        self._collect()
        return stored

    def can_state(self, name: str) -> None:
        self.gateway.set_can_state(CanState[name], self.now)

    # --- SDO

    def ask(self, node: int, request: bytes) -> bytes:
        """Send a request and return its only answer."""
        self.put(0x600 + node, request)
        return self._answer(node)

    def read(
        self,
        index: int,
        sub: int = 0,
        node: int = 1,
    ) -> bytes | int:
        """Return the data of an upload, or its abort code."""
        try:
            return upload(partial(self.ask, node), index, sub)
        except Refused as refused:
            return refused.code

    def write(
        self,
        index: int,
        sub: int,
        data: bytes | int,
        node: int = 1,
        size: int = 4,
    ) -> int | None:
        """Download data. Return None if it is confirmed, or its abort code.

        Parameters to be stored are stored immediately.
        """
        if isinstance(data, int):
            data = data.to_bytes(size, "little", signed=data < 0)
        try:
            download(partial(self._ask_and_store, node), index, sub, data)
        except Refused as refused:
            return refused.code
        return None

    def number(
        self,
        index: int,
        sub: int = 0,
        node: int = 1,
    ) -> int:
        """Return the data of an upload as an unsigned number."""
        data = self.read(index, sub, node)
        assert isinstance(data, bytes), f"{index:04X}h:{sub:02X}: {data:08X}h"
        return int.from_bytes(data, "little")

    def _ask_and_store(self, node: int, request: bytes) -> bytes:
        self.put(0x600 + node, request)
        if request[4:] in (_SAVE, _LOAD):
            self.answer_saves()
        return self._answer(node)

    def _answer(self, node: int) -> bytes:
        """Return the only SDO response of a node."""
        answers = []
        others = []
        for time, frame in self.heard:
            if frame.can_id == 0x580 + node:
                answers.append(frame)
            else:
                others.append((time, frame))
        self.heard = others
        assert len(answers) == 1, f"{len(answers)} answers of node {node}"
        return answers[0].data

    # --- dialogues (script.Talker)

    def jump(self, now: int) -> None:
        """Let time pass without serving deadlines, as if the program hung."""
        self.now = now
        self.gateway.advance(now)

    def say(self, what: str) -> str:
        """Execute a line. Return the line with the actual answer or state."""
        verb, _, rest = what.partition(" ")
        match verb, rest.split():
            case "<-", [cob_id, *data]:
                flags = {name: True for name in data if name in FLAGS}
                frame = bytes_of(" ".join(word for word in data if word not in FLAGS))
                self.put(int(cob_id, 16), frame, **flags)
            case "uart", [esc, "rubbish"]:
                self.uart(b"rubbish", int(esc))
            case "uart", [esc, "wrong", "CRC"]:
                self.uart(live()[:-1] + b"\xff", int(esc))
            case "uart", [esc, kind, *fields]:
                values = {}
                for field in fields:
                    name, value = field.split("=")
                    values[name] = int(value, 0)
                make = live if kind == "live" else info
                self.uart(make(**values), int(esc))
            case (("read" | "write"), _):
                return self._say_sdo(verb, rest)
            case "port", ["lost", esc]:
                self.gateway.port(int(esc), False, self.now)
            case "port", ["opened", esc]:
                self.gateway.port(int(esc), True, self.now)
            case "can", ["returned"]:
                self.gateway.can_returned(self.now)
            case "can", ["overrun"]:
                self.gateway.receive_overrun(self.now)
            case "can", [state]:
                self.can_state(state)
            case "damaged", [esc]:
                self.gateway.parameters_damaged(int(esc), self.now)
            case "disk", ["takes"]:
                self.gateway.take_saves()
            case "disk", ["done" | "fails" as how, *esc]:
                error = "disk full" if how == "fails" else None
                if esc:
                    self.gateway.saved(int(esc[0]), error, self.now)
                else:
                    self.answer_saves(error)
            case "stored", [node, *_]:
                text = _stored_text(self.on_disk[int(node) - 1])
                return f"stored {node} {text}".rstrip()
            case "restart", []:
                self.restart()
            case "state", [node, _]:
                return f"state {node} {self.nodes[int(node) - 1].state:02X}"
            case "listens", _:
                cob_ids = [f"{cob_id:03X}" for cob_id in sorted(self.output.receive_ids)]
                return f"listens {' '.join(cob_ids)}"
            case "slave", _:
                return f"slave {'configuration' if self.nodes[0].lss.is_configuring else 'waiting'}"
            case "node-id", _:
                first = self.nodes[0]
                return f"node-id {first.node_id} {first.identity.pending_node_id}"
            case "reset", []:
                self.nodes[0].lss.reset()
            case "rejected", [node, *_]:
                keys = sorted(self.nodes[int(node) - 1].parameters.rejected)
                return " ".join(["rejected", node, *map(_name, keys)])
            case _:
                raise AssertionError(f"what is {what!r}?")
        return what

    def _say_sdo(self, verb: str, rest: str) -> str:
        match = re.fullmatch(r"(\d+) (\w{4}:\w\w)((?: [0-9A-F]{2})*)(?: [=!].*)?", rest)
        assert match is not None, f"what is {rest!r}?"
        node = int(match[1])
        place = _place(match[2])
        data = bytes.fromhex(match[3])
        line = f"{verb} {node} {match[2]} {hexadecimal(data)}".rstrip()
        if verb == "read":
            found = self.read(*place, node)
        else:
            result = self.write(*place, data, node)
            if result is None:
                return line
            found = result
        if isinstance(found, int):
            return f"{line} ! {found:08X}"
        return f"{line} = {hexadecimal(found)}".rstrip()

    def _collect(self) -> None:
        self.heard += [(self.now, frame) for frame in self.gateway.take_frames(self.now)]

    def heard_lines(self) -> list[str]:
        """Return the frames that were sent since the last call, as lines."""
        self._collect()
        lines = []
        for time, frame in self.heard:
            flags = "".join(f" {name}" for name in FLAGS if getattr(frame, name))
            text = f"{frame.can_id:03X} {hexadecimal(frame.data)}{flags}"
            lines.append(f"{ms(time)} -> {text}".rstrip())
        self.heard = []
        return lines


def _name(number: int) -> str:
    """Return the name of an object, for example ``1017:00``."""
    return f"{number >> 8:04X}:{number & 0xFF:02X}"


def _place(name: str) -> tuple[int, int]:
    """Return index and sub-index of a name such as ``1017:00``."""
    return int(name[:4], 16), int(name[5:], 16)


def _stored_text(stored: Stored) -> str:
    """Return stored data as text, for example ``node-id 7 1017:00=F401 2100:01=05``."""
    values = sorted(stored.values.items())
    texts = [f"{_name(number)}={data.hex().upper()}" for number, data in values]
    node_id = [] if stored.node_id is None else ["node-id", str(stored.node_id)]
    return " ".join([*node_id, *texts])


def _stored(words: Sequence[str]) -> Stored:
    node_id = None
    if words[:1] == ["node-id"]:
        node_id = int(words[1])
        words = words[2:]
    values: dict[int, bytes] = {}
    for word in words:
        name, _, data = word.partition("=")
        index, sub = _place(name)
        values[index << 8 | sub] = bytes.fromhex(data)
    return Stored(node_id, values)


def bench_of(options: Sequence[str]) -> Bench:
    """Return a bench with the options of a dialogue (see ``dialogues/README.md``)."""
    changes: dict[tuple[int, int], Any] = {}
    arguments: dict[str, Any] = {}
    kept: Changes = QUIET
    for option in options:
        match option.split():
            case ["nodes", count]:
                arguments["nodes"] = int(count)
            case ["node-ids", *ids]:
                arguments["node_ids"] = [int(node_id) for node_id in ids]
            case ["heartbeat"]:
                kept = {key: change for key, change in kept.items() if key != (0x1017, 0)}
            case ["pdos"]:
                kept = {key: change for key, change in kept.items() if key[0] < 0x1800}
            case ["spare"]:
                changes.update(SPARE)
            case ["tpdo", number, _, kind, _, inhibit, _, timer, _, *mapped]:
                entries = [int(each, 16) for each in mapped]
                changes.update(tpdo(int(number), int(kind), int(inhibit), int(timer), *entries))
            case ["identity" | "active", *_]:
                pass
            case ["boot"]:
                arguments["boot"] = False
            case ["started"]:
                pass
            case ["self-start" | "read-only" as flag]:
                arguments[flag.replace("-", "_")] = True
            case ["device", name]:
                arguments["device"] = Device[name]
            case ["bitrate", value]:
                arguments["bitrate"] = int(value)
            case ["esc", *words]:
                pairs = (word.split("=") for word in words)
                arguments["escs"] = {
                    key: Fraction(value) if "/" in value else int(value) for key, value in pairs
                }
            case ["stored", *words]:
                arguments.setdefault("stored", []).append(_stored(words))
            case ["drop", *indices]:
                dropped = {int(index, 16) for index in indices}
                arguments["eds"] = load(without(shipped_eds().data, dropped), "my.eds")
            case [place, *words] if re.fullmatch("[0-9A-F]{4}:[0-9A-F]{2}", place):
                if words[0] == "=":
                    base = int(words[1].removeprefix("$NODEID+"), 16)
                    change = {"default": base, "is_relative": words[1].startswith("$NODEID+")}
                else:
                    pairs = (word.split("=") for word in words)
                    change = {key: _attribute(value) for key, value in pairs}
                changes.setdefault(_place(place), {}).update(change)
            case _:
                raise AssertionError(f"what is 'with {option}'?")
    bench = Bench(changes={**kept, **changes}, **arguments)
    for option in options:
        match option.split():
            case ["identity", *parts]:
                for sub, part in enumerate(parts, 1):
                    variable = bench.nodes[0].dictionary.find(0x1018, sub)
                    variable.power_on = variable.value = int(part, 16)
            case ["active", "and", "pending", active, pending]:
                bench.nodes[0].identity.active_node_id = int(active)
                bench.nodes[0].parameters.set_node_id = int(pending)
    return bench.start() if "started" in options else bench


def _attribute(text: str) -> Any:
    """Return the value of a text: True for "yes", None for "none", a number, bytes or a word."""
    if text in ("yes", "none"):
        return True if text == "yes" else None
    try:
        return ast.literal_eval(text)
    except ValueError:
        return text


def tpdo(
    number: int,
    kind: int = 254,
    inhibit: int = 0,
    timer: int = 0,
    *mapped: int,
) -> Changes:
    """Return the changes for a TPDO with its shipped COB-ID, by default of the battery voltage."""
    mapped = mapped or (0x20000210,)
    index = 0x1800 + number - 1
    values = {(index, 2): kind, (index, 3): inhibit, (index, 5): timer}
    values[index + 0x200, 0] = len(mapped)
    for sub, entry in enumerate(mapped, 1):
        values[index + 0x200, sub] = entry
    changes: dict[tuple[int, int], Any] = {}
    for place, value in values.items():
        changes[place] = {"default": value}
    changes[index, 1] = {"default": 0x40000080 + 0x100 * number, "is_relative": True}
    return changes
