"""Node-IDs from an allocator: that of the package ``dronecan``, one that dies, some that lie, others that ask too."""

import random
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest
from dronecan_bench import Bench, Peer, dronecan, peers_frames

from kontronik_can_gw.esc.telemetry import MS, SECOND
from kontronik_can_gw.frames import CanFrame

Allocation = dronecan.uavcan.protocol.dynamic_node_id.Allocation


def waiting(escs: int = 1, **more: Any) -> Bench:
    return Bench(escs, node_id=0, **more)


def said(node_id: int, unique_id: bytes, first: bool = False) -> object:
    message = Allocation(node_id=node_id, first_part_of_unique_id=first)
    message.unique_id.from_bytes(unique_id)
    return message


def answers(node_id: int, unique_id: bytes, source: int = 100) -> list[CanFrame]:
    return peers_frames(said(node_id, unique_id), source)


def serve(bench: Bench, peer: Peer, seconds: float) -> None:
    for _ in range(round(seconds * 100)):
        bench.run(0.01)
        peer.spin()


def unique_ids(bench: Bench) -> list[bytes]:
    return [node.setup.unique_id for node in bench.output._nodes]


def node_ids(bench: Bench) -> list[int | None]:
    return [node["node_id"] for node in bench.output.facts()["nodes"]]


@pytest.mark.parametrize("escs", [1, 4])
def test_the_foreign_allocator_gives_each_node_its_id(escs: int) -> None:
    bench = waiting(escs, per_esc_nodes=True)
    peer = Peer(bench)
    monitor = dronecan.app.node_monitor.NodeMonitor(peer.node)
    server = dronecan.app.dynamic_node_id.CentralizedServer(peer.node, monitor)
    serve(bench, peer, 4.0 * escs)
    found = node_ids(bench)
    assert len(set(found)) == escs
    assert None not in found
    table = server._allocation_table
    assert [table.get_node_id(each) for each in unique_ids(bench)] == found
    assert {each.payload.esc_index for each in bench.run(1).of("Status")} == set(range(escs))
    news = bench.output.news
    assert [line.split()[-1] for line in news] == [str(node_id) for node_id in found]
    serve(bench, peer, 2)
    seen = {e.node_id: e.status for e in monitor.find_all(lambda e: e.info is not None)}
    assert {(seen[each].health, seen[each].mode) for each in found} == {(0, 0)}


def test_without_an_allocator_it_asks_for_ever_and_says_nothing_else() -> None:
    bench = waiting(2).run(100)
    assert {each.name for each in bench.read} == {"Allocation"}
    assert {each.source for each in bench.read} == {0}
    times = [each.at for each in bench.read]
    gaps = [after - before for before, after in pairwise(times)]
    assert min(gaps) >= 600 * MS
    assert max(gaps) <= 1000 * MS
    assert len(set(gaps)) > 50  # random
    first = bench.read[0].payload
    assert first.first_part_of_unique_id
    assert bytes(first.unique_id.to_bytes()) == unique_ids(bench)[0][:6]
    (line,) = bench.output.facts()["lines"]
    assert line == f"DroneCAN kontronik_can_gw: waits for a node-ID, {len(times)} requests"


def test_the_parts_go_out_one_after_the_other_and_anew_when_the_allocator_dies() -> None:
    bench = waiting().run(1.1)
    (own,) = unique_ids(bench)
    bench.receive(*answers(0, own[:6]))
    bench.run(5)  # nobody answers
    firsts = [each.payload.first_part_of_unique_id for each in bench.of("Allocation")]
    assert firsts[:3] == [True, False, True] and all(firsts[2:])
    for known in (6, 12):
        bench.clear()
        bench.receive(*answers(0, own[:known]))
        asked = bench.now
        bench.run(0.41)
        (part,) = bench.of("Allocation")
        assert part.at - asked <= 400 * MS
        assert not part.payload.first_part_of_unique_id
        assert bytes(part.payload.unique_id.to_bytes()) == own[known : known + 6]
    for node_id in (0, 126, 127):  # none that a node can have
        bench.receive(*answers(node_id, own))
        assert node_ids(bench) == [None]
    assert bench.output.facts()["node_ids_refused"] == 3
    bench.receive(*answers(77, own))
    assert node_ids(bench) == [77]
    assert [each.source for each in bench.run(0.1).of("NodeStatus")] == [77]
    assert bench.gateway.node_changes == 1


def test_a_node_id_that_another_node_of_ours_has_is_refused() -> None:
    bench = waiting(2, per_esc_nodes=True).run(1.1)
    first, second = unique_ids(bench)
    bench.receive(*answers(50, second))  # it has not asked yet
    assert node_ids(bench) == [None, None]
    bench.receive(*answers(50, first))
    bench.receive(*answers(50, second))
    assert node_ids(bench) == [50, None]
    bench.receive(*answers(51, second))
    assert node_ids(bench) == [50, 51]
    bench.receive(*answers(52, first))  # nobody asks any more
    assert node_ids(bench) == [50, 51]


def test_a_lying_allocator_never_gets_more_than_a_node_id() -> None:
    """Unique ids that are ours in parts, too long, of others; the requests go on."""
    rng, bench = random.Random(4), waiting().run(1.1)
    (own,) = unique_ids(bench)
    lies: list[Callable[[], bytes]] = [
        lambda: own[: rng.randrange(1, 16)],
        lambda: rng.randbytes(rng.randrange(17)),
        lambda: own[:-1] + bytes((own[-1] ^ 1,)),
        lambda: b"",
    ]
    for _ in range(500):
        bench.receive(*answers(rng.randrange(1, 126), rng.choice(lies)()))
        bench.run(rng.choice([0.01, 0.5, 1.1]))
        assert node_ids(bench) == [None]
    assert bench.of("Allocation")[-1].at > bench.now - 3 * SECOND
    bench.receive(*answers(9, own))
    assert node_ids(bench) == [9]


def test_others_that_ask_go_first() -> None:
    """A request of another client, and an allocator's word to it, put ours off."""
    bench = waiting()
    for turn in range(20):
        other = said(0, b"others", first=True)
        frames = peers_frames(other, 0, discriminator=turn) if turn % 2 else answers(0, b"others")
        bench.receive(*frames)
        bench.run(0.5)
    assert not bench.of("Allocation")
    assert bench.run(1.1).of("Allocation")


def test_the_seed_decides_when_it_asks() -> None:
    first = waiting().run(9)
    assert Bench(given=first.loaded).run(9).frames == first.frames
    assert waiting().run(9).frames != first.frames
