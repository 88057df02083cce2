"""What the DroneCAN output is made from: its nodes, what it needs of the bus, what is to be said about it."""

from binascii import crc32
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from kontronik_can_gw.core.output_setup import Given
from kontronik_can_gw.dronecan.esc_report import MAX_ESC_INDEX, MAX_RPM, SPEEDS
from kontronik_can_gw.dronecan.nodes import Dronecan
from kontronik_can_gw.dronecan.wire import MAX_NODE_ID, NODE
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry
from kontronik_can_gw.frames import id_block
from kontronik_can_gw.signals.plan import classic_bits
from kontronik_can_gw.status import GatewayStatus

_USUAL_BITRATE = 1_000_000
_LOWEST_RATE_HZ = 10
"""ArduPilot assumes that a motor has stopped if it receives no status for 210 ms."""
_STATUS = (8, 8, 3)
"""Data bytes of the frames of esc.Status."""
_BEC = (8, 6)
"""Data bytes of the frames of CircuitStatus and Temperature."""
_RESOLUTION = (
    "float16: voltage in steps of 0.016 V from 16 V on, 0.031 V from 32 V, 0.063 V from 64 V; "
    "current 0.031 A from 32 A, 0.063 A from 64 A, 0.125 A from 128 A; temperature 0.25 K"
)


class NodeSetup(NamedTuple):
    """One node. ``node_id`` 0: an allocator chooses it; ``escs``: numbers of its ESCs."""

    node_id: int
    name: str
    unique_id: bytes
    escs: tuple[int, ...]


@dataclass(frozen=True)
class DronecanSetup:
    """OutputSetup; ``given.table`` is a DronecanConfig."""

    given: Given
    escs: tuple[EscSettings, ...]

    name = "dronecan"
    title = "the DroneCAN nodes"

    @property
    def nodes(self) -> tuple[NodeSetup, ...]:
        """The gateway's node, or one for each ESC."""
        table = self.given.table
        first = table.node_id
        if not table.per_esc_nodes:
            numbers = tuple(range(len(self.escs)))
            return (NodeSetup(first, table.name, self._unique_id(table.name), numbers),)
        found = []
        for number, esc in enumerate(self.escs):
            name = f"{table.name}.{esc.name.lower()}"
            node_id = first + number if first else 0
            found.append(NodeSetup(node_id, name, self._unique_id(name), (number,)))
        return tuple(found)

    def _unique_id(self, name: str) -> bytes:
        """Return the unique id of a node, which is always the same for this machine and name.

        The unique ids of other nodes differ already in the first bytes, because an allocator is
        asked with a part of the id.
        """
        machine = self.given.identity
        name_bytes = name.encode()
        both_check = crc32(machine + name_bytes).to_bytes(4, "big")
        name_check = crc32(name_bytes).to_bytes(4, "big")
        return both_check + name_check + machine[:8].ljust(8, b"\0")

    def make(self, escs: Sequence[EscTelemetry], gateway: GatewayStatus, now: int) -> Dronecan:
        return Dronecan(self, escs, gateway)

    def taken_ids(self) -> Mapping[int, str]:
        """Return the ids of all possible frames of our nodes.

        While a node-ID is unknown, these are all ids.
        """
        if not self.given.table.node_id:
            return {id_block(0, 0): "DroneCAN, whose node-ID an allocator chooses"}
        return {
            id_block(node.node_id, NODE): f"DroneCAN node {node.node_id} (bits 0 to 6 of its ids)"
            for node in self.nodes
        }

    def traffic(self) -> tuple[float, float]:
        table, escs = self.given.table, len(self.escs)
        rates = [*((size, table.rate_hz * escs) for size in _STATUS), (8, table.extended_hz * escs)]
        rates += [*((size, escs) for size in _BEC), (8, len(self.nodes))]
        bits = sum(rate * classic_bits(size, True) for size, rate in rates)
        return sum(rate for _, rate in rates), bits

    def warnings(self, bitrate: int) -> list[str]:
        found = []
        if bitrate != _USUAL_BITRATE:
            found.append(
                f"dronecan: can.bitrate is {bitrate // 1000} kbit/s; "
                "autopilots run DroneCAN at 1000 kbit/s"
            )
        table = self.given.table
        if table.rate_hz < _LOWEST_RATE_HZ:
            found.append(
                f"dronecan.rate_hz is {table.rate_hz}: "
                f"below {_LOWEST_RATE_HZ} ArduPilot may take a running motor for stopped. "
                f"Set it to {_LOWEST_RATE_HZ} or more"
            )
        if table.extended_hz:
            found.append(
                "dronecan.extended_hz: the motor temperature in esc.StatusExtended is not known "
                "and sent as -256 degC, which PX4 takes for the temperature. "
                "Set extended_hz = 0 for PX4"
            )
        if not self.given.identity:
            found.append(
                "dronecan: this machine has no id, so unique ids come from the names alone: "
                "give each gateway on a bus its own dronecan.name"
            )
        plain = [esc.name for esc in self.escs if esc.pole_pairs == 1]
        if plain and table.rpm != "electrical":
            found.append(
                f"dronecan: rpm of {', '.join(plain)} is sent as with one pole pair: "
                'set pole_pairs in [[esc]], or dronecan.rpm = "electrical" if it is one'
            )
        return found

    def summary(self) -> list[str]:
        first = self.given.table.first_index
        found = []
        for node in self.nodes:
            node_id = f"node {node.node_id}" if node.node_id else "node-ID by an allocator"
            indices = str(first + node.escs[0])
            if len(node.escs) > 1:
                indices += f" to {first + node.escs[-1]}"
            found.append(f"DroneCAN  {node_id}, {node.name}: esc_index {indices}")
        return found

    def lines(self) -> list[str]:
        table = self.given.table
        escs = self.escs
        found = []
        for node in self.nodes:
            reported = ", ".join(
                f"{escs[n].name} is esc_index {table.first_index + n}" for n in node.escs
            )
            node_id = node.node_id or "asks an allocator"
            unique_id = node.unique_id.hex()
            found.append(f"node {node_id}, {node.name}, unique id {unique_id}: {reported}")
        sent = f"esc.Status at {table.rate_hz} Hz while telemetry is fresh"
        if table.extended_hz:
            sent += f", esc.StatusExtended at {table.extended_hz} Hz"
        sign = "negative while the motor turns backward" if table.negative_rpm else "never negative"
        found.append(f"{sent}; NodeStatus, CircuitStatus and Temperature of the BEC each second")
        found.append(
            f"rpm is {SPEEDS[table.rpm]}, at most {MAX_RPM}: what is more is sent as that; {sign}"
        )
        found.append(_RESOLUTION)
        return found


def configured(given: Given, escs: Sequence[EscSettings]) -> DronecanSetup:
    """The setup. UserError with the mistakes in the table of the configuration."""
    setup, problems = DronecanSetup(given, tuple(escs)), []
    last = setup.nodes[-1].node_id
    if last > MAX_NODE_ID:
        highest = MAX_NODE_ID + 1 - len(setup.nodes)
        problems.append(
            f"dronecan.node_id: that of the last node would be {last}. Choose one up to {highest}."
        )
    last = given.table.first_index + len(escs) - 1
    if last > MAX_ESC_INDEX:
        problems.append(
            f"dronecan.first_index: esc_index of the last ESC would be {last}. "
            f"There are 0 to {MAX_ESC_INDEX}."
        )
    if problems:
        raise UserError(*problems)
    return setup
