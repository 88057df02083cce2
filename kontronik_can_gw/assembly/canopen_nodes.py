"""Builds the CANopen nodes of a configuration: EDS, node-IDs, serial numbers and stored parameters.

A faulty configuration or EDS is refused. Parameters that a master stored never prevent a start. If
they clash with the configuration, another node or a DBC message, they are ignored with a warning.
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
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.runtime.files.store import ParameterStore, parameter_file
from kontronik_can_gw.runtime.system.machine import machine_identity, serial_number, state_folder
from kontronik_can_gw.signals.plan import classic_bits
from kontronik_can_gw.status import UNCONFIGURED
from kontronik_can_gw.times import SECOND


def load_eds(config: Config) -> Eds:
    """Load and check the EDS. Raises UserError with every mistake in it."""
    path = config.eds_path
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)  # one byte more, to recognise a file that is too large
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
    """Return the folder of the stored parameters."""
    if config.canopen.store is None:
        return state_folder()
    return Path(config.file).parent / config.canopen.store


def plain_setup(config: Config) -> CanopenSetup:
    """Return the setup of the nodes from configuration and EDS, without stored parameters."""
    canopen = config.canopen
    identity = machine_identity()
    # At this pace SDO block uploads use at most half of the bus.
    segment_ns = 2 * classic_bits(8) * SECOND // config.can.bitrate
    settings = []
    for number, (esc, node_id) in enumerate(zip(config.esc, config.node_ids, strict=True)):
        serial = serial_number(number + 1, esc.name, identity)
        if canopen.serial is not None:
            serial = canopen.serial + number & 0xFFFFFFFF
        node = NodeSettings(
            node_id=node_id,
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
    nothing_stored = (Stored(),) * len(settings)
    return CanopenSetup(load_eds(config), tuple(settings), nothing_stored, tuple(config.escs))


def needs(setup: CanopenSetup, escs: Sequence[EscSettings]) -> tuple[dict[int, str], float, float]:
    """Return the COB-IDs of the nodes with the use of each, and their usual and worst load in bit/s."""
    nodes = setup.nodes(escs)
    ids = {use.cob_id: use.what for node in nodes.nodes for use in uses(node)}
    return ids, nodes.traffic()[1], nodes.traffic(is_worst=True)[1]


Kept = tuple[list[Stored], list[tuple[int, str]], list[str]]
"""Three lists about stored parameters:

1. the parameters of each ESC's node,
2. index of each ESC whose parameters cannot be read, and the reason,
3. warnings.
"""


def read_stored(config: Config, store: ParameterStore | None) -> Kept:
    """Read the parameters that masters stored.

    With a store, its files are locked. Without one, they are only read.
    """
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
            lock_problem = store.lock(esc.name)
            if lock_problem:
                warnings.append(f"{esc.name}: parameters could not be stored: {lock_problem}")
            found, reason = store.load(esc.name)
        stored.append(found)
        if reason is not None:
            damaged.append((number, reason))
    return stored, damaged, warnings


def _read_stored_file(path: Path) -> tuple[Stored, str | None]:
    """Return the parameters in a file, and the reason if it cannot be read."""
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
    """Return the setup with stored parameters, and warnings about ignored ones.

    The stored node-ID and COB-IDs of a node are ignored if one of them clashes with another node or
    with ``foreign``, the DBC messages by 11-bit id.
    """
    if all(each == Stored() for each in stored):
        return plain, []
    warnings: list[str] = []
    kept = list(stored)
    while True:
        setup = replace(plain, stored=tuple(kept))
        clashing = [n for n in sorted(_clashing(setup, escs, foreign)) if kept[n].has_ids]
        # Nodes with a stored node-ID first: the other node of the clash may be right.
        moved = [n for n in clashing if kept[n].node_id is not None]
        to_ignore = moved or clashing
        if not to_ignore:
            return setup, warnings
        for number in to_ignore:
            warnings.append(
                f"{config.esc[number].name}: the stored node-ID and COB-IDs are ignored: one of them is used otherwise now"
            )
            kept[number] = kept[number].without_ids()


def _clashing(
    setup: CanopenSetup, escs: Sequence[EscSettings], foreign: Mapping[int, str]
) -> set[int]:
    """Return the numbers of the nodes that cannot use their ids.

    Another node or a DBC message has one of their COB-IDs, or they wait for a node-ID although LSS
    is refused.
    """
    users: dict[int, list[tuple[int, Use]]] = {}
    for number, node in enumerate(setup.nodes(escs, foreign).nodes):
        for use in uses(node):
            users.setdefault(use.cob_id, []).append((number, use))
    clashing: set[int] = set()
    for cob_id, users_of_id in users.items():
        is_shared = len(users_of_id) > 1 and any(use.own for _, use in users_of_id)
        if is_shared or cob_id in foreign:
            clashing.update(number for number, _ in users_of_id)
    for number, (settings, stored) in enumerate(zip(setup.settings, setup.stored, strict=True)):
        if settings.read_only and stored.node_id == UNCONFIGURED:
            clashing.add(number)
    return clashing


def shipped_canopen(node_ids: Iterable[int]) -> CanopenSetup:
    """Return the setup of nodes from the shipped EDS, without a configuration."""
    settings = tuple(NodeSettings(node_id, version=__version__) for node_id in node_ids)
    nothing_stored = (Stored(),) * len(settings)
    file = shipped("eds/kontronik_esc.eds")
    eds = eds_of(file.read_bytes(), str(file))
    return CanopenSetup(eds, settings, nothing_stored)
