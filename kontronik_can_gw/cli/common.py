"""What several commands share: from a configuration to a checked layout, and talk on standard error."""

import io
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from kontronik_can_gw.canopen.check import without_objects
from kontronik_can_gw.canopen.lss import UNCONFIGURED
from kontronik_can_gw.canopen.nodes import CanopenSetup
from kontronik_can_gw.cli import say as say
from kontronik_can_gw.cli import show as show
from kontronik_can_gw.config.keys import Config, EscConfig, examine
from kontronik_can_gw.config.nodes import (
    load_of_stored,
    parameter_folder,
    plain_setup,
    read_stored,
    with_stored,
)
from kontronik_can_gw.dbc.loss import unreported
from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.dbc.prepare import check_load, prepare
from kontronik_can_gw.dbc.reader import parse_database, read_dbc
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.printable import printable
from kontronik_can_gw.runtime.can_port import check_interface
from kontronik_can_gw.runtime.store import ParameterStore
from kontronik_can_gw.signals.plan import Layout

if TYPE_CHECKING:
    from cantools.database.can import Database

log = logging.getLogger("kontronik_can_gw")


@contextmanager
def collecting(problems: list[str]) -> Iterator[None]:
    """Mistakes of people are added to ``problems``; what failed outside goes on as it is."""
    try:
        yield
    except RunError:
        raise
    except UserError as error:
        problems += error.problems


def told_apart(config: Config) -> Config:
    """Without the ESCs whose name, port or node-ID is that of another one or none at all, so that the rest can be looked at."""
    kept: list[EscConfig] = []
    seen: set[object] = set()
    for esc, node_id in zip(config.esc, config.node_ids, strict=True):
        own = {normalize(esc.name), ("port", esc.port), *({node_id} - {UNCONFIGURED})}
        if not own & seen and (node_id <= 127 or node_id == UNCONFIGURED):
            kept.append(replace(esc, node_id=node_id))
            seen |= own
    return replace(config, esc=tuple(kept))


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
    warnings: tuple[str, ...] = ()
    dbc: bytes = b""
    """The DBC file as it was read."""


def load_all(path: Path, store: Callable[[Path], ParameterStore] | None = None) -> Loaded:
    """Everything that a configuration means. UserError with every mistake; warnings are said.

    ``store`` makes the store of what masters stored, for the one who runs; None: it is only looked at.
    """
    config, problems = examine(path)
    if config is None:
        raise UserError(*problems)
    with collecting(problems):
        check_interface(config.can)
    if problems:
        with collecting(problems):
            assemble(told_apart(config))
        raise UserError(*problems)
    loaded = assemble(config, store(parameter_folder(config)) if store and config.canopen.enabled else None)
    for warning in (*loaded.layout.warnings, *loaded.warnings):
        say(f"warning: {warning}")
    return loaded


def check_devices(config: Config) -> None:
    """What leads to one device by two names: two ESCs on one port, or the CAN adapter on an ESC's. UserError with each."""
    problems = []
    ports: dict[str, str] = {}
    for esc in config.esc:
        real = os.path.realpath(esc.port)
        if (other := ports.setdefault(real, esc.name)) != esc.name:
            problems.append(f"{config.file}: the ports of {other} and {esc.name} are one device, {real}")
    channel = os.path.realpath(config.can.channel.partition("@")[0])
    if "/" in config.can.channel and channel in ports:
        problems.append(
            f"{config.file}: can.channel {config.can.channel} is the port of {ports[channel]}: nothing may be sent to an ESC."
        )
    if problems:
        raise UserError(*problems)


