"""Node-IDs from an allocator: one that dies, some that lie, others that ask too. That of the package ``dronecan``: tests/vcan."""

import random
from collections.abc import Callable
from itertools import pairwise

import pytest
from dronecan_bench import Bench, dronecan, peers_frames

from kontronik_can_gw.times import MS, SECOND

Allocation = dronecan.uavcan.protocol.dynamic_node_id.Allocation


def waiting(escs: int = 1) -> Bench:
    return Bench(escs, node_id=0, per_esc_nodes=True)


def said(bench: Bench, node_id: int, unique_id: bytes, source: int = 100, first: int = 0) -> None:
    """What an allocator says; without a source another that asks."""
    message = Allocation(node_id=node_id, first_part_of_unique_id=bool(first))
    message.unique_id.from_bytes(unique_id)
    more = {} if source else {"discriminator": first}
    bench.receive(*peers_frames(message, source, **more))


def unique_ids(bench: Bench) -> list[bytes]:
    return [node.setup.unique_id for node in bench.output._nodes]


def node_ids(bench: Bench) -> list[int | None]:
    return [node["node_id"] for node in bench.nodes]


def test_without_an_allocator_it_asks_for_ever_and_says_nothing_else() -> None:
    bench = waiting(2).run(100)
    assert {(each.name, each.source) for each in bench.read} == {("Allocation", 0)}
    times = [each.at for each in bench.read]
    gaps = {after - before for before, after in pairwise(times)}
    assert 600 * MS <= min(gaps) < max(gaps) <= 1000 * MS
    assert len(gaps) > 50  # random
    first = bench.read[0].payload
    assert first.first_part_of_unique_id
    assert bytes(first.unique_id.to_bytes()) == unique_ids(bench)[0][:6]
    line = f"DroneCAN kontronik_can_gw.e0: waits for a node-ID, {len(times)} requests"
    assert bench.output.facts()["lines"][0] == line
    again = Bench(given=bench.loaded).run(9).frames
    other = waiting(2).run(9).frames
    assert again == bench.frames[: len(again)]  # the seed decides when it asks
    assert other != again


def test_the_parts_go_out_one_after_the_other_and_anew_when_the_allocator_dies() -> None:
    bench = waiting().run(1.1)
    (own,) = unique_ids(bench)
    said(bench, 0, own[:6])
    bench.run(5)  # nobody answers
    firsts = [each.payload.first_part_of_unique_id for each in bench.of("Allocation")]
    assert firsts[:3] == [True, False, True] and all(firsts[2:])
    for known in (6, 12):
        bench.clear()
        said(bench, 0, own[:known])
        asked = bench.now
        (part,) = bench.run(0.41).of("Allocation")
        assert part.at - asked <= 400 * MS
        assert not part.payload.first_part_of_unique_id
        assert bytes(part.payload.unique_id.to_bytes()) == own[known : known + 6]
    for node_id in (0, 126, 127):  # none that a node can have
        said(bench, node_id, own)
        assert node_ids(bench) == [None]
    assert bench.output.facts()["node_ids_refused"] == 3
    said(bench, 77, own)
    assert node_ids(bench) == [77]
    assert bench.output.news == ["DroneCAN node kontronik_can_gw.e0: has node-ID 77"]
    assert [each.source for each in bench.run(0.1).of("NodeStatus")] == [77]
    assert {each.source for each in bench.of("Status")} == {77}
    assert bench.gateway.node_changes == 1


def test_nodes_get_theirs_in_turn_and_none_that_another_of_ours_has() -> None:
    bench = waiting(2).run(1.1)
    first, second = unique_ids(bench)
    for node_id, unique_id, found in (
        (50, second, [None, None]),  # it has not asked yet
        (50, first, [50, None]),
        (50, second, [50, None]),
        (51, second, [50, 51]),
        (52, first, [50, 51]),  # nobody asks any more
    ):
        said(bench, node_id, unique_id)
        assert node_ids(bench) == found


def test_a_lying_allocator_never_gets_more_than_a_node_id() -> None:
    """Unique ids that are ours in parts, too long, of others; the requests go on."""
    rng = random.Random(4)
    bench = waiting().run(1.1)
    (own,) = unique_ids(bench)
    lies: list[Callable[[], bytes]] = [
        lambda: own[: rng.randrange(1, 16)],
        lambda: rng.randbytes(rng.randrange(17)),
        lambda: own[:-1] + bytes((own[-1] ^ 1,)),
        lambda: b"",
    ]
    for _ in range(500):
        said(bench, rng.randrange(1, 126), rng.choice(lies)())
        bench.run(rng.choice([0.01, 0.5, 1.1]))
        assert node_ids(bench) == [None]
    assert bench.of("Allocation")[-1].at > bench.now - 3 * SECOND
    said(bench, 9, own)
    assert node_ids(bench) == [9]


@pytest.mark.parametrize("source", [0, 100])
def test_others_that_ask_go_first(source: int) -> None:
    """A request of another client, and an allocator's word to it, put ours off."""
    bench = waiting()
    for turn in range(20):
        said(bench, 0, b"others", source, first=0 if source else turn + 1)
        bench.run(0.5)
    assert not bench.of("Allocation")
    assert bench.run(1.1).of("Allocation")
