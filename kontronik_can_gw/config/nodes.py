"""Builds the CANopen nodes of a configuration: EDS, node-IDs, serial numbers and stored parameters.

A faulty configuration or EDS is refused. Parameters stored over the bus never prevent a start: where they clash with the configuration,
another node or a DBC message, they are ignored with a warning.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from kontronik_can_gw import __version__
from kontronik_can_gw.canopen.check import check_eds
from kontronik_can_gw.canopen.cob_ids import Use, uses
from kontronik_can_gw.canopen.dcf import without
from kontronik_can_gw.canopen.eds import MAX_BYTES, Eds
from kontronik_can_gw.canopen.eds import load as eds_of
from kontronik_can_gw.canopen.node_settings import NodeSettings
from kontronik_can_gw.canopen.nodes import CanopenSetup
from kontronik_can_gw.canopen.storage import Stored, decode
from kontronik_can_gw.config.keys import Config, shipped
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import SECOND, EscSettings
from kontronik_can_gw.node_state import UNCONFIGURED
from kontronik_can_gw.runtime.machine import machine_identity, serial_number, state_folder
from kontronik_can_gw.runtime.store import ParameterStore, parameter_file
from kontronik_can_gw.signals.plan import classic_bits


def load_eds(config: Config) -> Eds:
    """The EDS in use, checked."""
    path = config.eds_path
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)  # one byte more shows that it is too large
    except OSError as error:
        raise UserError(
            f"{path}: cannot be read: {error.strerror}. canopen.eds names the EDS file."
        ) from None
    shipped_file = shipped("eds/kontronik_esc.eds")
    eds = eds_of(data, str(path))
    reference = eds if path == shipped_file else eds_of(shipped_file.read_bytes(), "")
    if not config.canopen.cia402_mirrors:
        eds = eds_of(without(data, range(0x6000, 0x6800)), str(path))
    node_ids = [node_id for node_id in config.node_ids if node_id != UNCONFIGURED]
    check_eds(eds, reference, config.escs, node_ids)
    return eds


def parameter_folder(config: Config) -> Path:
    """The folder of the stored parameters."""
    if config.canopen.store is None:
        return state_folder()
    return Path(config.file).parent / config.canopen.store


def plain_setup(config: Config) -> CanopenSetup:
    """The nodes from configuration and EDS, without stored parameters."""
    canopen, identity = config.canopen, machine_identity()
    # SDO block uploads use at most half of the bus
    segment_ns = 2 * classic_bits(8) * SECOND // config.can.bitrate
    settings = []
    for number, (esc, node_id) in enumerate(zip(config.esc, config.node_ids, strict=True)):
        serial = serial_number(number + 1, esc.name, identity)
        if canopen.serial is not None:
            serial = canopen.serial + number & 0xFFFFFFFF
        own = NodeSettings(
            *(node_id, serial, canopen.vendor_id, canopen.self_start, canopen.read_only),
            bitrate=config.can.bitrate,
            segment_ns=segment_ns,
            version=__version__,
            device=esc.device_number,
        )
        settings.append(own)
    nothing = (Stored(),) * len(settings)
    return CanopenSetup(load_eds(config), tuple(settings), nothing, tuple(config.escs))


def needs(setup: CanopenSetup, escs: Sequence[EscSettings]) -> tuple[dict[int, str], float, float]:
    """COB-IDs of the nodes and their users, and the bits per second they need: usual and worst."""
    made = setup.nodes(escs)
    ids = {cob_id: what for node in made.nodes for cob_id, what, *_ in uses(node)}
    return ids, made.traffic()[1], made.traffic(is_worst=True)[1]


Kept = tuple[list[Stored], list[tuple[int, str]], list[str]]
"""What is stored for each ESC's node; ESCs whose parameters cannot be read, and why; warnings."""


def read_stored(config: Config, store: ParameterStore | None) -> Kept:
    """Parameters that masters stored. Without a store its files are only read."""
    stored: list[Stored] = []
    damaged: list[tuple[int, str]] = []
    warnings: list[str] = []
    if config.canopen.serial is None and not machine_identity():
        warnings.append(
            "this machine has no id, so serial numbers (1018h:4) are 0 and LSS cannot distinguish the nodes: set canopen.serial"
        )
    for number, esc in enumerate(config.esc):
        if store is None:
            found, reason = _read_stored_file(parameter_file(parameter_folder(config), esc.name))
            if reason is not None:
                warnings.append(f"{esc.name}: stored parameters: {reason}")
        else:
            if trouble := store.lock(esc.name):
                warnings.append(f"{esc.name}: parameters could not be stored: {trouble}")
            found, reason = store.load(esc.name)
        stored.append(found)
        if reason is not None:
            damaged.append((number, reason))
    return stored, damaged, warnings


def _read_stored_file(path: Path) -> tuple[Stored, str | None]:
    """What is stored for a node, and why it cannot be read; nothing is changed."""
    try:
        return decode(path.read_bytes()), None
    except FileNotFoundError:
        return Stored(), None
    except OSError as error:
        return Stored(), f"{path}: cannot be read: {error.strerror}"
    except ValueError as error:
        return Stored(), f"{path}: {error}"


def with_stored(
    plain: CanopenSetup,
    stored: Sequence[Stored],
    config: Config,
    escs: Sequence[EscSettings],
    foreign: Mapping[int, str],
) -> tuple[CanopenSetup, list[str]]:
    """The nodes with stored parameters, without the ids of those that clash; and a warning for each of these."""
    if all(each == Stored() for each in stored):
        return plain, []
    said: list[str] = []
    kept = list(stored)
    while True:
        setup = replace(plain, stored=tuple(kept))
        found = [n for n in sorted(_clashing(setup, escs, foreign)) if kept[n].has_ids]
        # a node that is moved onto another one's ids clashes with a node that may be right
        clash = [n for n in found if kept[n].node_id is not None] or found
        if not clash:
            return setup, said
        for number in clash:
            said.append(
                f"{config.esc[number].name}: the stored node-ID and COB-IDs are ignored: one of them is used otherwise now"
            )
            kept[number] = kept[number].without_ids()


def _clashing(
    setup: CanopenSetup, escs: Sequence[EscSettings], foreign: Mapping[int, str]
) -> set[int]:
    """Nodes with a COB-ID that something else uses, or that wait for a node-ID although LSS is refused."""
    users: dict[int, list[tuple[int, Use]]] = {}
    for number, node in enumerate(setup.nodes(escs, foreign).nodes):
        for use in uses(node):
            users.setdefault(use.cob_id, []).append((number, use))
    found = {
        number
        for cob_id, those in users.items()
        if cob_id in foreign or (len(those) > 1 and any(use.own for _, use in those))
        for number, _ in those
    }
    pairs = enumerate(zip(setup.settings, setup.stored, strict=True))
    return found | {n for n, (own, s) in pairs if own.read_only and s.node_id == UNCONFIGURED}


def shipped_canopen(node_ids: Iterable[int]) -> CanopenSetup:
    """Nodes from the shipped EDS, without a configuration."""
    settings = tuple(NodeSettings(node_id, version=__version__) for node_id in node_ids)
    file = shipped("eds/kontronik_esc.eds")
    return CanopenSetup(eds_of(file.read_bytes(), str(file)), settings, (Stored(),) * len(settings))
