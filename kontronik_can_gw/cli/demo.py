"""``demo``: runs the whole gateway without hardware, vcan or privileges, and the monitor on its bus."""

import argparse
import math
import time
from threading import Event

from kontronik_can_gw.cli.arguments import number_from, option
from kontronik_can_gw.cli.common import say, stopping_on_signals
from kontronik_can_gw.desk.monitor.demo import simulated_bus
from kontronik_can_gw.desk.monitor.model import Monitor
from kontronik_can_gw.desk.monitor.watch import watch

# fmt: off
OPTIONS = (
    option("--seconds N", "end after N seconds (default: q or Ctrl-C)", type=number_from(0.001, 1e6), default=math.inf),
    option("--seed N", "seed of the simulated faults (default 1)", type=int, default=1),
)
# fmt: on
EPILOG = (
    "A simulated ESC on a pseudo terminal, the real gateway, python-can's in-process bus, a small CANopen master, "
    "and the monitor, which knows the DBC. Exit code: 0 at its end, 1 something in it failed, 2 wrong usage."
)


def main(args: argparse.Namespace) -> int:
    stop = Event()
    with stopping_on_signals(stop.set), simulated_bus(args.seed, stop) as bus:
        monitor = Monitor(bus.bus)
        end = time.monotonic() + (args.seconds or math.inf)
        watch(bus, monitor, None, lambda: stop.is_set() or time.monotonic() >= end, say)
    say(f"{monitor.frames} CAN frames decoded, 0 bytes sent to the ESC")
    return 0
