"""The DroneCAN nodes of a configuration or a capture, before they are made."""

from binascii import crc32
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

from kontronik_can_gw.config.keys import Config
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.core.header_parts import reading, whole_number
from kontronik_can_gw.core.output import OutputHost
from kontronik_can_gw.core.output_setup import Machine, OutputSetup
from kontronik_can_gw.dronecan.esc_report import MAX_ESC_INDEX, MAX_RPM, SPEEDS
from kontronik_can_gw.dronecan.node_setup import Given, NodeSetup
from kontronik_can_gw.dronecan.nodes import Dronecan
from kontronik_can_gw.dronecan.wire import MAX_NODE_ID, NODE
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.frames import id_block
from kontronik_can_gw.signals.plan import classic_bits

_USUAL_BITRATE = 1_000_000
_MAX_SEED = (1 << 64) - 1
_LOWEST_RATE_HZ = 10
"""ArduPilot takes a motor for stopped if it hears nothing of it for 210 ms."""
_STATUS, _BEC = (8, 8, 3), (8, 6)
"""Data bytes of the frames of esc.Status, of CircuitStatus and Temperature."""
_RESOLUTION = (
    "float16: voltage in steps of 0.016 V from 16 V on, 0.031 V from 32 V, 0.063 V from 64 V; "
    "current 0.031 A from 32 A, 0.063 A from 64 A, 0.125 A from 128 A; temperature 0.25 K"
)


@dataclass(frozen=True)
class DronecanSetup(OutputSetup):
    """The nodes of all ESCs."""

    given: Given
    escs: tuple[EscSettings, ...]

    name = "dronecan"
    title = "the DroneCAN nodes"
    slots = 4
    """One for each message in ``esc_report``."""

    @cached_property
    def nodes(self) -> tuple[NodeSetup, ...]:
        """The gateway's node, or one for each ESC."""
        table, numbers = self.given.table, tuple(range(len(self.escs)))
        first = table.node_id
        if not table.per_esc_nodes:
            return (NodeSetup(first, table.name, self._unique_id(table.name), numbers),)
        names = [f"{table.name}.{esc.name.lower()}" for esc in self.escs]
        return tuple(
            NodeSetup(first and first + n, name, self._unique_id(name), (n,))
            for n, name in enumerate(names)
        )

    def _unique_id(self, name: str) -> bytes:
        """The same for this machine and name; others' are others from the first bytes on, for they are asked for by parts."""
        machine, of_name = self.given.identity, name.encode()
        checks = crc32(machine + of_name).to_bytes(4, "big") + crc32(of_name).to_bytes(4, "big")
        return checks + machine[:8].ljust(8, b"\0")

    def make(self, host: OutputHost, now: int) -> Dronecan:
        return Dronecan(self.nodes, self.given, host)

    def header(self) -> dict[str, Any]:
        given = self.given
        table, identity = asdict(given.table), given.identity.hex()
        return given._asdict() | {"table": table, "identity": identity}

    def taken_ids(self) -> Mapping[int, str]:
        """Whatever parses as a frame of one of our nodes; of a node-ID that is not known yet, everything."""
        if not self.given.table.node_id:
            return {id_block(0, 0): "DroneCAN, whose node-ID an allocator chooses"}
        return {
            id_block(node.node_id, NODE): f"DroneCAN node {node.node_id} (bits 0 to 6 of its ids)"
            for node in self.nodes
        }

    def traffic(self, is_worst: bool = False) -> tuple[float, float]:
        table, escs = self.given.table, len(self.escs)
        rates = [*((size, table.rate_hz * escs) for size in _STATUS), (8, table.extended_hz * escs)]
        rates += [*((size, escs) for size in _BEC), (8, len(self.nodes))]
        bits = sum(rate * classic_bits(size, True) for size, rate in rates)
        return sum(rate for _, rate in rates), bits

    def warnings(self, file: str, bitrate: int) -> list[str]:
        found = []
        if bitrate != _USUAL_BITRATE:
            found.append(
                f"dronecan: can.bitrate is {bitrate // 1000} kbit/s; autopilots run DroneCAN at 1000 kbit/s"
            )
        table = self.given.table
        if table.rate_hz < _LOWEST_RATE_HZ:
            found.append(
                f"dronecan.rate_hz is {table.rate_hz}: below {_LOWEST_RATE_HZ} ArduPilot may take a running motor for "
                f"stopped. Set it to {_LOWEST_RATE_HZ} or more"
            )
        if table.extended_hz:
            found.append(
                "dronecan.extended_hz: the motor temperature in esc.StatusExtended is not known and sent as -256 degC, which PX4 "
                "takes for the temperature. Set extended_hz = 0 for PX4"
            )
        if not self.given.identity:
            found.append(
                "dronecan: this machine has no id, so unique ids come from the names alone: "
                "give each gateway on a bus its own dronecan.name"
            )
        plain = [esc.name for esc in self.escs if esc.pole_pairs == 1]
        if plain and table.rpm != "electrical":
            found.append(
                f"dronecan: rpm of {', '.join(plain)} is sent as with one pole pair: set pole_pairs in [[esc]], "
                'or dronecan.rpm = "electrical" if it is one'
            )
        return [f"{file}: {text}" for text in found]

    def summary(self, escs: Sequence[EscSettings]) -> list[str]:
        first = self.given.table.first_index
        return [
            f"DroneCAN  {f'node {node.node_id}' if node.node_id else 'node-ID by an allocator'}, {node.name}: esc_index "
            + " to ".join(dict.fromkeys(str(first + n) for n in (node.escs[0], node.escs[-1])))
            for node in self.nodes
        ]

    def lines(self) -> list[str]:
        table, escs, found = self.given.table, self.escs, []
        for node in self.nodes:
            who = ", ".join(
                f"{escs[n].name} is esc_index {table.first_index + n}" for n in node.escs
            )
            node_id = node.node_id or "asks an allocator"
            found.append(f"node {node_id}, {node.name}, unique id {node.unique_id.hex()}: {who}")
        sent = f"esc.Status at {table.rate_hz} Hz while telemetry is fresh"
        if table.extended_hz:
            sent += f", esc.StatusExtended at {table.extended_hz} Hz"
        return [
            *found,
            f"{sent}; NodeStatus, CircuitStatus and Temperature of the BEC each second",
            f"rpm is {SPEEDS[table.rpm]}, at most {MAX_RPM}: what is more is sent as that; "
            + (
                "negative while the motor turns backward"
                if table.negative_rpm
                else "never negative"
            ),
            _RESOLUTION,
        ]


