"""ESCs -> gateway process with DroneCAN nodes -> vcan -> the package ``dronecan`` as monitor, allocator and asker; 1 and 4 ESCs."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import pytest
from vcan_tools import LIMIT_S, Bench, GatewayProcess, bench, wait_for

from kontronik_can_gw.esc.kontronik.simulator import EscOptions, Phase
from kontronik_can_gw.esc.kontronik.states import OperatingState

pytestmark = pytest.mark.extended
dronecan: Any = import_module("dronecan")
Start = Callable[..., GatewayProcess]
LIVELY = (
    Phase("up", 0.5, 80, OperatingState.Forward, 0.5),
    Phase("down", 0.5, 20, OperatingState.Forward, 0.5),
)


def configuration(interface: str, run: Bench, more: str) -> str:
    parts = [
        f'[can]\ninterface = "socketcan"\nchannel = "{interface}"\nbitrate = 1000000\n[dbc]\nenabled = false\n',
        f"[dronecan]\nenabled = true\n{more}\n",
    ]
    parts += [
        f'[[esc]]\nport = "{port.path}"\nname = "e{n}"\npole_pairs = 7\ntelemetry_timeout_ms = 60000\n'
        for n, port in enumerate(run.ports)
    ]
    return "".join(parts)


class Peer:
    """A node of the package on the interface; ``statuses``: the esc.Status messages so far."""

    def __init__(self, interface: str) -> None:
        driver = dronecan.driver.SocketCAN(interface)
        self.node = dronecan.node.Node(driver, node_id=100)
        self.statuses: list[Any] = []
        self.node.add_handler(
            dronecan.uavcan.equipment.esc.Status, lambda event: self.statuses.append(event)
        )
        self.monitor = dronecan.app.node_monitor.NodeMonitor(self.node)

    def until(self, condition: Callable[[], object], what: str) -> None:
        def spun() -> bool:
            self.node.spin(timeout=0)
            return bool(condition())

        wait_for(spun, what)

    def known(self) -> set[int]:
        """Nodes whose GetNodeInfo was answered."""
        return {entry.node_id for entry in self.monitor.find_all(lambda e: e.info is not None)}

    def ask(self, request: Any, to: int) -> Any:
        answers: list[Any] = []
        self.node.request(request, to, answers.append, timeout=LIMIT_S)
        self.until(lambda: answers, "an answer")
        assert answers[0] is not None
        return answers[0].response


@contextmanager
def peer_on(interface: str) -> Iterator[Peer]:
    peer = Peer(interface)
    try:
        yield peer
    finally:
        peer.node.close()


def check_statuses(run: Bench, peer: Peer, escs: Sequence[int]) -> None:
    """Each that comes from now on is a reading that was sent."""
    peer.statuses.clear()
    peer.until(lambda: len(peer.statuses) >= 60 * len(escs), "esc.Status")
    for event in list(peer.statuses):
        got = event.message
        sent = run.live(got.esc_index)
        assert any(
            (each.electrical_speed + 3) // 7 == got.rpm
            and abs(each.battery_voltage / 100 - got.voltage) < 0.032
            and abs(each.battery_current / 10 - got.current) < 0.126
            and abs(each.power_stage_temperature + 273.15 - got.temperature) < 0.126
            for each in sent
        ), got
    indices = [event.message.esc_index for event in peer.statuses]
    assert set(indices) == set(escs)


@pytest.mark.parametrize("escs", [1, 4])
def test_a_foreign_node_sees_asks_and_reads(vcan: str, start_gateway: Start, escs: int) -> None:
    with bench(*[EscOptions(profile=LIVELY)] * escs) as run, peer_on(vcan) as peer:
        more = "node_id = 20\nper_esc_nodes = true"
        gateway = start_gateway(configuration(vcan, run, more))
        gateway.wait_for_line(f"e{escs - 1}: /dev/pts")
        nodes = set(range(20, 20 + escs))
        peer.until(lambda: peer.known() >= nodes, "GetNodeInfo")
        run.start()
        check_statuses(run, peer, range(escs))
        for entry in peer.monitor.find_all(lambda e: e.node_id in nodes):
            assert entry.status.health == entry.status.HEALTH_OK
            assert entry.status.mode == entry.status.MODE_OPERATIONAL
        request = dronecan.uavcan.protocol.param.GetSet.Request()
        name = f"e{escs - 1}.pole_pairs"
        request.name.from_bytes(name.encode())
        answer = peer.ask(request, 20 + escs - 1)
        assert answer.value.integer_value == 7
        assert bytes(answer.name.to_bytes()).decode() == name
        assert gateway.end() == 0, gateway.log
        offline = dronecan.uavcan.protocol.NodeStatus().MODE_OFFLINE
        peer.until(
            lambda: all(
                entry.status.mode == offline
                for entry in peer.monitor.find_all(lambda e: e.node_id in nodes)
            ),
            "OFFLINE",
        )


@pytest.mark.parametrize("escs", [1, 4])
def test_a_foreign_allocator_gives_the_node_ids(vcan: str, start_gateway: Start, escs: int) -> None:
    with bench(*[EscOptions(profile=LIVELY)] * escs) as run, peer_on(vcan) as peer:
        gateway = start_gateway(configuration(vcan, run, "per_esc_nodes = true"))
        gateway.wait_for_line(f"e{escs - 1}: /dev/pts")
        server = dronecan.app.dynamic_node_id.CentralizedServer(peer.node, peer.monitor)
        peer.until(lambda: len(peer.known()) == escs, "nodes")
        table = server._allocation_table
        for entry in peer.monitor.find_all(lambda _: True):
            unique_id = bytes(entry.info.hardware_version.unique_id.to_bytes())
            assert table.get_node_id(unique_id) == entry.node_id
            gateway.wait_for_line(f"has node-ID {entry.node_id}")
        run.start()
        check_statuses(run, peer, range(escs))
        assert gateway.end() == 0, gateway.log
