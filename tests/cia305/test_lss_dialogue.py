"""Each LSS service as a dialogue with exact bytes, several slaves on one bus, and a foreign master (CiA 305)."""

import random
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import can
import canopen
import canopen.lss
import pytest

from kontronik_can_gw.cia305.lss import LssSlave

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


def request(text: str) -> bytes:
    """A frame from hex text, filled up with zeros to 8 bytes."""
    return bytes.fromhex(text).ljust(8, b"\0")


def u32(number: int) -> str:
    return number.to_bytes(4, "little").hex()


class Bus:
    """Several slaves that hear the same frames."""

    def __init__(self, *nodes: Node) -> None:
        self.nodes = nodes
        self.answers: list[tuple[int, bytes]] = []
        self.slaves = [LssSlave(node, self._sender(place)) for place, node in enumerate(nodes)]

    def _sender(self, place: int) -> Callable[[bytes], None]:
        return lambda data: self.answers.append((place, data))

    def send(self, data: bytes, now: int = 0) -> list[tuple[int, bytes]]:
        """Give a frame to all; return who answered what."""
        for slave in self.slaves:
            slave.receive(data, now)
        return self.take()

    def take(self) -> list[tuple[int, bytes]]:
        taken, self.answers = self.answers, []
        return taken

    def select(self, identity: Identity) -> list[tuple[int, bytes]]:
        answers = []
        for service, number in zip((0x40, 0x41, 0x42, 0x43), identity, strict=True):
            answers += self.send(request(f"{service:02x}{u32(number)}"))
        return answers

    @property
    def configuring(self) -> list[bool]:
        return [slave.configuring for slave in self.slaves]


def dialogue(bus: Bus, *lines: tuple[str, str]) -> None:
    """Send each left hex text (filled with zeros), expect the right one ('': silence) from the only node there is."""
    for sent, answer in lines:
        expected = [(0, request(answer))] if answer else []
        assert bus.send(request(sent)) == expected, sent


SELECT_ME = (("40 04030201", ""), ("41 14131211", ""), ("42 01000200", ""), ("43 d4c3b2a1", "44"))
IDENTIFY_ME = (
    ("46 04030201", ""),
    ("47 14131211", ""),
    ("48 01000200", ""),
    ("49 01000200", ""),
    ("4a d4c3b2a1", ""),
    ("4b d4c3b2a1", "4f"),
)


# --- switch state


def test_switch_state_global_is_not_answered_and_switches_there_and_back() -> None:
    node = Node(active_node_id=5, pending_node_id=5)
    bus = Bus(node)
    dialogue(bus, ("04 01", ""))
    assert bus.configuring == [True]
    dialogue(bus, ("04 01", ""), ("04 02", ""), ("04 ff", ""))
    assert bus.configuring == [True]
    assert bus.send(request("04 00"), now=77) == []
    assert bus.configuring == [False]
    assert node.left_at == [77]


def test_switch_to_waiting_tells_the_host_only_if_the_slave_was_in_configuration_state() -> None:
    node = Node()
    dialogue(Bus(node), ("04 00", ""), ("04 02", ""))
    assert node.left_at == []


def test_switch_state_selective_is_answered_by_the_one_that_fits() -> None:
    bus = Bus(Node())
    dialogue(bus, *SELECT_ME)
    assert bus.configuring == [True]


@pytest.mark.parametrize("wrong", range(4))
def test_a_selection_with_one_part_wrong_does_not_match(wrong: int) -> None:
    bus = Bus(Node())
    identity = tuple(number ^ (0x80000000 if part == wrong else 0) for part, number in enumerate(ME))
    assert bus.select((identity[0], identity[1], identity[2], identity[3])) == []
    assert bus.configuring == [False]


@pytest.mark.parametrize(
    "order",
    [
        (1, 0, 2, 3),
        (0, 2, 1, 3),
        (0, 1, 3, 2),
        (3, 2, 1, 0),
        (0, 1, 3),
        (1, 2, 3),
        (3,),
        (0, 1, 1, 2, 3),
        (0, 1, 2, 0, 3),
    ],
)
def test_a_selection_out_of_order_does_not_match(order: tuple[int, ...]) -> None:
    bus = Bus(Node())
    dialogue(bus, *((SELECT_ME[part][0], "") for part in order))
    assert bus.configuring == [False]


def test_a_selection_begun_anew_matches() -> None:
    dialogue(Bus(Node()), SELECT_ME[0], SELECT_ME[1], *SELECT_ME)


