"""The order of a node's frames, values that do not fit, node-IDs before the start, and bus load."""

import pytest
from dialogue import EMPTY, QUIET, Bench, live, tpdo

from kontronik_can_gw.canopen.nodes import traffic
from kontronik_can_gw.canopen.objects import GATEWAY, LINK
from kontronik_can_gw.canopen.storage import Stored
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.gateway.transmit_queue import TransmitQueue
from kontronik_can_gw.status import UNCONFIGURED

pytestmark = pytest.mark.promise("order")

LINK_STATUS = LINK << 16 | 0x0108
CRC_ERRORS = LINK << 16 | 0x0720
SENT_FRAMES = GATEWAY << 16 | 0x0320


def test_answers_of_a_node_are_never_overtaken() -> None:
    """SDO responses, emergencies and heartbeats of one id are all sent in order."""
    bench = Bench(changes=QUIET)
    for place in ("00 10 00", "18 10 01", "18 10 04"):
        bench.put(0x601, f"40 {place} 00 00 00 00")
    bench.uart(live(operating_errors=1))
    bench.uart(live())
    for command in (1, 2, 130):
        bench.put(0, bytes((command, 1)))
    bench.put(0x601, "40 00 10 00 00 00 00 00")
    frames = bench.take()
    assert [frame.can_id for frame in frames] == [0x581] * 3 + [0x81] * 2 + [0x701, 0x581]
    waiting = TransmitQueue()  # the queue of a gateway whose interface was busy
    waiting.put_all(frames)
    assert waiting.take_all() == frames


@pytest.mark.promise("parameters")
def test_stored_value_that_does_not_fit_is_reported_once_at_each_reset() -> None:
    stored = Stored(values={0x101700: b"\x01", 0x210001: bytes(9)})
    bench = Bench(changes=QUIET, stored=[stored])
    assert sorted(bench.gateway.take_rejected_parameters()) == [(0, 0x101700), (0, 0x210001)]
    for _ in range(3):
        bench.put(0, "82 01")
        assert bench.gateway.take_rejected_parameters() == [(0, 0x101700)]
    bench.put(0, "81 01")
    assert sorted(bench.gateway.take_rejected_parameters()) == [(0, 0x101700), (0, 0x210001)]


def test_node_ids_to_lock_are_known_before_the_start() -> None:
    """Locks between gateways are taken before the first frame is sent."""
    setup = Bench(node_ids=[5, 9, UNCONFIGURED]).setup
    gateway = Gateway(
        CoreSettings([EscSettings(f"esc{n}") for n in range(3)], EMPTY), 0, outputs=[setup]
    )
    assert [node_id for node_id, _, _ in gateway.node_states()] == [5, 9, UNCONFIGURED]
    gateway.start(0)
    assert [node_id for node_id, _, _ in gateway.node_states()] == [5, 9, UNCONFIGURED]


@pytest.mark.promise("overload")
def test_bus_load_is_computed_from_the_rate_of_each_pdo() -> None:
    def rate(*mapped: int, kind: int = 255, timer: int = 0) -> float:
        bench = Bench(changes={**QUIET, **tpdo(1, kind, 0, timer, *mapped)}).start()
        return traffic(bench.nodes, is_worst=False)[0]

    assert rate(0x20000210) == 100
    assert rate(CRC_ERRORS) == rate(SENT_FRAMES) == rate(LINK_STATUS) == 1
    assert rate(LINK_STATUS, timer=100) == 10
    assert rate(0x20000210, kind=5) == 2
