"""Loads a configuration and the files that it names: DBC, EDS, stored parameters.

All mistakes are reported at once.
"""

import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from kontronik_can_gw import __version__
from kontronik_can_gw.config.keys import Config, EscConfig
from kontronik_can_gw.config.parse import examine
from kontronik_can_gw.core.output_setup import OUTPUTS, Given, OutputSetup, setup_of
from kontronik_can_gw.dbc.prepare import check_load, prepare, unreported, unsupplied
from kontronik_can_gw.dbc.reader import parse_database, read_dbc
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.runtime.can.open_can import check_interface
from kontronik_can_gw.runtime.system.machine import identity_digest
from kontronik_can_gw.signals.plan import Layout
from kontronik_can_gw.status import UNCONFIGURED

if TYPE_CHECKING:
    from cantools.database.can import Database

    from kontronik_can_gw.canopen.nodes import CanopenSetup
    from kontronik_can_gw.canopen.storage import Stored
    from kontronik_can_gw.runtime.files.store import ParameterStore


_NODES = "the CANopen nodes"


@contextmanager
def collecting(problems: list[str]) -> Iterator[None]:
    """Append the lines of a UserError to ``problems``. Other exceptions, also RunError, pass."""
    try:
        yield
    except RunError:
        raise
    except UserError as error:
        problems += error.problems


def without_clashing_escs(config: Config) -> Config:
    """Return the configuration without faulty ESCs, so that the rest can be checked.

    An ESC is faulty if it has the name, port or node-ID of an earlier one, or an invalid node-ID.
    """
    kept: list[EscConfig] = []
    seen: set[object] = set()
    for esc, node_id in zip(config.esc, config.node_ids, strict=True):
        own: set[object] = {normalize(esc.name), ("port", esc.port)}
        if node_id != UNCONFIGURED:
            own.add(node_id)
        is_valid = node_id <= 127 or node_id == UNCONFIGURED
        if is_valid and not own & seen:
            kept.append(replace(esc, node_id=node_id))
            seen |= own
    return replace(config, esc=tuple(kept))


@dataclass(frozen=True)
class Loaded:
    """A checked configuration and the objects made from it."""

    config: Config
    escs: list[EscSettings]
    """The settings in effect: of the configuration, or stored by a master."""
    database: "Database | None"
    """The DBC, parsed. None without the DBC output."""
    layout: Layout
    canopen: "CanopenSetup | None"
    """None without CANopen nodes."""
    damaged: tuple[tuple[int, str], ...]
    """Index of each ESC whose stored parameters cannot be read, and the reason."""
    store: "ParameterStore | None"
    warnings: tuple[str, ...] = ()
    dbc: bytes = b""
    """Content of the DBC file."""
    outputs: tuple[OutputSetup, ...] = ()
    """Setups of the outputs other than DBC and CANopen."""


def load_configuration(
    path: Path, store: "Callable[[Path], ParameterStore] | None" = None
) -> Loaded:
    """Load a configuration and the files that it names. Raises UserError with every mistake.

    ``store`` makes the parameter store of a running gateway. If it is None, stored parameters are
    read and nothing is written.
    """
    config, problems = examine(path)
    if config is None:
        raise UserError(*problems)
    with collecting(problems):
        check_interface(config.can)
    if problems:
        with collecting(problems):
            assemble(without_clashing_escs(config))
        raise UserError(*problems)
    if store is None or not config.canopen.enabled:
        return assemble(config)
    from kontronik_can_gw.assembly.canopen_nodes import parameter_folder

    return assemble(config, store(parameter_folder(config)))


def check_devices(config: Config) -> None:
    """Raise UserError if one device has two names.

    Two ESCs may have the same port, or the CAN adapter may have the port of an ESC.
    """
    problems = []
    ports: dict[str, str] = {}
    for esc in config.esc:
        real = os.path.realpath(esc.port)
        other = ports.setdefault(real, esc.name)
        if other != esc.name:
            problems.append(
                f"{config.file}: the ports of {other} and {esc.name} are one device, {real}"
            )
    channel = os.path.realpath(config.can.channel.partition("@")[0])
    if "/" in config.can.channel and channel in ports:
        problems.append(
            f"{config.file}: can.channel {config.can.channel} is the port of {ports[channel]}: nothing may be sent to an ESC."
        )
    if problems:
        raise UserError(*problems)


def _outputs(
    config: Config, problems: list[str], taken: dict[int, str], bits: dict[str, float]
) -> tuple[OutputSetup, ...]:
    """Return the setups of the enabled outputs of ``OUTPUTS``.

    Adds mistakes in their tables to ``problems``, their CAN ids to ``taken``, and the bits per
    second that they need to ``bits``.
    """
    found = []
    for name in OUTPUTS:
        table = getattr(config, name)
        if not table.enabled:
            continue
        major, minor, *_ = map(int, re.findall(r"\d+", __version__))
        seed = int.from_bytes(os.urandom(8), "big")
        given = Given(table, identity_digest(), (major, minor), seed)
        try:
            setup = setup_of(name, given, config.escs)
        except UserError as error:
            problems += [f"{config.file}: {problem}" for problem in error.problems]
            continue
        taken |= setup.taken_ids()
        bits[setup.title] = setup.traffic()[1]
        found.append(setup)
    return tuple(found)


