"""``demo``: shows the monitor on a simulated bus, without hardware, vcan or privileges."""

import argparse
import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event

from kontronik_can_gw.cli.arguments import number_from, option
from kontronik_can_gw.cli.common import say, stopping_on_signals
from kontronik_can_gw.cli.web import PORT
from kontronik_can_gw.desk.libraries import EXTRAS, install_command
from kontronik_can_gw.desk.monitor.model import Monitor
from kontronik_can_gw.desk.monitor.watch import watch
from kontronik_can_gw.desk.sources import DemoBus
from kontronik_can_gw.errors import RunError

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
    with stopping_on_signals(stop.set), _page_of(bus):
        watch(bus, monitor, lambda: stop.is_set() or time.monotonic() >= end)
    say(f"{monitor.view.frames} CAN frames of a simulated ESC decoded")
    return 0


@contextmanager
def _page_of(bus: DemoBus) -> Iterator[None]:
    """Serve the live page of the simulation beside the screen, if its libraries are installed."""
    try:
        from kontronik_can_gw.desk.live import server
        from kontronik_can_gw.desk.live.content import Content
        from kontronik_can_gw.desk.live.flights import Flights
    except ImportError:
        say(f"for the page in a browser: {install_command(EXTRAS['web'])}")
        yield
        return
    try:
        sock = server.listen("127.0.0.1", PORT)
    except RunError:  # another page runs
        sock = server.listen("127.0.0.1", 0)
    address = f"http://127.0.0.1:{sock.getsockname()[1]}/"
    say(f"{address} shows the same in a browser")
    hub = server.Hub(Content(bus))
    bus.listeners.append(hub)
    bus.simulation += f", {address}"
    page = server.LiveServer(
        hub,
        sock,
        None,
        Flights(),
    )
    thread = threading.Thread(target=page.serve, daemon=True)
    thread.start()
    yield
    page.stop()
    thread.join(2)
