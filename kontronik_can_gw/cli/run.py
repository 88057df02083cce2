"""``run``: the gateway."""

import argparse
import gc
import logging
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from kontronik_can_gw.cli import need_descriptors
from kontronik_can_gw.cli.arguments import number_from
from kontronik_can_gw.cli.common import (
    Loaded,
    assemble,
    fingerprint,
    load_all,
    logging_to_stderr,
    stopping_on_signals,
    with_store,
)
from kontronik_can_gw.cli.node_setup import parameter_folder
from kontronik_can_gw.config import Config, load
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.runtime.can_port import check_interface
from kontronik_can_gw.telemetry import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable

    from kontronik_can_gw.runtime.loop import Loop
    from kontronik_can_gw.runtime.store import ParameterStore
    from kontronik_can_gw.runtime.systemd import Notifier

log = logging.getLogger("kontronik_can_gw")

_NEVER = (1 << 31) - 1
_LOCK_SWITCH_S = 0.0005
"""So long the loop waits for another thread of ours that computes, before it asks for the interpreter."""
_PAUSE_S = 5
"""Before the end of a service that cannot start; a signal ends it at once."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-c", "--config", type=Path, required=True, metavar="FILE", help="TOML configuration")
    parser.add_argument(
        "--wait",
        action="store_true",
        help="wait for ports and interfaces that are missing at start (run.wait_for_devices)",
    )
    parser.add_argument(
        "--status",
        type=number_from(0.1, 1e6),
        metavar="SECONDS",
        help="log a line about telemetry, CAN, NMT states and PDO traffic every so many seconds (default: changes only)",
    )
    parser.add_argument(
        "--record",
        type=_folder,
        metavar="DIR",
        help="write captures of what comes in to this folder (record.directory)",
    )
    parser.epilog = (
        "Ends by SIGTERM or SIGINT within half a second. SIGHUP reads the configuration again: a faulty one is refused and the old "
        "one stays. The serial ports are only read; nothing is ever transmitted to an ESC."
    )


def _folder(text: str) -> Path:
    if not text.strip():
        raise argparse.ArgumentTypeError("is empty. Give a folder")
    return Path(text)


def main(args: argparse.Namespace) -> int:
    from kontronik_can_gw.runtime.systemd import Notifier

    notifier = Notifier()
    refused: UserError | None = None
    with logging_to_stderr():
        try:
            _Run(args, notifier).main()
        except UserError as error:
            if not notifier.present:
                raise
            refused = error
            for problem in error.problems:
                log.error("%s", problem)
    if refused is None:
        return 0
    # the service manager starts us again: not ten times a second, for what a person has to mend
    notifier.status(f"cannot start: {refused.problems[0]}")
    time.sleep(_PAUSE_S)
    return refused.exit_code


class _Run:
    """The gateway, over as many configurations as it is given one after the other."""

    def __init__(self, args: argparse.Namespace, notifier: "Notifier") -> None:
        from kontronik_can_gw.runtime.reload import Reloader
        from kontronik_can_gw.runtime.snapshot import program_facts

        self._file: Path = args.config
        self._wait: bool = args.wait
        self._record: Path | None = args.record
        self._status_ns = int((args.status or 0) * SECOND)
        self._notifier = notifier
        self._program = program_facts(args.config)
        self._reloader = Reloader(self._read_again)
        self._loaded: Loaded | None = None
        self._print = b""
        self._loop: Loop | None = None
        self._stopping = self._reload_asked = False

    def main(self) -> None:
        """Until a signal ends it."""
        from kontronik_can_gw.runtime.store import ParameterStore

        sys.setswitchinterval(_LOCK_SWITCH_S)
        with stopping_on_signals(self._stop, self._reload):
            loaded = load_all(self._file, ParameterStore)
            need_descriptors(2 * len(loaded.config.esc))
            self._open(loaded, self._wait or loaded.config.run.wait_for_devices)
            while True:
                assert self._loop is not None
                settle_memory()
                self._loop.run()
                new, self._reloader.new = self._reloader.new, None
                if self._stopping or not isinstance(new, Config):
                    break
                self._change(new)
        self._reloader.close()

    def _stop(self) -> None:
        self._stopping = True
        self._notifier.stopping()
        if self._loop is not None:
            self._loop.stop()

    def _reload(self) -> None:
        self._reload_asked = True
        if self._loop is not None:
            self._loop.reload()

    def _read_again(self) -> Config | None:
        """In the reloader's thread: the configuration, checked, if it is another one."""
        self._reload_asked = False
        found = load(self._file)
        check_interface(found.can)
        loaded = assemble(found)
        if fingerprint(found) == self._print:
            return None
        for warning in (*loaded.layout.warnings, *loaded.warnings):
            log.warning("%s", warning)
        return found

    def _change(self, config: Config) -> None:
        """Begin anew with another configuration; with the old one where it cannot be opened for a reason that waiting does not mend."""
        old = self._loaded
        assert old is not None
        try:
            self._open(self._with_store(config, assemble), wait=True)
        except UserError as error:
            assert self._loop is not None
            for problem in (*error.problems, "the new configuration cannot be used: going on with the old one"):
                self._loop.conditions.say(logging.ERROR, problem)
            # by what is in memory: its DBC and EDS may be others by now
            self._open(self._with_store(old.config, lambda _config, store: with_store(old, store)), wait=True)

    def _with_store(self, config: Config, make: "Callable[[Config, ParameterStore | None], Loaded]") -> Loaded:
        """What ``make`` makes of a configuration and the store for it; where it fails the store is free again."""
        from kontronik_can_gw.runtime.store import ParameterStore

        store = ParameterStore(parameter_folder(config)) if config.canopen.enabled else None
        try:
            return make(config, store)
        except UserError:
            if store is not None:
                store.close(0)
            raise

    def _open(self, loaded: Loaded, wait: bool) -> None:
        from kontronik_can_gw.cli.recording import in_words, record_folder, recorder_of, setup_of
        from kontronik_can_gw.gateway import Gateway
        from kontronik_can_gw.runtime import realtime
        from kontronik_can_gw.runtime.loop import Loop
        from kontronik_can_gw.runtime.recorded_gateway import RecordedGateway
        from kontronik_can_gw.runtime.recorder import state_of
        from kontronik_can_gw.runtime.statistics import Statistics, default_file

        config = loaded.config
        if config.run.realtime_priority is None:
            realtime.end()
        else:
            try:
                realtime.begin(config.run.realtime_priority)
            except RunError as error:
                if not wait:
                    raise
                log.error("%s Running without.", error)  # a late frame is better than none
        silent = config.dbc.on_loss == "silent"
        created_ns = time.monotonic_ns()
        parts = (loaded.escs, loaded.layout, created_ns, silent, loaded.canopen)
        recorder = recorder_of(config, self._record)
        gateway = Gateway(*parts) if recorder is None else RecordedGateway(recorder.put, *parts)
        try:
            statistics = Statistics(config.statistics_path or default_file(), config.statistics.address)
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
            self._status_ns,
            notifier=self._notifier,
            reloader=self._reloader,
            statistics=statistics,
            program=self._program,
            recorder=recorder,
        )
        if self._loop is not None:
            gateway.take_over(self._loop.gateway)
            loop.take_over(self._loop)
        _say_parameters(loaded)  # first: a damaged file is moved aside by now, and must not go unsaid
        folder = record_folder(config, self._record)
        if recorder is not None and folder is not None:
            recorder.words = in_words(config, folder)
            recorder.header = setup_of(loaded).header() | {"created_ns": created_ns, "state": state_of(gateway)}
        loop.open()
        for esc, _ in loaded.damaged:
            gateway.parameters_damaged(esc, time.monotonic_ns())
        # nobody needs the DBC's own tree any more
        self._loaded, self._print, self._loop = replace(loaded, database=None), fingerprint(config), loop
        if self._stopping:  # a signal came while there was no loop
            loop.stop()
        if self._reload_asked:
            loop.reload()


def settle_memory() -> None:
    """What is there now stays: no collection of garbage ever walks through it again.

    The hot path makes no objects that refer to each other in a circle (tests/runtime_loop/test_garbage.py), so only what is young is looked
    through now and then; the whole only here, at the start and when the configuration is another one.
    """
    gc.unfreeze()
    gc.collect()
    gc.freeze()
    young, middle, _ = gc.get_threshold()
    gc.set_threshold(young, middle, _NEVER)


def _say_parameters(loaded: Loaded) -> None:
    for esc, reason in loaded.damaged:
        log.error("%s: stored parameters: %s. Running on defaults.", loaded.escs[esc].name, reason)
    if loaded.canopen is None:
        return
    for configured, holds in zip(loaded.config.escs, loaded.escs, strict=True):
        for name in ("pole_pairs", "gear", "cell_count", "timeout_ns"):
            if getattr(configured, name) != getattr(holds, name):
                log.info(
                    "%s: %s is %s, by what a master stored or the EDS's default", holds.name, name, getattr(holds, name)
                )
