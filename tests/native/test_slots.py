"""With the core in C the PDOs of ESCs' values are its slots: frames of ESCs do not reach Python."""

import pytest
from dialogue import Bench, info, live

from kontronik_can_gw.core import Follower
from kontronik_can_gw.esc.telemetry import MS, Event

pytestmark = pytest.mark.parametrize("core_language", ["C"], indirect=True)


def followed(bench: Bench) -> list[int]:
    """The events that the nodes are given from now on."""
    found: list[int] = []

    def follow(esc: int, events: int, now: int) -> None:
        found.append(events)
        on_event(esc, events, now)

    ((wanted, on_event),) = bench.gateway.core.followers
    bench.gateway.core.followers = [Follower(wanted, follow)]
    return found


def test_frames_make_the_default_pdos_and_no_event_but_for_other_errors() -> None:
    bench = Bench(nodes=8).start()
    nodes = bench.gateway.nodes
    assert nodes is not None
    for esc in range(8):
        bench.uart(info(), esc)
        bench.uart(live(), esc)
    found, due, sent = followed(bench), nodes.next_deadline(), nodes.node_states()[7][2]
    for number in range(1, 50):
        bench.now += 10 * MS
        for esc in range(8):
            bench.uart(live(electrical_speed=number), esc)
            bench.uart(info(), esc)
    assert found == []
    assert nodes.next_deadline() == due
    assert nodes.node_states()[7][2] > sent + 25
    assert {frame.can_id for frame in bench.take()} >= {0x181 + esc for esc in range(8)}
    bench.uart(live(operating_errors=1), 3)
    assert found == [Event.LIVE | Event.STATE]
