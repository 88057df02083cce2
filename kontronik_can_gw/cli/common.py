"""What several commands share: from a configuration to a checked layout, and talk on standard error."""

import io
import logging
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from kontronik_can_gw import __version__
from kontronik_can_gw.cia301.check import check_eds
from kontronik_can_gw.cia301.eds import Eds, without
from kontronik_can_gw.cia301.eds import load as eds_of
from kontronik_can_gw.cia301.node import NodeSettings
from kontronik_can_gw.cia301.nodes import CanopenSetup, Nodes
from kontronik_can_gw.cia301.storage import Stored, decode
from kontronik_can_gw.config import UNCONFIGURED, Config, load, shipped
from kontronik_can_gw.dbc_output.layout import Layout, load_database
from kontronik_can_gw.dbc_output.prepare import check_load, prepare
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.protocol.states import Device
from kontronik_can_gw.runtime.can_port import check_interface
from kontronik_can_gw.runtime.machine import machine_identity, serial_number, state_folder
from kontronik_can_gw.runtime.store import ParameterStore
from kontronik_can_gw.telemetry import EscSettings

if TYPE_CHECKING:
    from cantools.database.can import Database


_FRAME_BITS = 135
"""Of a CAN frame with 8 data bytes, with the most stuffing; block uploads take every second place on the bus."""


def say(text: str) -> None:
    """One line of talk."""
    print(f"kontronik-can-gw: {text}", file=sys.stderr)


@dataclass(frozen=True)
class Loaded:
    """A checked configuration and what belongs to it. ``database`` None: no DBC output; ``canopen`` None: no nodes."""

    config: Config
    escs: list[EscSettings]
    """As they hold: with what masters stored worked in."""
    database: "Database | None"
    layout: Layout
    canopen: CanopenSetup | None
    damaged: tuple[tuple[int, str], ...]
    """ESCs whose stored parameters cannot be read, and why."""
    store: ParameterStore | None


def load_all(path: Path, store: Callable[[Path], ParameterStore] | None = None) -> Loaded:
    """Everything that a configuration means. UserError with every mistake; warnings are said.

    ``store`` makes the store of what masters stored, for the one who runs; None: it is only looked at.
    """
    config = load(path)
    check_interface(config.can)
    loaded = assemble(config, store(parameter_folder(config)) if store and config.canopen.enabled else None)
    nodes = loaded.canopen.nodes(loaded.escs).bits_per_second() if loaded.canopen else 0
    load_warning = check_load(loaded.layout, config.can.bitrate, config.can.data_bitrate, nodes)
    unread = (
        [] if store else [f"{loaded.escs[esc].name}: stored parameters: {reason}" for esc, reason in loaded.damaged]
    )
    for warning in (*loaded.layout.warnings, load_warning, *unread):
        if warning:
            say(f"warning: {warning}")
    return loaded


def assemble(config: Config, store: ParameterStore | None = None) -> Loaded:
    """What belongs to a configuration. Without a store its files are only looked at."""
    escs = config.escs
    canopen: CanopenSetup | None = None
    damaged: list[tuple[int, str]] = []
    taken: dict[int, str] = {}
    if config.canopen.enabled:
        canopen, damaged = _canopen(config, store)
        escs = canopen.esc_settings(escs)
        nodes = canopen.nodes(escs)
        _check_cob_ids(nodes, canopen.eds.name)
        taken = nodes.cob_ids()
    if not config.dbc.enabled:
        return Loaded(config, escs, None, Layout("", "", ()), canopen, tuple(damaged), store)
    file = config.dbc_path
    database, layout = prepare(load_database(file), str(file), escs, config.dbc_settings, config.can.fd, taken)
    return Loaded(config, escs, database, layout, canopen, tuple(damaged), store)


def _check_cob_ids(nodes: Nodes, eds: str) -> None:
    """Two nodes, or two services, with one COB-ID: as where an EDS gives EMCY or a PDO an id without $NODEID."""
    problems: list[str] = []
    users: dict[int, str] = {}
    for node in nodes.nodes:
        for cob_id, what in node.cob_ids():
            if users.setdefault(cob_id, what) != what:
                problems.append(
                    f"{eds}: COB-ID {cob_id:03X}h is that of {users[cob_id]} and of {what}. Change one default (or add $NODEID)."
                )
    if problems:
        raise UserError(*problems)


def load_eds(config: Config) -> Eds:
    """The EDS in use, checked."""
    path = config.eds_path
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}. canopen.eds names the EDS file.") from None
    eds = eds_of(data, str(path))
    if not config.canopen.cia402_mirrors:
        eds = eds_of(without(data, range(0x6000, 0x6800)), str(path))
    check_eds(eds, config.escs[0], [node_id for node_id in config.node_ids if node_id != UNCONFIGURED])
    return eds


def parameter_folder(config: Config) -> Path:
    """Where masters' parameters are kept."""
    if config.canopen.store is None:
        return state_folder()
    return Path(config.file).parent / config.canopen.store


