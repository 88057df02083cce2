"""A node as an LSS slave sees it, and the slave as the talker of dialogues."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

from script import Talker, bytes_of, hexadecimal, ms

from kontronik_can_gw.canopen.lss import LssSlave

Identity = tuple[int, int, int, int]
ME: Identity = (0x01020304, 0x11121314, 0x00020001, 0xA1B2C3D4)
UNCONFIGURED = 255


@dataclass
class Node:
    """What LSS needs of a node, with knobs: refuse writes, refuse or delay the saving."""

    identity: Identity = ME
    active_node_id: int = UNCONFIGURED
    pending_node_id: int = UNCONFIGURED
    writable: bool = True
    storable: bool = True
    on_store: Callable[[], None] | None = None
    asked: list[tuple[str, int]] = field(default_factory=list)
    """What the slave had to be done: "configure" or "store" and a node-ID, "left" and the time."""

    def configure_node_id(self, node_id: int) -> bool:
        assert 1 <= node_id <= 127 or node_id == UNCONFIGURED
        if self.writable:
            self.asked.append(("configure", node_id))
            self.pending_node_id = node_id
        return self.writable

    def store_configuration(self) -> bool:
        if not self.storable:
            return False
        self.asked.append(("store", self.pending_node_id))
        if self.on_store is not None:
            self.on_store()
        return True

    def lss_left_configuration(self, now: int) -> None:
        self.asked.append(("left", now))
        if self.active_node_id == UNCONFIGURED:
            self.active_node_id = self.pending_node_id


class Talk(Talker):
    """One slave as the talker of a dialogue."""

    def __init__(self, options: Sequence[str]) -> None:
        super().__init__()
        self.node = Node()
        self.slave = LssSlave(cast(Any, self.node), self._sent)
        for option in options:
            match option.split():
                case ["node-id", active, pending]:
                    self.node.active_node_id, self.node.pending_node_id = int(active), int(pending)
                case ["identity", *parts]:
                    self.node.identity = cast(Identity, tuple(int(part, 16) for part in parts))
                case ["read-only"]:
                    self.node.writable = False
                case ["refuses", "to", "store"]:
                    self.node.storable = False
                case ["stores", "at", "once"]:
                    self.node.on_store = lambda: self.slave.stored(True)
                case _:
                    raise AssertionError(f"what is 'with {option}'?")

    def _sent(self, data: bytes) -> None:
        self.hear(self.now, hexadecimal(data))

    def say(self, what: str) -> str:
        verb, _, rest = what.partition(" ")
        match verb, rest.split():
            case "<-", _:
                self.slave.receive(bytes_of(rest), self.now)
            case "disk", ["done" | "fails" as how]:
                self.slave.stored(how == "done")
            case "reset", []:
                self.slave.reset()
            case "state", _:
                return f"state {'configuration' if self.slave.configuring else 'waiting'}"
            case "node-id", _:
                return f"node-id {self.node.active_node_id} {self.node.pending_node_id}"
            case "stores", _:
                asked = [str(node_id) for verb, node_id in self.node.asked if verb == "store"]
                return " ".join(["stores", *asked])
            case "left", _:
                asked = [ms(time) for verb, time in self.node.asked if verb == "left"]
                return " ".join(["left", *asked])
            case _:
                raise AssertionError(f"what is {what!r}?")
        return what
