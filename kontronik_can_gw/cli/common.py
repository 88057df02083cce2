"""Shared by several commands: the log, signals, and warnings of a configuration on standard error."""

import logging
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from kontronik_can_gw.assembly.assemble import Loaded, load_configuration
from kontronik_can_gw.cli import say as say
from kontronik_can_gw.cli import show as show
from kontronik_can_gw.cli.arguments import default_config
from kontronik_can_gw.config.parse import load
from kontronik_can_gw.errors import UserError

if TYPE_CHECKING:
    from kontronik_can_gw.canopen.setup import CanopenSetup
    from kontronik_can_gw.runtime.files.store import ParameterStore


def load_all(path: Path, store: "Callable[[Path], ParameterStore] | None" = None) -> Loaded:
    """Load a configuration as ``load_configuration`` does, and print its warnings."""
    loaded = load_configuration(path, store)
    for warning in (*loaded.layout.warnings, *loaded.warnings):
        say(f"warning: {warning}")
    return loaded


def announced_config(with_nodes: bool = False) -> Path | None:
    """The configuration to be used where an option might have named one, which a line on standard error says; None: there is none.

    ``with_nodes``: only one with CANopen nodes.
    """
    found = default_config()
    if found is None or (with_nodes and not load(found).canopen.enabled):
        return None
    say(f"by {found}")
    return found


@contextmanager
def logging_to_stderr() -> Iterator[None]:
    """Write log lines to standard error from a thread; under systemd without time, with journald's priorities."""
    from kontronik_can_gw.runtime.system.fault_log import BackgroundHandler
    from kontronik_can_gw.runtime.system.sd_notify import log_formatter

    handler = BackgroundHandler(sys.stderr)
    handler.setFormatter(
        log_formatter(sys.stderr) or logging.Formatter("%(asctime)s %(levelname)-7s %(message)s")
    )
    # faults that python-can logs are logged by the gateway too, with the remedy
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
def stopping_on_signals(stop: Callable[[], None]) -> Iterator[list[str]]:
    """SIGTERM, SIGINT and SIGHUP call ``stop``, a second one ends the process at once. Under nohup SIGHUP stays ignored.

    Yields a list that holds the signal's name once it was received.
    """
    received: list[str] = []
    numbers = [signal.SIGTERM, signal.SIGINT]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)

    def end(received_number: int, _frame: object) -> None:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)
        received.append(signal.Signals(received_number).name)
        stop()

    before = {number: signal.signal(number, end) for number in numbers}
    try:
        yield received
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def canopen_setups(loaded: Loaded) -> "list[CanopenSetup]":
    """Return the CANopen setup of a configuration in a list, which is empty without nodes."""
    from kontronik_can_gw.canopen.setup import CanopenSetup

    return [setup for setup in loaded.outputs if isinstance(setup, CanopenSetup)]


def canopen_of(loaded: Loaded) -> "CanopenSetup":
    """Return the CANopen setup of a configuration. UserError if it has no nodes."""
    setups = canopen_setups(loaded)
    if not setups:
        raise UserError(
            f"{loaded.config.file}: canopen.enabled is false: there are no CANopen nodes. Set it to true."
        )
    return setups[0]
