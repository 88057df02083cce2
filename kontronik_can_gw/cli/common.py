"""Functions of several commands: the log, signals, and warnings about a configuration."""

import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Timer
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

_REPEAT_AFTER_S = 0.01
"""Time until a signal that arrived in a finalizer is sent again."""


def load_all(path: Path, store: "Callable[[Path], ParameterStore] | None" = None) -> Loaded:
    """Load a configuration as ``load_configuration`` does, and print its warnings."""
    loaded = load_configuration(path, store)
    for warning in (*loaded.layout.warnings, *loaded.warnings):
        say(f"warning: {warning}")
    return loaded


def announced_config(with_nodes: bool = False) -> Path | None:
    """Return the default configuration for a command without ``-c``, and print its name.

    None if there is no such configuration. ``with_nodes``: it must have CANopen nodes.
    """
    found = default_config()
    if found is None or (with_nodes and not load(found).canopen.enabled):
        return None
    say(f"using {found}")
    return found


@contextmanager
def logging_to_stderr() -> Iterator[None]:
    """Write log lines to standard error from a thread.

    Under systemd they have the priorities of journald instead of a time.
    """
    from kontronik_can_gw.runtime.system.fault_log import BackgroundHandler
    from kontronik_can_gw.runtime.system.sd_notify import log_formatter

    handler = BackgroundHandler(sys.stderr)
    formatter = log_formatter(sys.stderr)
    if formatter is None:
        formatter = logging.Formatter("%(asctime)s %(levelname)-7s %(message)s")
    handler.setFormatter(formatter)
    # the gateway itself logs the faults that python-can logs, with their remedies
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
    """Call ``stop`` for SIGTERM, SIGINT and SIGHUP. A second signal ends the process at once.

    Under nohup SIGHUP stays ignored. Yields a list that contains the signal's name after a signal
    was received. ``stop`` may raise KeyboardInterrupt. A signal can arrive in a finalizer, for
    which Python only prints exceptions. The signal is then sent again.
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

    def repeat(unraisable: "sys.UnraisableHookArgs") -> None:
        if not (received and isinstance(unraisable.exc_value, KeyboardInterrupt)):
            hook(unraisable)
            return
        for number in numbers:
            signal.signal(number, end)
        number = signal.Signals[received.pop()]
        timers.append(Timer(_REPEAT_AFTER_S, os.kill, (os.getpid(), number)))
        timers[-1].start()

    hook = sys.unraisablehook
    timers: list[Timer] = []
    before = {number: signal.signal(number, end) for number in numbers}
    sys.unraisablehook = repeat
    try:
        yield received
    finally:
        for timer in timers:
            timer.cancel()
        sys.unraisablehook = hook
        for number, old in before.items():
            signal.signal(number, old)


def canopen_setup(loaded: Loaded) -> "CanopenSetup | None":
    """Return the CANopen setup of a configuration. None if it has no nodes."""
    from kontronik_can_gw.canopen.setup import CanopenSetup

    for setup in loaded.outputs:
        if isinstance(setup, CanopenSetup):
            return setup
    return None


def canopen_of(loaded: Loaded) -> "CanopenSetup":
    """Return the CANopen setup of a configuration. Raises UserError if it has no nodes."""
    setup = canopen_setup(loaded)
    if setup is None:
        raise UserError(
            f"{loaded.config.file}: canopen.enabled is false, so there are no CANopen nodes. "
            "Set it to true."
        )
    return setup