def configured(config: Config, machine: Machine) -> DronecanSetup:
    """Return the nodes of a configuration. Raises UserError with every mistake in its table."""
    given = Given(config.dronecan, machine.identity, machine.version, machine.random_number())
    try:
        return _checked(given, config.escs)
    except UserError as error:
        raise UserError(*[f"{config.file}: {problem}" for problem in error.problems]) from None


def recorded(found: Mapping[str, Any], escs: Sequence[EscSettings]) -> DronecanSetup:
    """Read the nodes from the header of a capture. The table is checked as in a configuration."""
    with reading("outputs.dronecan"):
        tables = {"dronecan": found["table"], "esc": [{"port": "-"}]}
        table = parse(tables, "the capture").dronecan
        identity = bytes.fromhex(found["identity"])
        seed = whole_number(found["seed"], 0, _MAX_SEED)
        major, minor = [whole_number(each, 0, 255) for each in found["version"]]
        return _checked(Given(table, identity, (major, minor), seed), escs)


def _checked(given: Given, escs: Sequence[EscSettings]) -> DronecanSetup:
    setup = DronecanSetup(given, tuple(escs))
    problems = []
    last = setup.nodes[-1].node_id
    if last > MAX_NODE_ID:
        highest = MAX_NODE_ID + 1 - len(setup.nodes)
        problems.append(
            f"dronecan.node_id: that of the last node would be {last}. Choose one up to {highest}."
        )
    last = given.table.first_index + len(escs) - 1
    if last > MAX_ESC_INDEX:
        problems.append(
            f"dronecan.first_index: esc_index of the last ESC would be {last}. There are 0 to {MAX_ESC_INDEX}."
        )
    if problems:
        raise UserError(*problems)
    return setup
