"""LSS slaves: dialogues from dialogues/*.txt, several slaves on one bus, and a foreign master (CiA 305)."""

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import canopen
import canopen.lss
import pytest
from script import Dialogue, Heard, bytes_of, hexadecimal, ms, play_lines, read_dialogues

from kontronik_can_gw.cia305.lss import LssSlave

Identity = tuple[int, int, int, int]
ME: Identity = (0x01020304, 0x11121314, 0x00020001, 0xA1B2C3D4)
UNCONFIGURED = 255
FILES = Path(__file__).parent.glob("dialogues/*.txt")


@dataclass
class Node:
    """What LSS needs of a node, with knobs: refuse writes, refuse or delay the saving."""

    identity: Identity = ME
    active_node_id: int = UNCONFIGURED
    pending_node_id: int = UNCONFIGURED
    writable: bool = True
    storable: bool = True
    on_store: Callable[[], None] | None = None
    stores: list[int] = field(default_factory=list)
    left_at: list[int] = field(default_factory=list)

    def configure_node_id(self, node_id: int) -> bool:
        if self.writable:
            self.pending_node_id = node_id
        return self.writable

    def store_configuration(self) -> bool:
        if not self.storable:
            return False
        self.stores.append(self.pending_node_id)
        if self.on_store is not None:
            self.on_store()
        return True

    def lss_left_configuration(self, now: int) -> None:
        self.left_at.append(now)
        if self.active_node_id == UNCONFIGURED:
            self.active_node_id = self.pending_node_id


class Talk(Heard):
    """One slave as the talker of a dialogue."""

    def __init__(self, options: Sequence[str]) -> None:
        super().__init__()
        self.now = 0
        self.node = Node()
        self.slave = LssSlave(self.node, self._sent)
        for option in options:
            match option.split():
                case ["node-id", active, pending]:
                    self.node.active_node_id, self.node.pending_node_id = int(active), int(pending)
                case ["identity", vendor, product, revision, serial]:
                    self.node.identity = int(vendor, 16), int(product, 16), int(revision, 16), int(serial, 16)
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

    def pass_time(self, until: int) -> None:
        self.now = until

    jump = pass_time

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
                return " ".join(["stores", *map(str, self.node.stores)])
            case "left", _:
                return " ".join(["left", *map(ms, self.node.left_at)])
            case _:
                raise AssertionError(f"what is {what!r}?")
        return what


@pytest.mark.parametrize(
    "dialogue", [each for path in sorted(FILES) for each in read_dialogues(path)], ids=lambda dialogue: dialogue.name
)
def test_dialogue(dialogue: Dialogue) -> None:
    play_lines(Talk(dialogue.options), dialogue.lines)


class Bus:
    """Several slaves that hear the same frames."""

    def __init__(self, *nodes: Node) -> None:
        self._answers: list[bytes] = []
        self.slaves = [LssSlave(node, self._answers.append) for node in nodes]

    def send(self, data: bytes) -> list[bytes]:
        """Give a frame to all; return what was answered."""
        self._answers.clear()
        for slave in self.slaves:
            slave.receive(data, 0)
        return list(self._answers)

    @property
    def configuring(self) -> list[bool]:
        return [slave.configuring for slave in self.slaves]


def identities(seed: int, count: int) -> list[Identity]:
    """Random identities, alike in their first parts as those of one maker are."""
    rng = random.Random(seed)
    made: set[Identity] = set()
    while len(made) < count:
        alike = rng.randrange(5)
        numbers = [0x12345678 if part < alike else rng.getrandbits(32) for part in range(4)]
        made.add((numbers[0], numbers[1], numbers[2], numbers[3]))
    return rng.sample(sorted(made), count)


class InProcess:
    """A network for the foreign master without threads: the answers are there when its request has been sent."""

    def __init__(self, bus: Bus, master: Any) -> None:
        self._bus, self._master = bus, master

    def send_message(self, can_id: int, data: bytes) -> None:
        assert can_id == 0x7E5
        for answer in self._bus.send(bytes(data)):
            self._master.on_message_received(0x7E4, bytearray(answer), 0.0)


@pytest.fixture
def no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    """The foreign master pauses 200 ms after each part of an identity, for slow devices."""
    monkeypatch.setattr(canopen.lss, "time", SimpleNamespace(sleep=lambda _: None))


@pytest.mark.usefixtures("no_pauses")
@pytest.mark.parametrize("seed", range(5))
def test_a_foreign_master_finds_each_of_several_slaves_by_fastscan_and_gives_it_a_node_id(seed: int) -> None:
    nodes = [Node(identity=identity) for identity in identities(seed, 6)]
    bus = Bus(*nodes, Node(identity=(0, 0, 0, 0), active_node_id=100, pending_node_id=100))
    master: Any = canopen.lss.LssMaster()
    master.network = InProcess(bus, master)
    master.RESPONSE_TIMEOUT = 0.0002  # what is answered is there before it waits
    for number in range(1, len(nodes) + 1):
        ok, found = master.fast_scan()
        place = next(i for i, node in enumerate(nodes) if node.identity == tuple(found))
        assert ok
        assert [i for i, on in enumerate(bus.configuring) if on] == [place]
        master.configure_node_id(number)
        assert master.inquire_lss_address(canopen.lss.CS_INQUIRE_SERIAL_NUMBER) == found[3]
        master.send_switch_state_global(master.WAITING_STATE)
        assert nodes[place].active_node_id == number
    assert master.fast_scan() == (False, None)


@pytest.mark.usefixtures("no_pauses")
def test_a_foreign_master_configures_and_stores() -> None:
    nodes = [Node(identity=(*ME[:3], serial)) for serial in (1, 2, 3)]
    bus = Bus(*nodes)
    for place, each in enumerate(nodes):
        each.on_store = lambda slave=bus.slaves[place]: slave.stored(True)
    master: Any = canopen.lss.LssMaster()
    master.network = InProcess(bus, master)
    node = nodes[1]
    assert master.send_switch_state_selective(*node.identity)
    assert bus.configuring == [False, True, False]
    assert tuple(map(master.inquire_lss_address, range(0x5A, 0x5E))) == node.identity
    assert master.inquire_node_id() == UNCONFIGURED
    master.configure_node_id(0x2A)
    with pytest.raises(canopen.lss.LssError, match="LSS Error: 1"):
        master.configure_node_id(0)
    with pytest.raises(canopen.lss.LssError, match="LSS Error: 1"):
        master.configure_bit_timing(2)
    master.activate_bit_timing(100)
    master.store_configuration()
    assert node.stores == [0x2A]
    node.storable = False
    with pytest.raises(canopen.lss.LssError, match="LSS Error: 1"):
        master.store_configuration()
    assert [n.pending_node_id for n in nodes] == [UNCONFIGURED, 0x2A, UNCONFIGURED]
