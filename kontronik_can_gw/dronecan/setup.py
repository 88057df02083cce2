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
from kontronik_can_gw.core.output_setup import HostMachine, OutputSetup
from kontronik_can_gw.dronecan.esc_report import MAX_ESC_INDEX, MAX_RPM, SPEEDS
from kontronik_can_gw.dronecan.nodes import Dronecan, DronecanNodeSetup, Given
from kontronik_can_gw.dronecan.wire import MAX_NODE_ID, NODE
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.frames import id_block
from kontronik_can_gw.signals.plan import classic_bits

_USUAL_BITRATE = 1_000_000
_MAX_SEED = (1 << 64) - 1
_LOWEST_RATE_HZ = 10
"""Lower rates are reported. ArduPilot treats a motor as stopped after 210 ms without esc.Status."""
_STATUS = (8, 8, 3)
"""Data bytes of the frames of an esc.Status."""
_EXTENDED = 8
"""Data bytes of the frame of an esc.StatusExtended."""
_BEC = (8, 6)
"""Data bytes of the frames of CircuitStatus and Temperature."""
_NODE_STATUS = 8
"""Data bytes of the frame of a NodeStatus."""
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
    def nodes(self) -> tuple[DronecanNodeSetup, ...]:
        """The gateway's node, or one for each ESC."""
        table = self.given.table
        first = table.node_id
        if not table.per_esc_nodes:
            numbers = tuple(range(len(self.escs)))
            return (DronecanNodeSetup(first, table.name, self._unique_id(table.name), numbers),)
        found = []
        for number, esc in enumerate(self.escs):
            name = f"{table.name}.{esc.name.lower()}"
            node_id = first + number if first else 0
            found.append(DronecanNodeSetup(node_id, name, self._unique_id(name), (number,)))
        return tuple(found)

    def _unique_id(self, name: str) -> bytes:
        """Return the unique id of a node, which is always the same for this machine and name.

        The unique ids of other nodes differ already in the first bytes, because an allocation
        server is asked with a part of the id.
        """
        machine = self.given.identity
        name_bytes = name.encode()
        both_check = crc32(machine + name_bytes).to_bytes(4, "big")
        name_check = crc32(name_bytes).to_bytes(4, "big")
        return both_check + name_check + machine[:8].ljust(8, b"\0")

    def make(self, host: OutputHost, now: int) -> Dronecan:
        return Dronecan(self.nodes, self.given, host)

    def header(self) -> dict[str, Any]:
        given = self.given
        table = asdict(given.table)
        identity = given.identity.hex()
        return given._asdict() | {"table": table, "identity": identity}

    def taken_ids(self) -> Mapping[int, str]:
        """Return the ids of all possible frames of our nodes.

        While a node-ID is unknown, these are all ids.
        """
        if not self.given.table.node_id:
            return {id_block(0, 0): "DroneCAN, because an allocation server may assign any node-ID"}
        found = {}
        for node in self.nodes:
            user = f"DroneCAN node {node.node_id} (bits 0 to 6 of its ids)"
            found[id_block(node.node_id, NODE)] = user
        return found

    def traffic(self, is_worst: bool = False) -> tuple[float, float]:
        table = self.given.table
        escs = len(self.escs)
        rates = [(size, table.rate_hz * escs) for size in _STATUS]
        rates.append((_EXTENDED, table.extended_hz * escs))
        rates += [(size, escs) for size in _BEC]
        rates.append((_NODE_STATUS, len(self.nodes)))
        frames = sum(rate for _, rate in rates)
        return frames, sum(rate * classic_bits(size, True) for size, rate in rates)

    def warnings(self, file: str, bitrate: int) -> list[str]:
        found = []
        if bitrate != _USUAL_BITRATE:
            found.append(
                f"dronecan: can.bitrate is {bitrate // 1000} kbit/s, "
                "but autopilots run DroneCAN at 1000 kbit/s"
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
                "dronecan.extended_hz: the unknown motor temperature in esc.StatusExtended "
                "is sent as -256 degC, which PX4 takes for a measurement. "
                "Set extended_hz = 0 for PX4"
            )
        if not self.given.identity:
            found.append(
                "dronecan: this machine has no id, so unique ids are derived from names only. "
                "Give each gateway on a bus its own dronecan.name"
            )
        plain = [esc.name for esc in self.escs if esc.pole_pairs == 1]
        if plain and table.rpm != "electrical":
            found.append(
                f"dronecan: the rpm of {', '.join(plain)} is computed for one pole pair. "
                "Set pole_pairs in [[esc]]. If the motor has one pole pair, "
                'set dronecan.rpm = "electrical"'
            )
        return [f"{file}: {text}" for text in found]

    def summary(self, escs: Sequence[EscSettings]) -> list[str]:
        first = self.given.table.first_index
        found = []
        for node in self.nodes:
            node_id = _node_id_text(node)
            indices = str(first + node.escs[0])
            if len(node.escs) > 1:
                indices += f" to {first + node.escs[-1]}"
            found.append(f"DroneCAN  {node_id}, {node.name}: esc_index {indices}")
        return found

    def lines(self) -> list[str]:
        table = self.given.table
        found = []
        for node in self.nodes:
            escs = []
            for number in node.escs:
                index = table.first_index + number
                escs.append(f"{self.escs[number].name} is esc_index {index}")
            named = f"{_node_id_text(node)}, {node.name}, unique id {node.unique_id.hex()}"
            found.append(f"{named}: {', '.join(escs)}")
        sign = "negative while the motor turns backward" if table.negative_rpm else "never negative"
        speed = SPEEDS[table.rpm]
        sent = f"esc.Status at {table.rate_hz} Hz while telemetry is fresh"
        if table.extended_hz:
            sent += f", esc.StatusExtended at {table.extended_hz} Hz"
        return [
            *found,
            f"{sent}; NodeStatus, CircuitStatus and Temperature of the BEC each second",
            f"rpm is {speed}, limited to {MAX_RPM}, {sign}",
            _RESOLUTION,
        ]


def _node_id_text(node: DronecanNodeSetup) -> str:
    return f"node {node.node_id}" if node.node_id else "node-ID from an allocation server"


def configured(config: Config, machine: HostMachine) -> DronecanSetup:
    """Return the nodes of a configuration. Raises UserError with every mistake in its table."""
    given = Given(config.dronecan, machine.identity, machine.version, machine.random_number())
    try:
        return _checked(given, config.escs)
    except UserError as error:
        problems = [f"{config.file}: {problem}" for problem in error.problems]
        raise UserError(*problems) from None


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
    """Return the setup. UserError if node-IDs or indices are too large."""
    setup = DronecanSetup(given, tuple(escs))
    problems = []
    last_id = setup.nodes[-1].node_id
    if last_id > MAX_NODE_ID:
        highest = MAX_NODE_ID + 1 - len(setup.nodes)
        problems.append(
            f"dronecan.node_id: the last node would have node-ID {last_id}. "
            f"Choose at most {highest}."
        )
    last_index = given.table.first_index + len(escs) - 1
    if last_index > MAX_ESC_INDEX:
        problems.append(
            f"dronecan.first_index: the last ESC would have esc_index {last_index}. "
            f"The highest esc_index is {MAX_ESC_INDEX}."
        )
    if problems:
        raise UserError(*problems)
    return setup
