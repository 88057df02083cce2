"""One DroneCAN node: its ids and transfers, what it says of itself, what it answers."""

import struct
from collections.abc import Sequence
from typing import TYPE_CHECKING

from kontronik_can_gw.dronecan import types
from kontronik_can_gw.dronecan.esc_report import EscReport
from kontronik_can_gw.dronecan.transport import LOW, message_id, response_id
from kontronik_can_gw.dronecan.types import GET_NODE_INFO, GET_SET, RESTART_NODE, DataType
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.signals.transfer import TRANSFER_ID, transfer

if TYPE_CHECKING:
    from kontronik_can_gw.dronecan.setup import DronecanSetup, NodeSetup

SERVICES = {kind.number: kind for kind in (GET_NODE_INFO, RESTART_NODE, GET_SET)}
_HARDWARE = (1, 0)
_VALUE_SIZES = (0, 8, 4, 1)
"""Bytes of a parameter's value by the tag of its union: none, integer, real, boolean."""
_STRING = 4
Parameter = int | float | str


class Node:
    """``node_id`` 0: it waits for one, and says nothing."""

    def __init__(
        self, setup: "NodeSetup", of_all: "DronecanSetup", reports: Sequence[EscReport]
    ) -> None:
        self.setup = setup
        self.node_id = setup.node_id
        self.reports = [reports[number] for number in setup.escs]
        self.is_duplicate = False
        """Another device sends with this node-ID."""
        self._table = of_all.given.table
        self._version = of_all.given.version
        self._transfer_ids: dict[int, int] = {}

    def start(self, now: int) -> None:
        """It has its node-ID: let the core send what its ESCs measure."""
        for place, report in enumerate(self.reports):
            report.start(self.node_id, place, now)

    def message(
        self, kind: DataType, payload: bytes, queued: bool = False, priority: int = LOW
    ) -> list[CanFrame]:
        """The frames of a message to all. ``queued`` as in CanFrame."""
        count = self._transfer_ids.get(kind.number, 0)
        self._transfer_ids[kind.number] = count + 1 & TRANSFER_ID
        can_id = message_id(kind.number, self.node_id, priority)
        return transfer(can_id, kind.seed, payload, count, queued)

    def status(self, uptime_s: int, mode: int, bus_is_well: bool) -> bytes:
        """NodeStatus. The ESCs' health counts by choice only: an autopilot does not arm beside a node that is not well."""
        health = types.OK if bus_is_well and not self.is_duplicate else types.WARNING
        code = 0
        for report in self.reports:
            code |= report.word
            if self._table.health == "esc":
                health = max(health, report.health)
        return types.NODE_STATUS.pack(uptime_s & 0xFFFFFFFF, health << 6 | mode << 3, code & 0xFFFF)

    def answer(
        self, request_id: int, kind: DataType, request: bytes, transfer_id: int, status: bytes
    ) -> list[CanFrame]:
        """The response; empty to what is no request. ``request_id``: its CAN id; ``status``: the NodeStatus of now."""
        if kind is GET_NODE_INFO:
            versions = *self._version, 0, 0, 0, *_HARDWARE
            answer = GET_NODE_INFO.pack(status, *versions, self.setup.unique_id, 0)
            answer += self.setup.name.encode("ascii")
        elif kind is GET_SET:
            answer = _get_set(request, self._parameters())
        else:
            answer = RESTART_NODE.pack(False)
        if not answer:
            return []
        return transfer(response_id(request_id), kind.seed, answer, transfer_id, True)

    def _parameters(self) -> dict[str, Parameter]:
        table = self._table
        found: dict[str, Parameter]
        found = {name: getattr(table, name) for name in ("rate_hz", "extended_hz", "rpm")}
        for report in self.reports:
            esc, name = report.esc, report.esc.settings.name
            found[f"{name}.esc_index"] = report.index
            found[f"{name}.pole_pairs"] = esc.pole_pairs
            gear = esc.output_divisor / (esc.pole_pairs * esc.gear_denominator)
            found[f"{name}.gear"] = gear
        return found


def _get_set(request: bytes, parameters: dict[str, Parameter]) -> bytes:
    """The response of param.GetSet: the parameter that is named, else that of the index; nobody sets one. Empty to what is no request."""
    if len(request) < 2:
        return b""
    index, tag = request[0] | request[1] >> 3 << 8, request[1] & 7
    if tag == _STRING:
        start = 3 + int.from_bytes(request[2:3])
    else:
        start = 2 + _VALUE_SIZES[tag] if tag < _STRING else len(request) + 1
    if len(request) < start:
        return b""
    name = request[start:].decode("latin-1")
    if not name:
        name = next(iter([*parameters][index : index + 1]), "")
    value = parameters.get(name)
    # without a default and limits: nobody can set it
    if value is None:
        return bytes(4)
    if isinstance(value, str):
        packed = bytes((_STRING, len(value))) + value.encode("ascii")
    else:
        packed = struct.pack(
            "<Bq" if isinstance(value, int) else "<Bf", 2 - isinstance(value, int), value
        )
    return packed + bytes(3) + name.encode("ascii")
