"""The CANopen nodes of a configuration or a capture, before they are made.

A faulty configuration or EDS is refused. Parameters that a master stored never prevent a start. If
they clash with the configuration, another node or a DBC message, they are ignored with a warning.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from kontronik_can_gw import __version__
from kontronik_can_gw.canopen.check import check_eds
from kontronik_can_gw.canopen.cob_ids import Use
from kontronik_can_gw.canopen.eds import MAX_BYTES, Eds
from kontronik_can_gw.canopen.eds import load as eds_of
from kontronik_can_gw.canopen.eds_changes import with_vendor_id, without
from kontronik_can_gw.canopen.node_settings import NodeSettings, NodeSetup, esc_settings
from kontronik_can_gw.canopen.nodes import Nodes, nodes_alone, traffic
from kontronik_can_gw.canopen.pdo import COMMUNICATION, MAX_TPDOS
from kontronik_can_gw.canopen.storage import Stored, decode, encode
from kontronik_can_gw.config.keys import Config, shipped
from kontronik_can_gw.core.header_parts import (
    LATEST_NS,
    esc_json,
    esc_of,
    file_bytes,
    reading,
    short_text,
    whole_number,
)
from kontronik_can_gw.core.output import OutputHost
from kontronik_can_gw.core.output_setup import HostMachine, OutputSetup
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.signals.plan import classic_bits
from kontronik_can_gw.status import UNCONFIGURED
from kontronik_can_gw.times import SECOND

_SHIPPED = "eds/kontronik_esc.eds"
_MIRRORS = range(0x6000, 0x6800)
"""Objects of CiA 402 that show values of others."""


_RECORDED = {
    "node_id": (1, 255),
    "serial": (0, 0xFFFF_FFFF),
    "vendor_id": (0, 0xFFFF_FFFF),
    "bitrate": (1, 100_000_000),
    "segment_ns": (0, LATEST_NS),
    "device": (0, 0xFFFF),
}
"""The ranges of the numbers of a node in a capture. Those with the default None may be null."""


class _Needs(NamedTuple):
    """The needs of all nodes on the bus."""

    ids: Mapping[int, str]
    usual: tuple[float, float]
    worst: tuple[float, float]


@dataclass(frozen=True)
class CanopenSetup(OutputSetup):
    """The nodes of all ESCs. ``settings`` and ``stored`` have one entry for each ESC."""

    eds: Eds
    settings: tuple[NodeSettings, ...]
    stored: tuple[Stored, ...]
    escs: tuple[EscSettings, ...] = ()
    """The configured ESCs, to which 2100h is restored. If empty, the gateway's ESCs are used."""
    faults: Sequence[tuple[int, str]] = ()
    notes: tuple[str, ...] = ()
    """Warnings about stored parameters and serial numbers."""

    name = "canopen"
    title = "the CANopen nodes"
    changes_escs = True

    @property
    def slots(self) -> int:
        """The number of transmit PDOs of a node."""
        indices = {entry.index for entry in self.eds.entries}
        return len(indices.intersection(range(COMMUNICATION, COMMUNICATION + MAX_TPDOS)))

    def make(self, host: OutputHost, now: int) -> Nodes:
        return Nodes(self.node_setups, host)

    def header(self) -> dict[str, Any]:
        eds = {
            "file": self.eds.name,
            "text": self.eds.data.decode("latin-1"),
        }
        return {
            "eds": eds,
            "nodes": [asdict(node) for node in self.settings],
            "stored": [encode(stored).decode("ascii") for stored in self.stored],
            "escs": [esc_json(esc) for esc in self.escs],
        }

    @property
    def node_setups(self) -> list[NodeSetup]:
        """The setup of each node."""
        setups = []
        for number, settings in enumerate(self.settings):
            stored = self.stored[number]
            base = self.escs[number] if self.escs else None
            setups.append(NodeSetup(self.eds, settings, stored, base))
        return setups

    def nodes(
        self, escs: Sequence[EscSettings], message_ids: Mapping[int, str] | None = None
    ) -> Nodes:
        """Return the nodes as they are after power-on, without a gateway.

        Their COB-IDs and objects can be read. ``message_ids`` are used by messages.
        """
        nodes = nodes_alone(self.node_setups, escs, message_ids or {})
        nodes.start(0, can_open=True)
        return nodes

    # --- before the start

    def esc_settings(self, escs: Sequence[EscSettings]) -> list[EscSettings]:
        """Return the settings with the defaults of the EDS and the stored values of 2100h."""
        setups = zip(self.node_setups, escs, strict=True)
        return [esc_settings(setup.dictionary(esc), esc) for setup, esc in setups]

    def taken_ids(self) -> Mapping[int, str]:
        return self._needs.ids

    def traffic(self, is_worst: bool = False) -> tuple[float, float]:
        return self._needs.worst if is_worst else self._needs.usual

    @cached_property
    def _needs(self) -> _Needs:
        # The nodes are built once, and only these facts are kept.
        nodes = self.nodes(self._escs_in_effect()).nodes
        ids = {}
        for node in nodes:
            for use in node.uses():
                ids[use.cob_id] = use.what
        return _Needs(
            ids,
            usual=traffic(nodes, is_worst=False),
            worst=traffic(nodes, is_worst=True),
        )

    def _escs_in_effect(self) -> list[EscSettings]:
        escs = self.escs or (EscSettings(),) * len(self.settings)
        return self.esc_settings(escs)

    def with_stored(self, machine: HostMachine) -> "CanopenSetup":
        stored: list[Stored] = []
        faults: list[tuple[int, str]] = []
        notes = list(self.notes)
        for number, esc in enumerate(self.escs):
            file = machine.stored(esc.name, decode)
            stored.append(file.content or Stored())
            if file.warning is not None:
                notes.append(file.warning)
            if file.fault is not None:
                faults.append((number, file.fault))
        return replace(
            self,
            stored=tuple(stored),
            faults=tuple(faults),
            notes=tuple(notes),
        )

    def fitted(self, message_ids: Mapping[int, str]) -> "CanopenSetup":
        """Return the setup without the stored node-IDs and COB-IDs that clash.

        A node ignores them together if one of them is used by another node or by a message.
        """
        if all(each == Stored() for each in self.stored):
            return self
        escs = self._escs_in_effect()
        setup = self
        warnings: list[str] = []
        while True:
            clashing = sorted(setup._clashing(escs, message_ids))
            held = setup.stored
            with_node_id = [number for number in clashing if held[number].node_id is not None]
            # Nodes with a stored node-ID first: the other node of the clash may be right.
            to_ignore = with_node_id or [number for number in clashing if held[number].has_ids]
            if not to_ignore:
                return replace(setup, notes=(*warnings, *self.notes))
            kept = list(held)
            for number in to_ignore:
                name = self.escs[number].name
                warnings.append(
                    f"{name}: the stored node-ID and COB-IDs are ignored, "
                    "because one of them now has another user"
                )
                kept[number] = kept[number].without_ids()
            setup = replace(setup, stored=tuple(kept))

    def _clashing(self, escs: Sequence[EscSettings], message_ids: Mapping[int, str]) -> set[int]:
        """Return the numbers of the nodes that cannot use their ids.

        Another node or a message has one of their COB-IDs, or they wait for a node-ID although LSS
        is refused.
        """
        users: dict[int, list[tuple[int, Use]]] = {}
        for number, node in enumerate(self.nodes(escs, message_ids).nodes):
            for use in node.uses():
                users.setdefault(use.cob_id, []).append((number, use))
        clashing: set[int] = set()
        for cob_id, users_of_id in users.items():
            is_shared = len(users_of_id) > 1 and any(use.is_own for _, use in users_of_id)
            if is_shared or cob_id in message_ids:
                clashing.update(dict(users_of_id))
        clashing.update(
            number
            for number, stored in enumerate(self.stored)
            if stored.node_id == UNCONFIGURED and self.settings[number].read_only
        )
        return clashing

    # --- for people

    def warnings(self, file: str, bitrate: int) -> list[str]:
        return list(self.notes)

    def summary(self, escs: Sequence[EscSettings]) -> list[str]:
        found = []
        nodes = self.nodes(escs).nodes
        for node, esc in zip(nodes, escs, strict=True):
            tpdos = sum(tpdo.is_valid for tpdo in node.tpdos)
            plural = "" if tpdos == 1 else "s"
            words = f"node {node.node_id}, {tpdos} TPDO{plural}"
            if node.node_id == UNCONFIGURED:
                words = "waits for LSS"
            found.append(f"CANopen   {esc.name}: {words}")
        return found