@pytest.mark.parametrize("between", ["04 00", "4c", "5e", "46 04030201", "51 00000000 1f 00 00", "00", "15", "44"])
def test_another_frame_within_a_selection_breaks_it(between: str) -> None:
    bus = Bus(Node(active_node_id=5, pending_node_id=5))
    dialogue(bus, *SELECT_ME[:3], (between, ""), (SELECT_ME[3][0], ""))
    assert bus.configuring == [False]


def test_frames_of_other_lengths_are_as_if_they_were_not_there() -> None:
    bus = Bus(Node())
    dialogue(bus, *SELECT_ME[:3])
    for data in (b"", b"\x04", b"\x04\x01", request("04 01")[:7], request("04 01") + b"\0"):
        assert bus.send(data) == []
    dialogue(bus, SELECT_ME[3])


def test_a_selected_slave_ignores_selections_but_a_switch_to_waiting() -> None:
    bus = Bus(Node())
    dialogue(bus, *SELECT_ME)
    dialogue(bus, *((sent, "") for sent, _ in SELECT_ME))
    assert bus.select((9, 9, 9, 9)) == []
    assert bus.configuring == [True]
    dialogue(bus, ("04 00", ""), *SELECT_ME)


def test_reset_goes_to_waiting_and_forgets_a_partial_selection_without_telling_the_host() -> None:
    node = Node()
    bus = Bus(node)
    dialogue(bus, *SELECT_ME[:3])
    bus.slaves[0].reset()
    dialogue(bus, (SELECT_ME[3][0], ""), *SELECT_ME)
    bus.slaves[0].reset()
    assert bus.configuring == [False]
    assert node.left_at == []


# --- configuration


@pytest.mark.parametrize("sent", ["11 05", "13 00 02", "15 e8 03", "17", "5a", "5b", "5c", "5d", "5e"])
def test_what_belongs_to_the_configuration_state_is_ignored_in_waiting(sent: str) -> None:
    node = Node()
    dialogue(Bus(node), (sent, ""))
    assert (node.pending_node_id, node.stores) == (UNCONFIGURED, [])


@pytest.mark.parametrize("node_id", [1, 2, 64, 127, 255])
def test_a_node_id_in_range_is_taken(node_id: int) -> None:
    node = Node(active_node_id=9, pending_node_id=9)
    dialogue(Bus(node), ("04 01", ""), (f"11 {node_id:02x}", "11 00 00"))
    assert (node.pending_node_id, node.active_node_id) == (node_id, 9)


@pytest.mark.parametrize("node_id", [0, 128, 129, 200, 254])
def test_a_node_id_out_of_range_is_refused(node_id: int) -> None:
    node = Node(active_node_id=9, pending_node_id=9)
    dialogue(Bus(node), ("04 01", ""), (f"11 {node_id:02x}", "11 01 00"))
    assert node.pending_node_id == 9


def test_a_node_id_is_refused_with_the_specific_error_while_bus_writes_are_off() -> None:
    dialogue(Bus(Node(writable=False)), ("04 01", ""), ("11 05", "11 ff 01"), ("11 00", "11 01 00"))


@pytest.mark.parametrize("sent", ["13 00 00", "13 00 02", "13 00 09", "13 01 00", "13 ff ff"])
def test_no_bit_timing_is_supported(sent: str) -> None:
    dialogue(Bus(Node()), ("04 01", ""), (sent, "13 01 00"), ("15 e8 03", ""))


def test_store_is_answered_when_the_result_is_there() -> None:
    node = Node(pending_node_id=7)
    bus = Bus(node)
    dialogue(bus, ("04 01", ""), ("17", ""))
    assert node.stores == [7]
    bus.slaves[0].stored(True)
    assert bus.take() == [(0, request("17 00 00"))]
    dialogue(bus, ("17", ""))
    bus.slaves[0].stored(False)
    assert bus.take() == [(0, request("17 02 00"))]
    bus.slaves[0].stored(True)
    assert bus.take() == []


def test_store_is_answered_when_the_result_is_known_at_once() -> None:
    node = Node()
    bus = Bus(node)
    node.on_store = lambda: bus.slaves[0].stored(True)
    dialogue(bus, ("04 01", ""), ("17", "17 00 00"))


def test_a_refused_store_is_not_supported() -> None:
    bus = Bus(Node(storable=False))
    dialogue(bus, ("04 01", ""), ("17", "17 01 00"))
    bus.slaves[0].stored(True)
    assert bus.take() == []


