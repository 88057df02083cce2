"""Rules of a node that dialogues cannot test well.

They concern every value of a range, long traffic, the DBC messages, and the data on disk.
"""

import hashlib
import itertools
from pathlib import Path

import pytest
from dialogue import NO_HEARTBEAT, OFF, QUIET, SPARE, Bench, default, live, shipped_eds, tpdo
from script import MS

from kontronik_can_gw.assembly.assemble import Loaded, assemble
from kontronik_can_gw.canopen.bound_values import message_plan
from kontronik_can_gw.canopen.node import Node
from kontronik_can_gw.canopen.setup import CanopenSetup
from kontronik_can_gw.canopen.storage import Stored, encode
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.runtime.system.machine import machine_identity, serial_number
from kontronik_can_gw.signals.plan import MessageLayout

pytestmark = pytest.mark.promise("cia-301")

VALUE = 0x06090030
TAKEN = 0x06040043


@pytest.mark.promise("conflicts")
def test_id_conflict_is_reported_once_and_cleared_when_it_ends() -> None:
    bench = Bench(changes=QUIET)
    bench.take()
    for n in range(300):
        bench.wait(20)
        bench.put((0x701, 0x081, 0x581)[n % 3], bytes(8))
    assert [frame.data[:4] for frame in bench.take()] == [b"\x50\x81\x11\xff"]
    assert bench.gateway.status.id_conflicts == 300
    begun = bench.gateway.conflicts.take()
    assert [(c.key, c.is_over) for c in begun] == [(0x701, False), (0x081, False), (0x581, False)]
    assert begun[0].whose == "the heartbeat of CANopen node 1"
    bench.wait(12_000)
    assert [frame.data for frame in bench.take()] == [bytes((0, 0, 0, 0xFF, 0, 0, 0, 0))]
    assert [(c.key, c.count, c.is_over) for c in bench.gateway.conflicts.take()] == [
        (can_id, 100, True) for can_id in (0x701, 0x081, 0x581)
    ]


@pytest.mark.promise("one-frame-one-time")
def test_all_pdos_caused_by_a_uart_frame_carry_its_values() -> None:
    numbers = range(1, 5)
    speed_only = (254, 0, 0, 0x20000120)
    changes = dict(QUIET)
    for number in numbers:
        changes |= tpdo(number, *speed_only)
    bench = Bench(changes=changes).start()
    bench.now = 10 * MS
    one_read = [live(electrical_speed=speed) for speed in range(1, 21)]
    bench.uart(b"".join(one_read))  # only the newest of one read is sent
    speeds = range(20, 200)
    for speed in speeds[1:]:
        bench.now += 10 * MS
        bench.uart(live(electrical_speed=speed))
    sent = [(frame.can_id, int.from_bytes(frame.data, "little")) for frame in bench.take()]
    assert sent == [(0x81 + 0x100 * number, speed) for speed in speeds for number in numbers]


@pytest.mark.parametrize(
    ("threshold", "link_status"),
    [
        (3, 3),
        (4, 2),
    ],
)
def test_2100h_8_sets_the_crc_errors_a_second_of_a_degraded_link(
    threshold: int,
    link_status: int,
) -> None:
    bench = Bench(changes=QUIET)
    assert bench.write(0x2100, 8, threshold, size=2) is None
    damaged = live()[:-1] + b"\xff"
    for number in range(150):
        bench.wait(10)
        data = live()
        if number in (20, 40, 60):
            data += damaged
        bench.uart(data)
    assert bench.number(0x2020, 1) == link_status


def test_restricted_cob_id_is_refused_and_every_other_is_accepted() -> None:
    bench = Bench(changes={**QUIET, **SPARE})
    ends = (0, 0x80), (0x101, 0x181), (0x581, 0x600), (0x601, 0x680), (0x6E0, 0x700), (0x701, 0x800)
    reserved = {cob_id for pair in ends for cob_id in range(*pair)}
    ours = {0x80, 0x81}
    for cob_id in range(0x800):
        wanted = None
        if cob_id in ours:
            wanted = TAKEN
        if cob_id in reserved:
            wanted = VALUE
        assert bench.write(0x1804, 1, 0x40000000 | cob_id) == wanted, hex(cob_id)
        bench.write(0x1804, 1, OFF)


def test_ids_of_pdos_of_all_nodes_and_of_the_dbc_cannot_be_used() -> None:
    ours = {0x705: 5, 0x606: 6, 0x587: 7, 0x88: 8, 0x18A: 10}
    layout = MessageLayout("", "", tuple(message_plan(f"M{i}", i, ()) for i in (0x222, *ours)))
    bench = Bench(2, changes={**NO_HEARTBEAT, **SPARE}, layout=layout)
    for cob_id in (0x181, 0x381, 0x182, 0x482, 0x81, 0x82, 0x80, 0x222):
        assert bench.write(0x1804, 1, 0x40000000 | cob_id) == TAKEN, hex(cob_id)
    assert bench.write(0x1804, 1, 0x40000223) is None
    assert bench.write(0x1804, 1, 0x40000223, node=2) == TAKEN
    assert bench.write(0x1800, 1, 0xC0000181) is None
    assert bench.write(0x1804, 1, 0x40000181, node=2) is None  # it is free now
    for node_id in ours.values():
        assert bench.write(0x2101, 2, node_id, size=1) == TAKEN
    assert bench.write(0x2101, 2, 9, size=1) is None