def shipped_canopen(node_ids: Iterable[int]) -> CanopenSetup:
    """Return the setup of nodes from the shipped EDS, without a configuration."""
    settings = tuple(NodeSettings(node_id, version=__version__) for node_id in node_ids)
    nothing_stored = (Stored(),) * len(settings)
    file = shipped(_SHIPPED)
    eds = eds_of(file.read_bytes(), str(file))
    return CanopenSetup(eds, settings, nothing_stored)


# --- from a configuration


def configured(config: Config, machine: HostMachine) -> CanopenSetup:
    """Return the nodes of a configuration and its EDS. Raises UserError with every mistake."""
    canopen = config.canopen
    eds = _read_eds(config, machine)
    # At this pace SDO block uploads use at most half of the bus.
    segment_ns = 2 * classic_bits(8) * SECOND // config.can.bitrate
    settings = []
    for number, esc in enumerate(config.esc):
        serial = machine.serial_number(number + 1, esc.name)
        if canopen.serial is not None:
            serial = canopen.serial + number & 0xFFFFFFFF
        node = NodeSettings(
            node_id=config.node_ids[number],
            serial=serial,
            vendor_id=canopen.vendor_id,
            self_start=canopen.self_start,
            read_only=canopen.read_only,
            bitrate=config.can.bitrate,
            segment_ns=segment_ns,
            version=__version__,
            device=esc.device_number,
        )
        settings.append(node)
    notes: tuple[str, ...] = ()
    if canopen.serial is None and not machine.identity:
        note = (
            "this machine has no id, so serial numbers (1018h:4) are 0 "
            "and LSS cannot distinguish the nodes. Set canopen.serial"
        )
        notes = (note,)
    nothing_stored = (Stored(),) * len(settings)
    return CanopenSetup(
        eds,
        tuple(settings),
        nothing_stored,
        escs=tuple(config.escs),
        notes=notes,
    )


