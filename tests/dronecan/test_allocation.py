"""Node-IDs from allocation servers that die or lie, and other nodes that request an id as well.

The allocation server of the package ``dronecan`` is tested in tests/vcan.
"""

import random
from collections.abc import Callable
from itertools import pairwise

import pytest
from dronecan_bench import Bench, dronecan, peers_frames

from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("allocation")

Allocation = dronecan.uavcan.protocol.dynamic_node_id.Allocation


def waiting(escs: int = 1) -> Bench:
    return Bench(escs, node_id=0, per_esc_nodes=True)


def receive_allocation(
    bench: Bench,
    node_id: int,
    unique_id: bytes,
    source: int = 100,
    first: int = 0,
) -> None:
    """Receive a message of an allocation server, or of another client if ``source`` is 0."""
    message = Allocation(node_id=node_id, first_part_of_unique_id=bool(first))
    message.unique_id.from_bytes(unique_id)
    more = {} if source else {"discriminator": first}
    bench.receive(*peers_frames(message, source, **more))


def unique_ids(bench: Bench) -> list[bytes]:
    return [node.setup.unique_id for node in bench.output._nodes]


def node_ids(bench: Bench) -> list[int | None]:
    return [node["node_id"] for node in bench.nodes]


def test_without_an_allocator_a_node_only_repeats_its_request() -> None:
    bench = waiting(2).run(100)
    assert {(each.name, each.source) for each in bench.read} == {("Allocation", 0)}
    times = [each.at for each in bench.read]
    gaps = {after - before for before, after in pairwise(times)}
    assert 600 * MS <= min(gaps) < max(gaps) <= 1000 * MS
    assert len(gaps) > 50  # the gaps are random
    first = bench.read[0].payload
    assert first.first_part_of_unique_id
    assert bytes(first.unique_id.to_bytes()) == unique_ids(bench)[0][:6]
    line = f"DroneCAN kontronik_can_gw.e0: waits for a node-ID, {len(times)} requests"
    assert bench.output.facts()["lines"][0] == line
    again = Bench(given=bench.loaded).run(9).frames
    other = waiting(2).run(9).frames
    assert again == bench.frames[: len(again)]  # the seed decides when it asks
    assert other != again


def test_parts_of_an_id_are_sent_in_turn_and_repeated_without_answer() -> None:
    bench = waiting().run(1.1)
    (own,) = unique_ids(bench)
    receive_allocation(bench, 0, own[:6])
    bench.run(5)  # the allocation server does not answer
    firsts = [each.payload.first_part_of_unique_id for each in bench.of("Allocation")]
    assert firsts[:3] == [True, False, True]
    assert all(firsts[2:])
    for known in (6, 12):
        bench.clear()
        receive_allocation(bench, 0, own[:known])
        asked = bench.now
        (part,) = bench.run(0.41).of("Allocation")
        assert part.at - asked <= 400 * MS
        assert not part.payload.first_part_of_unique_id
        assert bytes(part.payload.unique_id.to_bytes()) == own[known : known + 6]
    for node_id in (0, 126, 127):  # no node can have one of these ids
        receive_allocation(bench, node_id, own)
        assert node_ids(bench) == [None]
    assert bench.output.facts()["node_ids_refused"] == 3
    revision = bench.gateway.revision
    receive_allocation(bench, 77, own)
    assert node_ids(bench) == [77]
    told = [line.text for line in bench.output.take_news()]
    assert told == ["DroneCAN node kontronik_can_gw.e0: has node-ID 77"]
    assert bench.output.take_news() == []
    assert [each.source for each in bench.run(0.1).of("NodeStatus")] == [77]
    assert {each.source for each in bench.of("Status")} == {77}
    assert bench.gateway.revision > revision


def test_nodes_get_node_ids_in_turn_and_never_the_same_one() -> None:
    bench = waiting(2).run(1.1)
    first, second = unique_ids(bench)
    for node_id, unique_id, found in (
        (50, second, [None, None]),  # it has not requested an id yet
        (50, first, [50, None]),
        (50, second, [50, None]),
        (51, second, [50, 51]),
        (52, first, [50, 51]),  # no node requests an id now
    ):
        receive_allocation(bench, node_id, unique_id)
        assert node_ids(bench) == found


def test_allocator_that_lies_sets_no_node_id_and_does_no_harm() -> None:
    """The unique ids match ours in part, are too long or belong to others. Requests continue."""
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
        receive_allocation(bench, rng.randrange(1, 126), rng.choice(lies)())
        bench.run(rng.choice([0.01, 0.5, 1.1]))
        assert node_ids(bench) == [None]
    assert bench.of("Allocation")[-1].at > bench.now - 3 * SECOND
    receive_allocation(bench, 9, own)
    assert node_ids(bench) == [9]


@pytest.mark.parametrize("source", [0, 100])
def test_requests_of_other_nodes_delay_ours(source: int) -> None:
    """A request of another client and the allocation server's answer to it delay our request."""
    bench = waiting()
    for turn in range(20):
        receive_allocation(
            bench,
            0,
            b"others",
            source,
            first=0 if source else turn + 1,
        )
        bench.run(0.5)
    assert not bench.of("Allocation")
    assert bench.run(1.1).of("Allocation")
