"""LSS slaves: dialogues from lss_dialogues/*.txt, several slaves on one bus, and a foreign master (CiA 305)."""

import random
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import canopen
import canopen.lss
import pytest
from lss_bench import ME, UNCONFIGURED, Identity, Node, Talk
from script import Dialogue, play_lines, read_dialogues
from wire import Wire

from kontronik_can_gw.canopen.lss import LssSlave

FILES = Path(__file__).parent.glob("lss_dialogues/*.txt")


@pytest.mark.parametrize(
    "dialogue",
    [each for path in sorted(FILES) for each in read_dialogues(path)],
    ids=lambda dialogue: dialogue.name,
)
def test_dialogue(dialogue: Dialogue) -> None:
    play_lines(Talk(dialogue.options), dialogue.lines)


class Bus:
    """Several slaves that hear the same frames."""

    def __init__(self, *nodes: Node) -> None:
        self._answers: list[bytes] = []
        self.slaves = [LssSlave(cast(Any, node), self._answers.append) for node in nodes]

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


def master_of(bus: Bus) -> Any:
    """A foreign master whose requests the slaves of a bus hear."""

    def exchange(cob_id: int, data: bytes, remote: bool) -> list[tuple[int, bytes]]:
        assert cob_id == 0x7E5 and not remote
        return [(0x7E4, answer) for answer in bus.send(data)]

    master: Any = Wire(exchange).lss
    master.RESPONSE_TIMEOUT = 0.0002  # what is answered is there before it waits
    return master


@pytest.fixture
def no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    """The foreign master pauses 200 ms after each part of an identity, for slow devices."""
    monkeypatch.setattr(canopen.lss, "time", SimpleNamespace(sleep=lambda _: None))


@pytest.mark.usefixtures("no_pauses")
@pytest.mark.parametrize("seed", range(5))
def test_a_foreign_master_finds_each_of_several_slaves_by_fastscan_and_gives_it_a_node_id(
    seed: int,
) -> None:
    nodes = [Node(identity=identity) for identity in identities(seed, 6)]
    bus = Bus(*nodes, Node(identity=(0, 0, 0, 0), active_node_id=100, pending_node_id=100))
    master = master_of(bus)
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
    master = master_of(bus)
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
    assert node.asked == [("configure", 0x2A), ("store", 0x2A)]
    node.storable = False
    with pytest.raises(canopen.lss.LssError, match="LSS Error: 1"):
        master.store_configuration()
    assert [n.pending_node_id for n in nodes] == [UNCONFIGURED, 0x2A, UNCONFIGURED]