def _read_eds(config: Config, machine: HostMachine) -> Eds:
    """Read and check the EDS. Raises UserError with every mistake in it."""
    path = config.eds_path
    # One byte more, to recognise a file that is too large.
    limit = MAX_BYTES + 1
    try:
        data = machine.read_file(path, limit)
    except OSError as error:
        raise UserError(
            f"{path}: cannot be read: {error.strerror}. Set canopen.eds to an EDS file."
        ) from None
    eds = eds_of(data, str(path))
    reference = _reference(eds, path, machine)
    if not config.canopen.cia402_mirrors:
        eds = eds_of(without(data, _MIRRORS), str(path))
    if config.canopen.vendor_id is not None:
        eds = eds_of(with_vendor_id(eds.data, config.canopen.vendor_id), str(path))
    node_ids = [node_id for node_id in config.node_ids if node_id != UNCONFIGURED]
    check_eds(eds, reference, config.escs, node_ids)
    return eds


def _reference(eds: Eds, path: Path, machine: HostMachine) -> Eds:
    """Return the shipped EDS, which ``eds`` from this path may be."""
    file = shipped(_SHIPPED)
    if path == file:
        return eds
    return eds_of(machine.read_file(file, MAX_BYTES), "")


# --- from a capture


def recorded(found: Mapping[str, Any], _escs: Sequence[EscSettings]) -> CanopenSetup:
    """Read the nodes from the header of a capture."""
    with reading("canopen"):
        file = found["eds"]
        eds = eds_of(file_bytes(file["text"], "canopen.eds"), file["file"])
    with reading("canopen.nodes"):
        nodes = tuple(_node(node) for node in found["nodes"])
    with reading("canopen.stored"):
        stored = tuple(decode(text.encode("ascii")) for text in found["stored"])
    with reading("canopen.escs"):
        escs = tuple(esc_of(esc) for esc in found["escs"])
        return CanopenSetup(eds, nodes, stored, escs)


def _node(found: Mapping[str, Any]) -> NodeSettings:
    numbers: dict[str, Any] = {}
    for name, limits in _RECORDED.items():
        value = found[name]
        is_absent = value is None and getattr(NodeSettings, name, 0) is None
        numbers[name] = None if is_absent else whole_number(value, *limits)
    return NodeSettings(
        self_start=bool(found["self_start"]),
        read_only=bool(found["read_only"]),
        version=short_text(found["version"], 100),
        **numbers,
    )
