"""A bus full of random frames causes no exception, and memory is bounded.

The ESCs are reported all the time.
"""

import json
import random
import tracemalloc

import pytest
from dronecan_bench import Bench, Reader, dronecan

from kontronik_can_gw.dronecan.wire import MAX_PAYLOAD, MAX_TRANSFERS
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.times import MS

pytestmark = pytest.mark.promise("unstoppable")


def frame(rng: random.Random, node_ids: list[int]) -> CanFrame:
    """Return a random frame. Half of the frames look as if they are for us."""
    can_id = rng.getrandbits(29)
    kind = rng.random()
    if kind < 0.3:  # a request to us
        service = rng.choice([1, 5, 11, rng.randrange(256)])
        can_id = can_id & 0x1F00007F | service << 16 | 0x8080 | rng.choice(node_ids) << 8
    elif kind < 0.4:  # our own ids
        can_id = can_id & ~0x7F | rng.choice(node_ids)
    elif kind < 0.5:  # allocation
        can_id = can_id & 0x1F00007F | 1 << 8
    data = rng.randbytes(rng.choice([0, 1, 2, 7, 8, 8, 8]))
    if data and rng.random() < 0.7:  # a transfer of several frames that may continue
        tail = rng.choice([0x80, 0x20, 0x00, 0x40, 0x60, 0xC0]) | rng.randrange(2)
        data = data[:-1] + bytes((tail,))
    return CanFrame(can_id, data, True)


def storm(count: int, seed: int, node_id: int) -> Bench:
    """Receive this number of random frames behind the filters. Check that memory is bounded."""
    rng = random.Random(seed)
    bench = Bench(2, per_esc_nodes=True, node_id=node_id)
    bench.run(1)
    output = bench.output
    sizes = []
    for at in range(count):
        sent = frame(rng, [42, 43])
        if at % 4:
            output.receive(sent, bench.now, bench.now)
        else:
            bench.gateway.receive_frame(sent, bench.now, bench.now)
        if at % 100 == 0:
            bench.now += 10 * MS
            bench.gateway.advance(bench.now)
            assert len(bench.gateway.take_frames(bench.now)) < 2000
        if at % (count // 10) == 0:
            sizes.append(tracemalloc.get_traced_memory()[0])
    assert sizes[-1] - sizes[2] < 500_000, sizes
    begun = output._assembler._begun
    assert len(begun) <= MAX_TRANSFERS
    assert all(len(each[2]) <= MAX_PAYLOAD + 7 for each in begun.values())
    assert len(bench.gateway.conflicts._present) <= 2
    assert len(json.dumps(output.facts())) < 2000
    return bench


@pytest.mark.parametrize("node_id", [42, 0])
@pytest.mark.parametrize(
    "count",
    [
        20_000,
        pytest.param(10**6, marks=pytest.mark.extended),
    ],
)
def test_hostile_bus_does_no_harm(count: int, node_id: int) -> None:
    """The storm is reported, and after it everything works as before."""
    tracemalloc.start()
    try:
        bench = storm(count, node_id, node_id)
    finally:
        tracemalloc.stop()
    facts = bench.output.facts()
    assert facts["transfer_errors"] > 0
    bench.gateway.conflicts.take()
    bench.clear()
    bench._reader = Reader()
    bench.run(11)
    if node_id:
        assert bench.gateway.status.id_conflicts > 0
        assert facts["requests_unanswered"] > 0
        assert {node["state"] for node in facts["nodes"]} == {"another device has this node-ID"}
        assert len(bench.of("Status")) == 2 * 11 * 50
        assert {node["state"] for node in bench.nodes} == {"operational"}
        assert bench.ask(dronecan.uavcan.protocol.GetNodeInfo.Request()) is not None
    else:
        assert {each.name for each in bench.read} == {"Allocation"}