@pytest.mark.parametrize("leave", ["switch", "reset"])
def test_the_result_of_a_saving_is_not_told_after_the_configuration_state_was_left(leave: str) -> None:
    """Nor is it taken for the result of the next one."""
    bus = Bus(Node())
    dialogue(bus, ("04 01", ""), ("17", ""))
    if leave == "switch":
        dialogue(bus, ("04 00", ""))
    else:
        bus.slaves[0].reset()
    dialogue(bus, ("04 01", ""), ("17", ""))
    bus.slaves[0].stored(True)
    assert bus.take() == []
    bus.slaves[0].stored(False)
    assert bus.take() == [(0, request("17 02 00"))]


# --- inquiry and identification


def test_inquiries_tell_the_identity_and_the_active_node_id() -> None:
    dialogue(
        Bus(Node(active_node_id=3, pending_node_id=4)),
        *SELECT_ME,
        ("5a", "5a 04030201"),
        ("5b", "5b 14131211"),
        ("5c", "5c 01000200"),
        ("5d", "5d d4c3b2a1"),
        ("5e", "5e 03"),
    )


def test_an_unconfigured_node_tells_node_id_ffh_until_it_boots() -> None:
    bus = Bus(Node())
    dialogue(bus, *SELECT_ME, ("5e", "5e ff"), ("11 07", "11"), ("5e", "5e ff"), ("04 00", ""))
    dialogue(bus, *SELECT_ME, ("5e", "5e 07"))


@pytest.mark.parametrize("state", ["waiting", "configuration"])
def test_identify_is_answered_in_both_states_and_changes_none(state: str) -> None:
    bus = Bus(Node(active_node_id=3, pending_node_id=3))
    dialogue(bus, ("04 01" if state == "configuration" else "04 00", ""), *IDENTIFY_ME, *IDENTIFY_ME)
    assert bus.configuring == [state == "configuration"]


@pytest.mark.parametrize(
    ("revisions", "serials", "fits"),
    [
        ((0, 0xFFFFFFFF), (0, 0xFFFFFFFF), True),
        ((ME[2], ME[2]), (ME[3], ME[3]), True),
        ((ME[2] + 1, 0xFFFFFFFF), (0, 0xFFFFFFFF), False),
        ((0, ME[2] - 1), (0, 0xFFFFFFFF), False),
        ((0, 0xFFFFFFFF), (ME[3] + 1, 0xFFFFFFFF), False),
        ((0, 0xFFFFFFFF), (0, ME[3] - 1), False),
        ((0xFFFFFFFF, 0), (0xFFFFFFFF, 0), False),
    ],
)
def test_identify_takes_the_ranges_with_their_ends(
    revisions: tuple[int, int], serials: tuple[int, int], fits: bool
) -> None:
    numbers = (ME[0], ME[1], *revisions, *serials)
    lines = [(f"{0x46 + step:02x} {u32(number)}", "") for step, number in enumerate(numbers)]
    lines[-1] = (lines[-1][0], "4f" if fits else "")
    dialogue(Bus(Node()), *lines)


@pytest.mark.parametrize("missing", range(6))
def test_an_identification_with_a_gap_is_not_answered(missing: int) -> None:
    lines = [(sent, "") for step, (sent, _) in enumerate(IDENTIFY_ME) if step != missing]
    dialogue(Bus(Node()), *lines)


def test_a_selection_and_an_identification_do_not_mix() -> None:
    bus = Bus(Node())
    dialogue(bus, *SELECT_ME[:2], *((sent, "") for sent, _ in IDENTIFY_ME[2:]))
    dialogue(bus, *IDENTIFY_ME[:2], *((sent, "") for sent, _ in SELECT_ME[2:]))
    assert bus.configuring == [False]


@pytest.mark.parametrize(
    ("active", "pending", "answer"), [(255, 255, "50"), (255, 7, ""), (7, 7, ""), (7, 255, ""), (1, 127, "")]
)
def test_only_a_node_without_any_node_id_is_non_configured(active: int, pending: int, answer: str) -> None:
    node = Node(active_node_id=active, pending_node_id=pending)
    dialogue(Bus(node), ("4c", answer))
    scan = "4f" if answer else ""
    dialogue(Bus(node), ("51 00000000 80 00 00", scan), ("51 00000000 1f 00 00", scan))


# --- fastscan


def test_a_fastscan_frame_by_frame() -> None:
    bus = Bus(Node(identity=(0x80000001, 2, 3, 4)))
    dialogue(
        bus,
        ("51 00000000 80 00 00", "4f"),
        ("51 00000000 1f 00 00", ""),  # bit 31 is not 0
        ("51 00000080 1f 00 00", "4f"),
        ("51 00000080 01 00 00", "4f"),
        ("51 00000080 00 00 00", ""),  # bit 0 is not 0
        ("51 01000080 00 00 01", "4f"),  # the vendor-ID is complete
        ("51 01000080 00 00 01", ""),  # and no longer looked at
        ("51 02000000 00 01 02", "4f"),
        ("51 03000000 00 02 03", "4f"),
        ("51 05000000 00 03 00", ""),
    )
    assert bus.configuring == [False]
    dialogue(bus, ("51 04000000 00 03 00", "4f"))
    assert bus.configuring == [True]
    dialogue(bus, ("51 00000000 80 00 00", ""), ("5d", "5d 04000000"))