@pytest.mark.promise("pdo")
def test_each_mappable_object_can_be_sent_and_equals_its_sdo_value() -> None:
    bench = Bench(changes={**QUIET, **default(0x2100, 5, 2)})
    fields = {"electrical_speed": 66051, "battery_voltage": 2442, "bec_current": 5}
    bench.uart(live(**fields, operating_state=26, throttle=-5))
    bench.start()
    tried = 0
    for entry in shipped_eds().entries:
        if not entry.is_mappable:
            continue
        data = bench.read(entry.index, entry.sub)
        assert isinstance(data, bytes)
        assert bench.write(0x1800, 1, 0xC0000181) is None
        assert bench.write(0x1A00, 0, b"\0") is None
        assert bench.write(0x1A00, 1, entry.index << 16 | entry.sub << 8 | 8 * len(data)) is None
        assert bench.write(0x1A00, 0, b"\1") is None
        assert bench.write(0x1800, 1, 0x40000181) is None
        (frame,) = bench.take()
        assert (frame.can_id, frame.data) == (0x181, data), f"{entry.index:04X}:{entry.sub:02X}"
        tried += 1
    assert tried > 40


def test_serial_numbers_differ_by_number_name_and_machine(tmp_path: Path) -> None:
    whose = itertools.product((1, 2), ("left", "right"), (b"a", b"b"))
    assert len({serial_number(*each) for each in whose}) == 8
    digest = hashlib.sha256(b"akontronik-can-gw 1 left").digest()
    assert serial_number(1, "left", b"a") == int.from_bytes(digest[:4], "big")  # as in 0.5.0
    assert serial_number(1, "left", b"") == 0
    assert machine_identity(tmp_path) == b""
    (tmp_path / "etc").mkdir()
    (tmp_path / "etc" / "machine-id").write_text("0123\n")
    assert machine_identity(tmp_path) == b"0123\0"


def loaded_nodes(tmp_path: Path) -> tuple[Loaded, list[Node]]:
    """Return a configuration of two ESCs, and its nodes in their initial state."""
    canopen = {"enabled": True, "store": str(tmp_path)}
    tables = {"canopen": canopen, "esc": [{"port": "p1"}, {"port": "p2"}]}
    loaded = assemble(parse(tables, "test"))
    (setup,) = loaded.outputs
    assert isinstance(setup, CanopenSetup)
    message_ids = {message.can_id: message.name for message in loaded.layout.messages}
    return loaded, setup.nodes(loaded.escs, message_ids).nodes


def keep(tmp_path: Path, **stored: Stored) -> None:
    for name, what in stored.items():
        (tmp_path / f"{name}.params").write_bytes(encode(what))


def u32(value: int) -> bytes:
    return value.to_bytes(4, "little")


SPARE_ON = {0x180501: u32(0x40000680)}
MAPPED = {0x1A0500: b"\1", 0x1A0501: u32(0x20000220)}
EVENT_TIMERS = {(0x1800 + n) << 8 | 5: b"\1\0" for n in range(4)}


@pytest.mark.promise("parameters")
@pytest.mark.parametrize(
    "stored",
    [
        {"esc1": Stored(2)},
        {"esc1": Stored(7), "esc2": Stored(7)},
        {"esc1": Stored(None, {0x180501: u32(0x40000087)}), "esc2": Stored(7)},
        {"esc1": Stored(None, {0x100500: u32(0x90), 0x180501: u32(0x40000080)})},
        {"esc1": Stored(None, {0x100500: u32(0x87)}), "esc2": Stored(7)},
        {"esc1": Stored(None, {0x101400: u32(0x82)})},
        {"esc1": Stored(None, SPARE_ON | MAPPED)},
        {"esc1": Stored(None, EVENT_TIMERS | {0x101700: b"\1\0"})},
    ],
)
def test_no_stored_value_prevents_the_gateway_from_starting(
    tmp_path: Path,
    stored: dict[str, Stored],
) -> None:
    keep(tmp_path, **stored)
    loaded, nodes = loaded_nodes(tmp_path)
    ids = {message.can_id: message.name for message in loaded.layout.messages}
    for node in nodes:
        for cob_id, what, *_ in node.uses():
            assert ids.setdefault(cob_id, what) == what
    # It is reported at the start, or by the node when it boots.
    assert loaded.warnings or any(node.parameters.rejected for node in nodes)


@pytest.mark.parametrize(
    "clashing",
    [
        Stored(2),
        Stored(values={0x101400: u32(0x82)}),
    ],
)
def test_1020h_is_cleared_if_a_value_stored_with_it_is_rejected(
    tmp_path: Path,
    clashing: Stored,
) -> None:
    verify = {0x102001: u32(15685), 0x102002: u32(43_200_000), 0x101700: b"\xf4\x01"}
    for stored, expected in ((Stored(7), 15685), (clashing, 0)):
        keep(tmp_path, esc1=Stored(stored.node_id, {**stored.values, **verify}))
        _, nodes = loaded_nodes(tmp_path)
        number = nodes[0].dictionary.number
        assert number(0x1020, 1) == expected
        assert number(0x1017) == 500


def test_swapped_node_ids_are_kept(tmp_path: Path) -> None:
    keep(tmp_path, esc1=Stored(2), esc2=Stored(1))
    loaded, nodes = loaded_nodes(tmp_path)
    assert [node.node_id for node in nodes] == [2, 1]
    assert loaded.warnings == ()


def test_stored_node_id_is_rejected_if_another_node_is_set_to_it(tmp_path: Path) -> None:
    moved = {0x180001: u32(0x40000300)}
    keep(tmp_path, esc1=Stored(2), esc2=Stored(None, moved))
    loaded, nodes = loaded_nodes(tmp_path)
    assert [node.node_id for node in nodes] == [1, 2]
    assert nodes[1].dictionary.number(0x1800, 1) == 0x40000300
    (said,) = loaded.warnings
    assert said.startswith("esc1: the stored node-ID")
