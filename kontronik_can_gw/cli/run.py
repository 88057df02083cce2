"""``run``: the gateway."""

import argparse
import logging
import time
from pathlib import Path

from kontronik_can_gw.cli.common import Loaded, load_all, set_up_log, stopping_on_signals

log = logging.getLogger("kontronik_can_gw")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-c", "--config", type=Path, required=True, metavar="FILE", help="TOML configuration")
    parser.add_argument(
        "--wait",
        action="store_true",
        help="wait for ports and interfaces that are missing at start (run.wait_for_devices)",
    )
    parser.epilog = "Ends by SIGTERM or SIGINT within half a second. The serial ports are only read; nothing is ever transmitted to an ESC."


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
    loop = Loop(gateway, [esc.port for esc in config.esc], config.can, wait, store=loaded.store)
    with stopping_on_signals(loop.stop):
        loop.open()
        _say_parameters(loaded)
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