def assemble(config: Config, store: ParameterStore | None = None) -> Loaded:
    """What belongs to a configuration. Without a store its files are only looked at.

    Configuration, DBC and EDS may be refused here. What masters stored may not: it gives way, with a warning, where it does not fit them.
    """
    problems: list[str] = []
    with collecting(problems):
        check_devices(config)
    escs, plain, kept = config.escs, None, None
    ignored: list[str] = []
    taken: dict[int, str] = {}
    bits = 0.0
    if config.canopen.enabled:
        with collecting(problems):
            plain = plain_setup(config)
            nodes = plain.nodes(plain.esc_settings(config.escs))
            taken, bits = nodes.cob_ids(), nodes.bits_per_second()
            ignored += [f"{plain.eds.name}: {line}" for line in without_objects(nodes)]
        if plain is not None and not problems:
            kept = read_stored(config, store)
            escs = replace(plain, stored=tuple(kept.stored)).esc_settings(config.escs)
    database, layout, dbc = None, Layout("", "", ()), b""
    if config.dbc.enabled:
        file = str(config.dbc_path)
        with collecting(problems):
            dbc = read_dbc(config.dbc_path)
            found = parse_database(dbc, file, ignored)
            database, layout = prepare(found, file, escs, config.dbc_settings, config.can.fd, taken)
    if problems:
        raise UserError(*problems)
    bitrate, data_bitrate = config.can.bitrate, config.can.data_bitrate
    warnings = [check_load(layout, bitrate, data_bitrate, bits)]
    canopen = None
    if plain is not None and kept is not None:
        foreign = {message.can_id: message.name for message in layout.messages if not message.extended}
        canopen, given_way = with_stored(plain, kept.stored, config, escs, foreign)
        if canopen is not plain:
            bits = canopen.nodes(escs).bits_per_second()
        warnings += [*given_way, *kept.warnings, *load_of_stored(warnings[0], layout, bitrate, data_bitrate, bits)]
    damaged = () if kept is None else tuple(kept.damaged)
    mute = unreported(layout, config.dbc.on_loss == "silent")
    said = tuple(warning for warning in (*config.warnings, *ignored, *mute, *warnings) if warning)
    return Loaded(config, escs, database, layout, canopen, damaged, store, said, dbc)


@contextmanager
def logging_to_stderr() -> Iterator[None]:
    """Log lines to standard error, by a thread; under systemd without time, with the priorities that journald reads."""
    from kontronik_can_gw.runtime.log_writer import BackgroundHandler
    from kontronik_can_gw.runtime.systemd import log_formatter

    handler = BackgroundHandler(sys.stderr)
    handler.setFormatter(log_formatter(sys.stderr) or logging.Formatter("%(asctime)s %(levelname)-7s %(message)s"))
    # what python-can says is said again by us, with the remedy
    logging.getLogger("can").addHandler(logging.NullHandler())
    logger = logging.getLogger("kontronik_can_gw")
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        handler.close()


@contextmanager
def stopping_on_signals(stop: Callable[[], None], is_service: bool = False) -> Iterator[None]:
    """SIGTERM and SIGINT call ``stop``, once more end the process at once. SIGHUP ends a service only if its terminal has gone."""
    has_terminal = _has_terminal() and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN  # ignored: as by nohup

    def end(_number: int, _frame: object) -> None:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, signal.SIG_DFL)
        stop()

    def hang_up(_number: int, _frame: object) -> None:
        if has_terminal and not _has_terminal():
            log.warning("the terminal was closed: ending (nohup, setsid or a service goes on)")
            stop()
        else:
            log.warning("SIGHUP is ignored: the configuration is read at the start only. Restart for another one.")

    handlers = {signal.SIGTERM: end, signal.SIGINT: end}
    if is_service:
        handlers[signal.SIGHUP] = hang_up
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def _has_terminal() -> bool:
    """True where the process has a controlling terminal that is still there."""
    try:
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC))
    except OSError:
        return False
    return True


def canopen_of(loaded: Loaded) -> CanopenSetup:
    """The nodes of a configuration. UserError where it has none."""
    if loaded.canopen is None:
        raise UserError(f"{loaded.config.file}: canopen.enabled is false: there are no CANopen nodes. Set it to true.")
    return loaded.canopen


def write_output(where: str, text: str, encoding: str) -> None:
    """Text to a file, which is then told, or for ``-`` to standard output; line ends as they are. RunError where it cannot be written."""
    if where == "-" and sys.stdout.isatty():
        text = printable(text, keep="\r\n\t")
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
