"""``demo``: shows the monitor on a simulated bus, without hardware, vcan or privileges."""

import argparse
import math
import time
from threading import Event

from kontronik_can_gw.cli.arguments import number_from, option
from kontronik_can_gw.cli.common import say, stopping_on_signals
from kontronik_can_gw.desk.monitor.model import Monitor
from kontronik_can_gw.desk.monitor.watch import watch
from kontronik_can_gw.desk.sources import DemoBus

OPTIONS = (
    option(
        "--seconds N",
        "end after N seconds (default: only with q or Ctrl-C)",
        type=number_from(0.001, 1e6),
        default=math.inf,
    ),
    option("--seed N", "seed of the simulated faults (default 1)", type=int, default=1),
)
EPILOG = (
    "Runs a simulated ESC with simulated faults, the gateway, and the monitor. "
    "For real ports and a real bus "
    "use simulate, run and monitor. Exit codes: 0 ended, 2 wrong usage."
)


def main(args: argparse.Namespace) -> int:
    stop = Event()
    end = time.monotonic() + args.seconds
    bus = DemoBus(args.seed)
    monitor = Monitor(bus.bus)
    say("the ESC and its faults are simulated; the gateway and the monitor are the real ones")
    with stopping_on_signals(stop.set):
        watch(bus, monitor, lambda: stop.is_set() or time.monotonic() >= end)
    say(f"{monitor.view.frames} CAN frames of a simulated ESC decoded")
    return 0
