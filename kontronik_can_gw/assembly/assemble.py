"""Loads a configuration and the files that it names: DBC, EDS, stored parameters.

All mistakes are reported at once.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from kontronik_can_gw.assembly.this_machine import ThisMachine, parameter_folder
from kontronik_can_gw.config.keys import Config, EscConfig
from kontronik_can_gw.config.parse import examine
from kontronik_can_gw.core.output_setup import OUTPUTS, HostMachine, OutputSetup, setup_module
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.dbc.prepare import (
    check_load,
    prepare,
    unreported,
    unsupplied,
    without_quiet,
)
from kontronik_can_gw.dbc.reader import parse_database, read_dbc
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.runtime.can.open_can import check_interface
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.status import UNCONFIGURED

if TYPE_CHECKING:
    from cantools.database.can import Database

    from kontronik_can_gw.runtime.files.store import ParameterStore


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
        own: set[object] = {normalize(esc.name)}
        own.add(("port", esc.port))
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
    layout: MessageLayout
    damaged: tuple[tuple[int, str], ...]
    """Index of each ESC whose stored parameters cannot be read, and the reason."""
    store: "ParameterStore | None"
    warnings: tuple[str, ...] = ()
    dbc: bytes = b""
    """Content of the DBC file."""
    outputs: tuple[OutputSetup, ...] = ()
    """Setups of the outputs that send other frames than those of the DBC."""

    @property
    def core_settings(self) -> CoreSettings:
        return self.config.core_settings(self.escs, self.layout)


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
                f"{config.file}: the ports of {other} and {esc.name} are the same device, {real}"
            )
    channel = os.path.realpath(config.can.channel.partition("@")[0])
    if "/" in config.can.channel and channel in ports:
        problems.append(
            f"{config.file}: can.channel {config.can.channel} is the port of {ports[channel]}. "
            "Nothing may be sent to an ESC."
        )
    if problems:
        raise UserError(*problems)


def _configured(
    config: Config,
    machine: HostMachine,
    problems: list[str],
) -> list[OutputSetup]:
    """Return the setups of the enabled outputs, without stored parameters.

    Adds mistakes in their tables and files to ``problems``.
    """
    setups = []
    for name in OUTPUTS:
        if getattr(config, name).enabled:
            with collecting(problems):
                setups.append(setup_module(name).configured(config, machine))
    return setups


def _load_warning(
    config: Config,
    layout: MessageLayout,
    setups: Sequence[OutputSetup],
) -> list[str]:
    """Return a warning of the bus load in a list, or an empty list. UserError if it is too high."""
    can = config.can
    usual = {setup.title: setup.traffic()[1] for setup in setups}
    worst = {setup.title: setup.traffic(is_worst=True)[1] for setup in setups}
    warning = check_load(layout, can.bitrate, can.data_bitrate, usual, worst)
    return [] if warning is None else [warning]


@dataclass
class _DbcRead:
    """The DBC in use. The defaults are used without a DBC output."""

    content: bytes = b""
    database: "Database | None" = None
    layout: MessageLayout = field(default_factory=lambda: MessageLayout("", "", ()))
    warnings: list[str] = field(default_factory=list)


def _compile_dbc(
    config: Config,
    escs: list[EscSettings],
    problems: list[str],
    taken: dict[int, str],
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
    with collecting(problems):
        check_devices(config)
    machine = ThisMachine(config, store)
    configured = _configured(config, machine, problems)
    outputs = configured
    if not problems:
        outputs = [setup.with_stored(machine) for setup in configured]
    escs = config.escs
    taken: dict[int, str] = {}
    for with_stored in outputs:
        escs = with_stored.esc_settings(escs)
    for setup in configured:
        taken |= setup.taken_ids()
    dbc = _compile_dbc(config, escs, problems, taken)
    if problems:
        raise UserError(*problems)
    load_warning = _load_warning(config, dbc.layout, configured)
    messages = dbc.layout.messages
    message_ids = {each.can_id: each.name for each in messages if not each.extended}
    outputs = [setup.fitted(message_ids) for setup in outputs]
    warnings: list[str] = []
    if outputs != configured:
        # Stored parameters that overload the bus do not prevent a start.
        with collecting(warnings):
            load_warning = _load_warning(config, dbc.layout, outputs)
    damaged: list[tuple[int, str]] = []
    for fitted in outputs:
        warnings += fitted.warnings(config.file, config.can.bitrate)
        damaged += fitted.faults
    settings = config.core_settings(escs, dbc.layout)
    mute = [*unreported(settings), *unsupplied(settings), *without_quiet(settings)]
    return Loaded(
        config=config,
        escs=escs,
        database=dbc.database,
        layout=dbc.layout,
        damaged=tuple(damaged),
        store=store,
        warnings=(
            *config.warnings,
            *dbc.warnings,
            *mute,
            *load_warning,
            *warnings,
        ),
        dbc=dbc.content,
        outputs=tuple(outputs),
    )