@pytest.mark.parametrize("frame", ["51 00000000 1f 00 00", "51 04030201 00 00 01"])
def test_a_fastscan_begins_with_its_reset(frame: str) -> None:
    dialogue(Bus(Node()), (frame, ""))


@pytest.mark.parametrize(
    "frame",
    [
        "51 04030201 20 00 00",
        "51 04030201 7f 00 00",
        "51 04030201 81 00 00",
        "51 04030201 ff 00 00",
        "51 04030201 00 01 01",
        "51 04030201 00 04 00",
        "51 04030201 00 00 04",
        "51 04030201 80 04 00",
        "51 04030201 80 00 ff",
    ],
)
def test_fastscan_frames_out_of_range_or_for_another_part_are_ignored(frame: str) -> None:
    dialogue(Bus(Node()), ("51 00000000 80 00 00", "4f"), (frame, ""), ("51 04030201 00 00 01", "4f"))


def test_a_fastscan_is_forgotten_by_a_reset_and_by_a_switch() -> None:
    bus = Bus(Node())
    start, step = ("51 00000000 80 00 00", "4f"), "51 04030201 00 00 01"
    dialogue(bus, start)
    bus.slaves[0].reset()
    dialogue(bus, (step, ""), start, ("04 01", ""), ("04 00", ""), (step, ""), start, (step, "4f"))


def test_a_fastscan_may_skip_parts() -> None:
    """A master that knows product code and revision goes from the vendor-ID to the serial number."""
    bus = Bus(Node())
    dialogue(bus, ("51 00000000 80 00 00", "4f"), ("51 04030201 00 00 03", "4f"), (f"51 {u32(ME[3])} 00 03 00", "4f"))
    assert bus.configuring == [True]


def test_a_fastscan_ends_only_with_every_bit_checked() -> None:
    bus = Bus(Node())
    dialogue(bus, ("51 00000000 80 00 00", "4f"), ("51 04030201 00 00 03", "4f"))
    dialogue(bus, (f"51 {u32(ME[3])} 01 03 00", "4f"))
    assert bus.configuring == [False]


class FastscanMaster:
    """Finds one unconfigured slave by asking bit by bit, from the highest down: the lowest identity answers longest."""

    def __init__(self, ask: Callable[[bytes], bool]) -> None:
        self._ask = ask

    def _step(self, number: int, bit: int, part: int, following: int) -> bool:
        return self._ask(request(f"51 {u32(number)} {bit:02x} {part:02x} {following:02x}"))

    def find(self) -> Identity | None:
        if not self._step(0, 0x80, 0, 0):
            return None
        found = []
        for part in range(4):
            low, high = 0, 0xFFFFFFFF
            for bit in range(31, -1, -1):
                middle = low + (1 << bit)
                if self._step(low, bit, part, part):
                    high = middle - 1
                else:
                    low = middle
            assert low == high
            assert self._step(low, 0, part, (part + 1) % 4)
            found.append(low)
        return found[0], found[1], found[2], found[3]


def identities(seed: int, count: int) -> list[Identity]:
    """Random identities, alike in their first parts as those of one maker are."""
    rng = random.Random(seed)
    made: set[Identity] = set()
    while len(made) < count:
        alike = rng.randrange(5)
        numbers = [0x12345678 if part < alike else rng.getrandbits(32) for part in range(4)]
        made.add((numbers[0], numbers[1], numbers[2], numbers[3]))
    return rng.sample(sorted(made), count)


@pytest.mark.parametrize("seed", range(12))
def test_fastscan_finds_each_of_several_slaves_and_gives_it_a_node_id(seed: int) -> None:
    nodes = [Node(identity=identity) for identity in identities(seed, 8)]
    configured = [Node(identity=(0, 0, 0, 0), active_node_id=100, pending_node_id=100)]
    bus = Bus(*nodes, *configured)
    master = FastscanMaster(lambda frame: bool(bus.send(frame)))
    for number in range(1, len(nodes) + 1):
        found = master.find()
        place = next(i for i, node in enumerate(nodes) if node.identity == found)
        assert [i for i, on in enumerate(bus.configuring) if on] == [place]
        assert bus.send(request(f"11 {number:02x}")) == [(place, request("11"))]
        assert bus.send(request("5d")) == [(place, request(f"5d {u32(nodes[place].identity[3])}"))]
        assert bus.send(request("04 00")) == []
        assert nodes[place].active_node_id == number
    assert master.find() is None
    assert sorted(node.active_node_id for node in nodes) == list(range(1, 9))


