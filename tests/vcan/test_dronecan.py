"""A gateway process with DroneCAN nodes of 1 and 4 ESCs, and the package ``dronecan``.

The package is monitor, allocation server and client.
"""

from collections.abc import Callable
from contextlib import closing
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from harness import PtyPort
from vcan_tools import LIMIT_S, GatewayProcess, configuration, feeding, sent_by, wait_for

from kontronik_can_gw.esc.kontronik.fields import LiveData

pytestmark = [
    pytest.mark.promise("dronecan"),
    pytest.mark.extended,
]
dronecan: Any = import_module("dronecan")
Start = Callable[..., GatewayProcess]


def started(
    interface: str,
    ports: list[PtyPort],
    start: Start,
    more: str,
) -> GatewayProcess:
    """Start a gateway with DroneCAN alone, and wait until its ports are open."""
    tables = f"[dbc]\nenabled = false\n[dronecan]\nenabled = true\nper_esc_nodes = true\n{more}"
    gateway = start(configuration(interface, ports, tables))
    gateway.wait_for_line(f"esc{len(ports)}: /")
    return gateway


class Peer:
    """A node of the package on the interface. ``statuses`` has the esc.Status messages so far."""

    def __init__(self, interface: str) -> None:
        driver = dronecan.driver.SocketCAN(interface)
        self.node = dronecan.node.Node(driver, node_id=100)
        self.statuses: list[Any] = []
        self.node.add_handler(dronecan.uavcan.equipment.esc.Status, self.note_status)
        self.monitor = dronecan.app.node_monitor.NodeMonitor(self.node)

    def note_status(self, event: Any) -> None:
        self.statuses.append(event)

    def until(self, condition: Callable[[], object], what: str) -> None:
        def spun() -> bool:
            self.node.spin(timeout=0)
            return bool(condition())

        wait_for(spun, what)

    def known(self) -> set[int]:
        """Return the nodes that answered GetNodeInfo."""
        return {entry.node_id for entry in self.monitor.find_all(lambda e: e.info is not None)}

    def ask(self, request: Any, to: int) -> Any:
        answers: list[Any] = []
        self.node.request(request, to, answers.append, timeout=LIMIT_S)
        self.until(lambda: answers, "an answer")
        assert answers[0] is not None
        return answers[0].response

    def close(self) -> None:
        self.node.close()


def expected_rpm(live: LiveData) -> int:
    """Return the speed of a motor with 7 pole pairs. It is negative in the backward states."""
    rpm = (live.electrical_speed + 3) // 7
    is_backward = live.operating_state in (19, 22)
    return -rpm if is_backward else rpm


def has_values(status: Any, live: LiveData) -> bool:
    """Return whether a status has the values of a live frame."""
    kelvin = live.power_stage_temperature + 273.15
    return bool(
        expected_rpm(live) == status.rpm
        and abs(live.battery_voltage / 100 - status.voltage) < 0.032
        and abs(live.battery_current / 10 - status.current) < 0.126
        and abs(kelvin - status.temperature) < 0.126
    )


def check_statuses(ports: list[PtyPort], peer: Peer) -> None:
    """Start telemetry, and check that each later status has the values of a sent frame."""
    for port in ports:
        port.on = True
    peer.statuses.clear()
    peer.until(lambda: len(peer.statuses) >= 60 * len(ports), "esc.Status")
    for event in list(peer.statuses):
        got = event.message
        sent = sent_by(ports[got.esc_index])
        assert any(has_values(got, each) for each in sent), got
    indices = [event.message.esc_index for event in peer.statuses]
    assert set(indices) == set(range(len(ports)))


@pytest.mark.parametrize("escs", [1, 4])
def test_foreign_node_reads_status_info_and_parameters(
    vcan: str,
    start_gateway: Start,
    tmp_path: Path,
    escs: int,
) -> None:
    with feeding(tmp_path, escs) as ports, closing(Peer(vcan)) as peer:
        gateway = started(vcan, ports, start_gateway, "node_id = 20")
        nodes = set(range(20, 20 + escs))
        peer.until(lambda: peer.known() >= nodes, "GetNodeInfo")
        check_statuses(ports, peer)
        for entry in peer.monitor.find_all(lambda e: e.node_id in nodes):
            assert entry.status.health == entry.status.HEALTH_OK
            assert entry.status.mode == entry.status.MODE_OPERATIONAL
        request = dronecan.uavcan.protocol.param.GetSet.Request()
        name = f"esc{escs}.pole_pairs"
        request.name.from_bytes(name.encode())
        answer = peer.ask(request, 20 + escs - 1)
        assert answer.value.integer_value == 7
        assert bytes(answer.name.to_bytes()).decode() == name
        assert gateway.end() == 0, gateway.log
        offline = dronecan.uavcan.protocol.NodeStatus().MODE_OFFLINE
        ours = list(peer.monitor.find_all(lambda e: e.node_id in nodes))
        peer.until(lambda: all(entry.status.mode == offline for entry in ours), "OFFLINE")


@pytest.mark.parametrize("escs", [1, 4])
def test_foreign_allocator_sets_the_node_ids(
    vcan: str,
    start_gateway: Start,
    tmp_path: Path,
    escs: int,
) -> None:
    with feeding(tmp_path, escs) as ports, closing(Peer(vcan)) as peer:
        gateway = started(vcan, ports, start_gateway, "")
        server = dronecan.app.dynamic_node_id.CentralizedServer(peer.node, peer.monitor)
        peer.until(lambda: len(peer.known()) == escs, "nodes")
        table = server._allocation_table
        for entry in peer.monitor.find_all(lambda _: True):
            unique_id = bytes(entry.info.hardware_version.unique_id.to_bytes())
            assert table.get_node_id(unique_id) == entry.node_id
            gateway.wait_for_line(f"has node-ID {entry.node_id}")
        check_statuses(ports, peer)
        assert gateway.end() == 0, gateway.log