def _canopen(config: Config, store: ParameterStore | None) -> tuple[CanopenSetup, list[tuple[int, str]]]:
    canopen = config.canopen
    eds = load_eds(config)
    identity = machine_identity()
    if not identity and canopen.serial is None:
        say(
            "warning: this machine has no id, so serial numbers (1018h:4) are 0 and LSS cannot tell nodes apart: set canopen.serial"
        )
    settings: list[NodeSettings] = []
    kept: list[Stored] = []
    damaged: list[tuple[int, str]] = []
    for number, (esc, node_id) in enumerate(zip(config.esc, config.node_ids, strict=True)):
        serial = (
            serial_number(number + 1, esc.name, identity)
            if canopen.serial is None
            else canopen.serial + number & 0xFFFFFFFF
        )
        settings.append(
            NodeSettings(
                node_id,
                serial,
                canopen.vendor_id,
                canopen.self_start,
                canopen.read_only,
                config.can.bitrate,
                segment_ns=2 * _FRAME_BITS * 1_000_000_000 // config.can.bitrate,
                version=__version__,
                device=next((device for device in Device if device.text == esc.device), None),
            )
        )
        if store is None:
            found, reason = _look_at(parameter_folder(config) / f"{esc.name}.params")
        else:
            store.claim(esc.name)
            found, reason = store.load(esc.name)
        kept.append(found)
        if reason is not None:
            damaged.append((number, reason))
    _forget_clashing_ids(config, settings, kept)
    return CanopenSetup(eds, tuple(settings), tuple(kept), tuple(config.escs)), damaged


def _look_at(path: Path) -> tuple[Stored, str | None]:
    """What a node stored, and why that cannot be read; nothing is changed."""
    try:
        return decode(path.read_bytes()), None
    except FileNotFoundError:
        return Stored(), None
    except (OSError, ValueError) as error:
        return Stored(), f"{path}: {error}"


def _forget_clashing_ids(config: Config, settings: list[NodeSettings], kept: list[Stored]) -> None:
    """A node-ID that was stored over the bus and has become another's by a changed configuration gives way."""
    taken: dict[int, str] = {}
    for number, (esc, own, stored) in enumerate(zip(config.esc, settings, kept, strict=True)):
        node_id = own.node_id if stored.node_id is None else stored.node_id
        if node_id in taken and stored.node_id is not None and own.node_id not in taken:
            say(f"warning: {esc.name}: the stored node-ID {node_id} is that of {taken[node_id]}; taking {own.node_id}")
            kept[number] = replace(stored, node_id=None)
            node_id = own.node_id
        elif node_id in taken:
            raise UserError(
                f"{config.file}: {esc.name}: node-ID {node_id} is that of {taken[node_id]}, which a master stored. "
                f"Choose another node_id, or remove what is stored: {parameter_folder(config)}."
            )
        if node_id != UNCONFIGURED:
            taken[node_id] = esc.name


def set_up_log(verbose: bool = False) -> None:
    """Log lines to standard error; under systemd without time, with the priorities that journald reads."""
    import os

    handler = logging.StreamHandler()
    if "JOURNAL_STREAM" in os.environ:
        handler.setFormatter(_JournalFormatter("%(message)s"))
    else:
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)-7s %(message)s"))
    logging.getLogger("can").addHandler(
        logging.NullHandler()
    )  # what python-can says is said again by us, with the remedy
    logger = logging.getLogger("kontronik_can_gw")
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG if verbose else logging.INFO)


class _JournalFormatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        level = 3 if record.levelno >= logging.ERROR else 4 if record.levelno >= logging.WARNING else 6
        return f"<{level}>{super().format(record)}"


@contextmanager
def stopping_on_signals(stop: Callable[[], None]) -> Iterator[None]:
    """SIGTERM and SIGINT call ``stop``, once more end the process at once."""

    def handler(_number: int, _frame: object) -> None:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)
        stop()

    numbers = (signal.SIGTERM, signal.SIGINT)
    before = [signal.signal(number, handler) for number in numbers]
    try:
        yield
    finally:
        for number, old in zip(numbers, before, strict=True):
            signal.signal(number, old)


def canopen_of(loaded: Loaded) -> CanopenSetup:
    """The nodes of a configuration. UserError where it has none."""
    if loaded.canopen is None:
        raise UserError(f"{loaded.config.file}: canopen.enabled is false: there are no CANopen nodes. Set it to true.")
    return loaded.canopen


def shipped_canopen(node_ids: Iterable[int]) -> CanopenSetup:
    """Nodes by the shipped EDS, as they are without a configuration."""
    file = shipped("eds/kontronik_esc.eds")
    settings = tuple(NodeSettings(node_id, version=__version__) for node_id in node_ids)
    return CanopenSetup(eds_of(file.read_bytes(), str(file)), settings, (Stored(),) * len(settings))


def write_output(where: str, text: str, encoding: str) -> None:
    """Text to a file, which is then told, or for ``-`` to standard output; line ends as they are. RunError where it cannot be written."""
    data = text.encode(encoding)
    if where != "-":
        write_file(Path(where), data)
        say(f"{where} written")
    elif isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.buffer.write(data)
    else:
        sys.stdout.write(text)


def write_file(path: Path, data: bytes) -> None:
    """All or nothing: a reader never sees half a file. What is no plain file (a pipe, /dev/stdout) is written to, not replaced."""
    import tempfile

    beside: Path | None = None
    try:
        target = path.resolve()
        if target.exists() and not target.is_file():
            target.write_bytes(data)
            return
        with tempfile.NamedTemporaryFile(dir=target.parent, prefix=f".{path.name}.", delete=False) as file:
            beside = Path(file.name)
            file.write(data)
        beside.chmod(0o644)
        beside.replace(target)
        beside = None
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {error.strerror}. Give another -o.") from None
    finally:
        if beside is not None:
            beside.unlink(missing_ok=True)
