"""One DroneCAN node: its ids and transfers, what it says of itself, what it answers."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from kontronik_can_gw.dronecan import parameters, types
from kontronik_can_gw.dronecan.esc_report import EscReport
from kontronik_can_gw.dronecan.transport import (
    LOW,
    LOWEST,
    DataType,
    message_id,
    response_id,
    transfer,
)
from kontronik_can_gw.frames import CanFrame

if TYPE_CHECKING:
    from kontronik_can_gw.dronecan.setup import DronecanSetup, NodeSetup

SERVICES = {kind.number: kind for kind in (types.GET_NODE_INFO, types.RESTART_NODE, types.GET_SET)}
_HARDWARE = (1, 0)


class Node:
    """``node_id`` 0: it waits for one, and says nothing. ``put`` takes its frames; ``state`` gives its NodeStatus at a time."""

    def __init__(
        self,
        setup: "NodeSetup",
        of_all: "DronecanSetup",
        reports: Sequence[EscReport],
        put: Callable[[list[CanFrame]], object],
    ) -> None:
        self.setup = setup
        self.node_id = setup.node_id
        self.reports = [reports[number] for number in setup.escs]
        self.is_duplicate = False
        """Another device sends with this node-ID."""
        self._table = of_all.given.table
        self._version = of_all.given.version
        self._put = put
        self._transfer_ids: dict[int, int] = {}

    def send(
        self,
        kind: DataType,
        payload: bytes,
        priority: int = LOW,
        queued: bool = False,
        page: int = 0,
    ) -> None:
        """Broadcast a message. ``queued`` and ``page`` as in CanFrame."""
        number = self._transfer_ids.get(kind.number, 0)
        self._transfer_ids[kind.number] = number + 1 & 0x1F
        can_id = message_id(kind, self.node_id, priority)
        self._put(transfer(can_id, kind.seed, payload, number, queued, page))

    def status(self, uptime_s: int, mode: int, bus_is_well: bool) -> bytes:
        """NodeStatus. The ESCs' health counts by choice only: an autopilot does not arm beside a node that is not well."""
        health = types.OK if bus_is_well and not self.is_duplicate else types.WARNING
        code = 0
        for report in self.reports:
            code |= report.word
            if self._table.health == "esc":
                health = max(health, report.health)
        return types.node_status(uptime_s, health, mode, code)

    def say_status(self, status: bytes) -> None:
        """Broadcast NodeStatus."""
        self.send(types.NODE_STATUS, status, LOWEST)

    def answer(self, service: DataType, request: bytes, status: bytes) -> bytes | None:
        """The response to a request; None where there is none. ``status``: the NodeStatus of now."""
        if service is types.GET_NODE_INFO:
            setup = self.setup
            return types.node_info(status, self._version, _HARDWARE, setup.unique_id, setup.name)
        if service is types.GET_SET:
            return parameters.answer(request, self._parameters())
        return b"\0"  # RestartNode: refused

    def respond(self, request_id: int, service: DataType, payload: bytes, transfer_id: int) -> None:
        """Send the response to a request with this CAN id and transfer id."""
        self._put(transfer(response_id(request_id), service.seed, payload, transfer_id, True))

    def _parameters(self) -> list[parameters.Parameter]:
        table = self._table
        found: list[parameters.Parameter] = [
            ("rate_hz", table.rate_hz),
            ("extended_hz", table.extended_hz),
            ("rpm", table.rpm),
        ]
        for report in self.reports:
            esc, name = report.esc, report.esc.settings.name
            found += [
                (f"{name}.esc_index", report.index),
                (f"{name}.pole_pairs", esc.pole_pairs),
                (f"{name}.gear", esc.output_divisor / (esc.pole_pairs * esc.gear_denominator)),
            ]
        return found
