"""``run``: the gateway."""

import argparse
import logging
import time
from pathlib import Path

from kontronik_can_gw.cli.common import Loaded, load_all, set_up_log, stopping_on_signals
from kontronik_can_gw.telemetry import SECOND

log = logging.getLogger("kontronik_can_gw")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-c", "--config", type=Path, required=True, metavar="FILE", help="TOML configuration")
    parser.add_argument(
        "--wait",
        action="store_true",
        help="wait for ports and interfaces that are missing at start (run.wait_for_devices)",
    )
    parser.add_argument(
        "--status",
        type=_seconds,
        metavar="SECONDS",
        help="log a line about telemetry, CAN, NMT states and PDO traffic every so many seconds (default: changes only)",
    )
    parser.epilog = "Ends by SIGTERM or SIGINT within half a second. The serial ports are only read; nothing is ever transmitted to an ESC."


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0
    if not 0.1 <= value <= 1e6:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of seconds, 0.1 or more")
    return value


def main(args: argparse.Namespace) -> int:
    from kontronik_can_gw.gateway import Gateway
    from kontronik_can_gw.runtime.loop import Loop
    from kontronik_can_gw.runtime.store import ParameterStore

    loaded = load_all(args.config, ParameterStore)
    config = loaded.config
    set_up_log()
    silent = config.dbc.on_loss == "silent"
    gateway = Gateway(loaded.escs, loaded.layout, time.monotonic_ns(), silent, loaded.canopen)
    wait = args.wait or config.run.wait_for_devices
    status_ns = int((args.status or 0) * SECOND)
    loop = Loop(gateway, [esc.port for esc in config.esc], config.can, wait, loaded.store, status_ns)
    with stopping_on_signals(loop.stop):
        _say_parameters(loaded)  # first: a damaged file is moved aside by now, and must not go unsaid
        loop.open()
        for esc, _ in loaded.damaged:
            gateway.parameters_damaged(esc, time.monotonic_ns())
        loop.run()
    return 0


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