# --- several slaves


def test_among_several_only_the_selected_answers() -> None:
    nodes = [
        Node(identity=(ME[0], ME[1], ME[2], ME[3] + i), active_node_id=i + 1, pending_node_id=i + 1) for i in range(4)
    ]
    bus = Bus(*nodes)
    for place, node in enumerate(nodes):
        bus.send(request("04 00"))
        assert bus.select(node.identity) == [(place, request("44"))]
        for sent in ("11 20", "13 00 00", "5a", "5b", "5c", "5d", "5e"):
            assert [who for who, _ in bus.send(request(sent))] == [place]
        assert bus.send(request("17")) == []
        bus.slaves[place].stored(True)
        assert bus.take() == [(place, request("17"))]
    assert [node.pending_node_id for node in nodes] == [0x20] * 4


# --- the master of the canopen package


class InProcess:
    """A network for the foreign master without threads: the answers are there when its request has been sent."""

    def __init__(self, bus: Bus, master: Any) -> None:
        self._bus, self._master = bus, master

    def send_message(self, can_id: int, data: bytes) -> None:
        assert can_id == 0x7E5
        for _, answer in self._bus.send(bytes(data)):
            self._master.on_message_received(0x7E4, bytearray(answer), 0.0)


@pytest.fixture
def no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    """The foreign master pauses 200 ms after each part of an identity, for slow devices."""
    monkeypatch.setattr(canopen.lss, "time", SimpleNamespace(sleep=lambda _: None))


@pytest.mark.usefixtures("no_pauses")
def test_a_foreign_master_finds_all_slaves_by_fastscan() -> None:
    nodes = [Node(identity=identity) for identity in identities(99, 4)]
    bus = Bus(*nodes)
    master: Any = canopen.lss.LssMaster()
    master.network = InProcess(bus, master)
    master.RESPONSE_TIMEOUT = 0.0005
    for number in range(1, 5):
        ok, found = master.fast_scan()
        assert ok
        node = next(node for node in nodes if node.identity == tuple(found))
        master.configure_node_id(number)
        master.send_switch_state_global(master.WAITING_STATE)
        assert node.active_node_id == number
    assert master.fast_scan() == (False, None)


@pytest.fixture
def bridge(request: pytest.FixtureRequest, no_pauses: None) -> Iterator[tuple[Any, Bus]]:
    """The foreign master and our slaves at the two ends of a virtual bus of python-can."""
    nodes = [Node(identity=(*ME[:3], serial)) for serial in (1, 2, 3)]
    lss = Bus(*nodes)
    for place, node in enumerate(nodes):
        node.on_store = lambda slave=lss.slaves[place]: slave.stored(True)
    channel = f"lss-{request.node.name}-{threading.get_ident()}"
    ours = can.Bus(interface="virtual", channel=channel)
    network = canopen.Network(can.Bus(interface="virtual", channel=channel))

    def serve(message: can.Message) -> None:
        if message.arbitration_id == 0x7E5:
            for _, answer in lss.send(bytes(message.data)):
                ours.send(can.Message(arbitration_id=0x7E4, data=answer, is_extended_id=False))

    notifier = can.Notifier(ours, [serve], timeout=0.05)
    network.connect()
    network.lss.RESPONSE_TIMEOUT = 10
    yield network.lss, lss
    network.disconnect()
    notifier.stop()
    ours.shutdown()


def test_a_foreign_master_configures_and_stores_over_a_virtual_bus(bridge: tuple[Any, Bus]) -> None:
    master, lss = bridge
    node = lss.nodes[1]
    assert master.send_switch_state_selective(*node.identity)
    assert lss.configuring == [False, True, False]
    inquired = [
        master.inquire_lss_address(service)
        for service in (
            canopen.lss.CS_INQUIRE_VENDOR_ID,
            canopen.lss.CS_INQUIRE_PRODUCT_CODE,
            canopen.lss.CS_INQUIRE_REVISION_NUMBER,
            canopen.lss.CS_INQUIRE_SERIAL_NUMBER,
        )
    ]
    assert tuple(inquired) == node.identity
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
    assert [n.pending_node_id for n in lss.nodes] == [UNCONFIGURED, 0x2A, UNCONFIGURED]
