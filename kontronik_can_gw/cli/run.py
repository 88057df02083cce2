"""``run``: the gateway."""

import argparse
import time
from pathlib import Path

from kontronik_can_gw.cli.common import load_all, set_up_log, stopping_on_signals


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

    config, _, layout = load_all(args.config)
    set_up_log()
    gateway = Gateway(config.escs, layout, time.monotonic_ns(), silent_on_loss=config.dbc.on_loss == "silent")
    loop = Loop(gateway, [esc.port for esc in config.esc], config.can, args.wait or config.run.wait_for_devices)
    with stopping_on_signals(loop.stop):
        loop.open()
        loop.run()
    return 0
