"""Loads a configuration and the files that it names: DBC, EDS, stored parameters.

All mistakes are reported at once.
"""

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from kontronik_can_gw import __version__
from kontronik_can_gw.config.keys import Config, EscConfig
from kontronik_can_gw.config.parse import examine
from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.dbc.prepare import check_load, prepare, unreported, unsupplied
from kontronik_can_gw.dbc.reader import parse_database, read_dbc
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.node_state import UNCONFIGURED
from kontronik_can_gw.output import OUTPUTS, Given, OutputSetup, setup_of
from kontronik_can_gw.runtime.machine import identity_digest
from kontronik_can_gw.runtime.open_can import check_interface
from kontronik_can_gw.signals.plan import Layout

if TYPE_CHECKING:
    from cantools.database.can import Database

    from kontronik_can_gw.canopen.nodes import CanopenSetup
    from kontronik_can_gw.canopen.storage import Stored
    from kontronik_can_gw.runtime.store import ParameterStore


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
    from kontronik_can_gw.config.nodes import parameter_folder

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
    """A warning of the bus load. ``worst`` has the outputs whose worst load is another one."""
    can = config.can
    return check_load(layout, can.bitrate, can.data_bitrate, bits, {**bits, **worst})


def _output_warnings(config: Config, outputs: Sequence[OutputSetup]) -> list[str]:
    bitrate = config.can.bitrate
    return [f"{config.file}: {text}" for each in outputs for text in each.warnings(bitrate)]


def assemble(config: Config, store: "ParameterStore | None" = None) -> Loaded:
    """Make the objects of a configuration.

    Raises UserError with every mistake in configuration, DBC and EDS. Stored parameters that do not
    fit them are ignored with a warning. Without a store, their files are read and not changed.
    """
    problems: list[str] = []
    with collecting(problems):
        check_devices(config)
    escs = config.escs
    plain = None
    canopen = None
    stored: list[Stored] = []
    damaged: list[tuple[int, str]] = []
    ignored: list[str] = []
    warnings: list[str] = []
    taken: dict[int, str] = {}
    bits: dict[str, float] = {}
    worst: dict[str, float] = {}
    if config.canopen.enabled:
        from kontronik_can_gw.config import nodes  # only here: a start without nodes stays short

        with collecting(problems):
            plain = nodes.plain_setup(config)
            of_nodes = plain.esc_settings(config.escs)
            taken, bits[_NODES], worst[_NODES] = nodes.needs(plain, of_nodes)
        if plain is not None and not problems:
            stored, damaged, warnings = nodes.read_stored(config, store)
            escs = replace(plain, stored=tuple(stored)).esc_settings(config.escs)
    outputs = _outputs(config, problems, taken, bits)
    database = None
    layout = Layout("", "", ())
    dbc = b""
    if config.dbc.enabled:
        file = str(config.dbc_path)
        with collecting(problems):
            dbc = read_dbc(config.dbc_path)
            database = parse_database(dbc, file, ignored)
            layout = prepare(database, file, escs, config.dbc, config.can.fd, taken)
    if problems:
        raise UserError(*problems)
    load_warning = _load_warning(config, layout, bits, worst)
    if plain is not None:
        foreign = {each.can_id: each.name for each in layout.messages if not each.extended}
        canopen, ignored_ids = nodes.with_stored(plain, stored, config, escs, foreign)
        warnings = [*ignored_ids, *warnings]
        if canopen.stored != plain.stored:
            _, bits[_NODES], worst[_NODES] = nodes.needs(canopen, escs)
            # Stored parameters that overload the bus do not prevent a start.
            with collecting(warnings):
                load_warning = _load_warning(config, layout, bits, worst)
    warnings += _output_warnings(config, outputs)
    all_warnings = [*config.warnings, *ignored]
    all_warnings += unreported(layout, config.dbc.silent_on_loss)
    all_warnings += unsupplied(layout, escs)
    if load_warning:
        all_warnings.append(load_warning)
    all_warnings += warnings
    return Loaded(
        config=config,
        escs=escs,
        database=database,
        layout=layout,
        canopen=canopen,
        damaged=tuple(damaged),
        store=store,
        warnings=tuple(all_warnings),
        dbc=dbc,
        outputs=outputs,
    )