def _load_warning(
    config: Config, layout: Layout, bits: Mapping[str, float], worst: Mapping[str, float]
) -> str | None:
    """Return a warning of the bus load. ``worst`` has the outputs whose worst load differs."""
    can = config.can
    return check_load(layout, can.bitrate, can.data_bitrate, bits, {**bits, **worst})


@dataclass
class _NodesRead:
    """CANopen nodes before their stored parameters are checked."""

    plain: "CanopenSetup"
    """The nodes without stored parameters."""
    stored: "list[Stored]"
    damaged: list[tuple[int, str]]
    warnings: list[str]


def _read_nodes(
    config: Config,
    store: "ParameterStore | None",
    problems: list[str],
    taken: dict[int, str],
    bits: dict[str, float],
    worst: dict[str, float],
) -> _NodesRead | None:
    """Read EDS and stored parameters of the CANopen nodes. None without nodes or with problems.

    Adds mistakes, COB-IDs and bits per second as ``_outputs`` does. ``worst`` has the worst load.
    """
    if not config.canopen.enabled:
        return None
    # Imported only here, so that a start without nodes stays short.
    from kontronik_can_gw.assembly import canopen_nodes

    with collecting(problems):
        plain = canopen_nodes.plain_setup(config)
        escs = plain.esc_settings(config.escs)
        cob_ids, bits[_NODES], worst[_NODES] = canopen_nodes.needs(plain, escs)
        taken |= cob_ids
    if problems:
        return None
    stored, damaged, warnings = canopen_nodes.read_stored(config, store)
    return _NodesRead(plain, stored, damaged, warnings)


def _apply_stored(
    config: Config,
    read: _NodesRead,
    layout: Layout,
    escs: list[EscSettings],
    bits: dict[str, float],
    worst: dict[str, float],
) -> tuple["CanopenSetup", list[str]]:
    """Return the nodes with the stored parameters that fit, and all warnings about these.

    Updates the usual and the worst bits per second that the nodes need.
    """
    from kontronik_can_gw.assembly import canopen_nodes

    foreign = {each.can_id: each.name for each in layout.messages if not each.extended}
    setup, warnings = canopen_nodes.with_stored(read.plain, read.stored, config, escs, foreign)
    if setup.stored != read.plain.stored:
        _, bits[_NODES], worst[_NODES] = canopen_nodes.needs(setup, escs)
    return setup, [*warnings, *read.warnings]


@dataclass
class _DbcRead:
    """The DBC in use. The defaults are used without a DBC output."""

    content: bytes = b""
    database: "Database | None" = None
    layout: Layout = field(default_factory=lambda: Layout("", "", ()))
    warnings: list[str] = field(default_factory=list)


def _compile_dbc(
    config: Config, escs: list[EscSettings], problems: list[str], taken: dict[int, str]
) -> _DbcRead:
    """Read and compile the DBC. Adds mistakes in it to ``problems``."""
    read = _DbcRead()
    if config.dbc.enabled:
        file = str(config.dbc_path)
        with collecting(problems):
            read.content = read_dbc(config.dbc_path)
            read.database = parse_database(read.content, file, read.warnings)
            read.layout = prepare(read.database, file, escs, config.dbc, config.can.fd, taken)
    return read


def assemble(config: Config, store: "ParameterStore | None" = None) -> Loaded:
    """Make the objects of a configuration.

    Raises UserError with every mistake in configuration, DBC and EDS. Stored parameters that do not
    fit them are ignored with a warning. Without a store, their files are read and not changed.
    """
    problems: list[str] = []
    taken: dict[int, str] = {}
    bits: dict[str, float] = {}
    worst: dict[str, float] = {}
    with collecting(problems):
        check_devices(config)
    nodes = _read_nodes(config, store, problems, taken, bits, worst)
    escs = config.escs
    if nodes is not None:
        escs = replace(nodes.plain, stored=tuple(nodes.stored)).esc_settings(config.escs)
    outputs = _outputs(config, problems, taken, bits)
    dbc = _compile_dbc(config, escs, problems, taken)
    if problems:
        raise UserError(*problems)
    load_warning = _load_warning(config, dbc.layout, bits, worst)
    canopen = None
    warnings: list[str] = []
    if nodes is not None:
        canopen, warnings = _apply_stored(config, nodes, dbc.layout, escs, bits, worst)
        # Stored parameters that overload the bus do not prevent a start.
        with collecting(warnings):
            load_warning = _load_warning(config, dbc.layout, bits, worst)
    for output in outputs:
        warnings += [f"{config.file}: {text}" for text in output.warnings(config.can.bitrate)]
    mute = [*unreported(dbc.layout, config.dbc.silent_on_loss), *unsupplied(dbc.layout, escs)]
    load_warnings = [] if load_warning is None else [load_warning]
    return Loaded(
        config=config,
        escs=escs,
        database=dbc.database,
        layout=dbc.layout,
        canopen=canopen,
        damaged=() if nodes is None else tuple(nodes.damaged),
        store=store,
        warnings=(*config.warnings, *dbc.warnings, *mute, *load_warnings, *warnings),
        dbc=dbc.content,
        outputs=outputs,
    )
