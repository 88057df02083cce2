"""``run``: runs the gateway."""

import argparse
import gc
import logging
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from kontronik_can_gw.assembly.assemble import Loaded
from kontronik_can_gw.cli.arguments import CONFIG, config_file, option
from kontronik_can_gw.cli.common import load_all, logging_to_stderr, stopping_on_signals
from kontronik_can_gw.errors import RunError, UserError

if TYPE_CHECKING:
    from kontronik_can_gw.gateway.gateway import Gateway
    from kontronik_can_gw.runtime.files.recorder import Recorder
    from kontronik_can_gw.runtime.files.store import ParameterStore
    from kontronik_can_gw.runtime.loop import Loop
    from kontronik_can_gw.runtime.system.sd_notify import Notifier

log = logging.getLogger("kontronik_can_gw")

_NEVER = (1 << 31) - 1
"""Threshold of the garbage collector that is never reached."""
_LOCK_SWITCH_S = 0.0005
"""The interpreter's switch interval: the longest time that the loop waits for another thread."""
_PAUSE_S = 5
"""Pause before the exit of a service that cannot start. A signal ends the pause."""


def _folder(text: str) -> Path:
    if not text.strip():
        raise argparse.ArgumentTypeError("is empty. Give a folder")
    return Path(text)


OPTIONS = (
    CONFIG,
    option("--wait", "at start, wait for missing ports and interfaces (run.wait_for_devices)"),
    option(
        "--record DIR",
        "record all input as captures in this folder (record.directory)",
        type=_folder,
    ),
)
EPILOG = (
    "SIGTERM, SIGINT and SIGHUP end it within half a second. "
    "SIGUSR1 records the time around it, if record.on_event is set. "
    "It reads the configuration only at the start. It only "
    "reads from the serial ports and never transmits to an ESC."
)


def main(args: argparse.Namespace) -> int:
    from kontronik_can_gw.runtime.system.sd_notify import Notifier

    notifier = Notifier()
    refused: UserError | None = None
    with logging_to_stderr():
        try:
            _Run(args, notifier).main()
        except UserError as error:
            if not notifier.is_present:
                raise
            refused = error
            for problem in error.problems:
                log.error("%s", problem)
    if refused is None:
        return 0
    # delays the restart by the service manager, because only the user can correct the mistake
    notifier.status(f"cannot start: {refused.problems[0]}")
    time.sleep(_PAUSE_S)
    return refused.exit_code


class _StoppedAtStart(BaseException):
    """Ends the reading of files, which may wait forever, for example for a pipe."""


class _Run:
    """One run of the gateway, from its configuration to its end."""

    def __init__(self, args: argparse.Namespace, notifier: "Notifier") -> None:
        self._args = args
        self._notifier = notifier
        self._loop: Loop | None = None
        self._signals: list[str] = []
        """Name of the signal that ends the run."""
        self._is_stopping = False
        self._is_reading = False
        """Whether files are being read, and nothing is open that must be closed in order."""
        self._recorder: Recorder | None = None

    def main(self) -> None:
        """Run until a signal ends the gateway."""
        sys.setswitchinterval(_LOCK_SWITCH_S)
        with (
            self._marking_on_signal(),
            suppress(_StoppedAtStart),
            stopping_on_signals(self._stop) as self._signals,
        ):
            loop = self._opened()
            self._loop = loop
            if self._is_stopping:  # a signal was received before the loop existed
                loop.stop(self._reason())
            settle_memory()
            loop.run()

    @contextmanager
    def _marking_on_signal(self) -> Iterator[None]:
        """Let SIGUSR1 mark an event. Without ``record.on_event`` it has no effect.

        It is ignored before (see __main__.py) and afterwards, until the process has ended.
        """

        def mark(_number: int, _frame: object) -> None:
            if self._recorder is not None:
                self._recorder.mark()

        signal.signal(signal.SIGUSR1, mark)
        try:
            yield
        finally:
            signal.signal(signal.SIGUSR1, signal.SIG_IGN)

    def _stop(self) -> None:
        self._is_stopping = True
        self._notifier.stopping()
        if self._loop is not None:
            self._loop.stop(self._reason())
        if self._is_reading:
            raise _StoppedAtStart

    def _reason(self) -> str:
        """Return the reason why the gateway ends."""
        name = self._signals[0] if self._signals else "a signal"
        return f"stopped by {name}"

    def _opened(self) -> "Loop":
        """Return the loop with its ports and the CAN interface open."""
        from kontronik_can_gw.native.load import in_words
        from kontronik_can_gw.runtime.loop import Loop
        from kontronik_can_gw.runtime.native_poller import poller_for
        from kontronik_can_gw.runtime.status.facts import program_facts
        from kontronik_can_gw.runtime.status.statistics import open_statistics
        from kontronik_can_gw.runtime.system.clock import ClockWatch

        self._is_reading = True
        path = config_file(self._args.config)
        program = program_facts(path)
        # the objects of cantools are not needed any more, so the core can use their memory
        loaded = replace(load_all(path, _parameter_store), database=None)
        if loaded.outputs:
            gc.collect()  # frees the nodes that were built only for the check
        self._is_reading = False
        config = loaded.config
        wait = self._args.wait or config.run.wait_for_devices
        _begin_realtime(config.run.realtime_priority, wait)
        gateway, recorder = self._gateway(loaded)
        self._recorder = recorder
        # They are logged after the start. If the start fails, its error is more important.
        warnings: list[str] = []
        try:
            statistics = open_statistics(config.statistics_path, path, warnings.append)
        except UserError:
            if loaded.store is not None:
                loaded.store.close(0)
            raise
        loop = Loop(
            gateway,
            [esc.port for esc in config.esc],
            config.can,
            wait,
            loaded.store,
            notifier=self._notifier,
            statistics=statistics,
            program=program,
            recorder=recorder,
            poller=poller_for(gateway),
        )
        loop.follow_clock(ClockWatch())
        # reported before the ports are opened, because a damaged file was already renamed
        for esc, reason in loaded.damaged:
            name = loaded.escs[esc].name
            log.error("%s: stored parameters: %s. Using defaults.", name, reason)
        loop.open()
        for warning in warnings:
            log.warning("%s", warning)
        log.info("%s", in_words(gateway.core.language, gateway.core.note))
        for esc, _ in loaded.damaged:
            gateway.parameters_damaged(esc, time.monotonic_ns())
        return loop

    def _gateway(self, loaded: Loaded) -> "tuple[Gateway, Recorder | None]":
        """Return the gateway and its recorder.

        Without a recorder, the modules that only a recorder needs are not imported.
        """
        config = loaded.config
        now = time.monotonic_ns()
        if self._args.record is not None or config.record.directory is not None:
            from kontronik_can_gw.cli.recording import recorded

            return recorded(loaded, self._args.record, now)
        from kontronik_can_gw.gateway.gateway import Gateway

        gateway = Gateway(loaded.core_settings, now, loaded.outputs)
        return gateway, None


def _begin_realtime(priority: int | None, wait: bool) -> None:
    """Set the real-time priority.

    Raises RunError if it is not granted. If ``wait``, the gateway runs without it instead.
    """
    from kontronik_can_gw.runtime.system import realtime

    if priority is None:
        return
    try:
        realtime.begin(priority)
    except RunError as error:
        if not wait:
            raise
        log.error("%s Running without it.", error)  # late frames are better than no frames


def _parameter_store(folder: Path) -> "ParameterStore":
    from kontronik_can_gw.runtime.files.store import ParameterStore  # not loaded without CANopen

    return ParameterStore(folder)


def settle_memory() -> None:
    """Free memory that only the start needed, and freeze all present objects.

    Garbage collections never scan frozen objects again. The hot path makes no reference cycles
    (tests/runtime/test_garbage.py), so later collections scan only the young generations. Full
    collections also free the memory that the interpreter keeps of freed objects. They run here and
    once a minute (runtime/housekeeping.py).
    """
    from kontronik_can_gw.native.load import give_back

    gc.collect()
    give_back()
    gc.freeze()
    young, middle, _ = gc.get_threshold()
    gc.set_threshold(young, middle, _NEVER)
