"""``monitor``: a live screen of the ESCs, from the CAN bus by the DBC or from a recording. It never sends anything."""

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event

from kontronik_can_gw.cli.arguments import LAYOUT, number_from, option
from kontronik_can_gw.cli.common import say, stopping_on_signals
from kontronik_can_gw.cli.desk import bus_layout, given_layout
from kontronik_can_gw.desk.monitor.model import Monitor
from kontronik_can_gw.desk.monitor.watch import once, watch
from kontronik_can_gw.desk.recordings.inputs import CaptureInput, open_input
from kontronik_can_gw.desk.sources import Bus, Recording, Source, can_config
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.printable import printable_json

_ONCE_S = 3.0
# fmt: off
OPTIONS = (
    option("FILE", "a recording instead of the bus", type=Path, nargs="?"),
    LAYOUT,
    option("--interface NAME", "python-can interface (default socketcan)"),
    option("--channel NAME", "channel of the interface (default can0); of a CAN log, as can0 or 1: the one to play"),
    option("--speed FACTOR", "play FILE faster by this factor (0.01 to 1000, default 1)", type=number_from(0.01, 1000, "factor")),
    option("--once", "one line of JSON with everything, then end"),
    option("--timeout S", f"--once: maximum time to wait (default {_ONCE_S:g})", type=number_from(0.1, 3600)),
)
# fmt: on
EPILOG = """\
Without FILE it listens on the CAN bus, at any place: it only needs the DBC (-c,
--dbc) and never sends a frame. With -c the interface and the channel are those
of the configuration unless they are given. FILE is a capture (.kcap), a file of
UART bytes or a CAN log (candump .log, .asc, .blf, .trc, .mf4), played in real
time.

keys: q quit, r reset minimum and maximum, 1 to 9 one ESC with everything in it,
      n and p next and previous, 0 all, space pause (FILE)

A value beyond a limit is marked with ! and !!: power stage and BEC from 80 and
100 degC, a cell from 3.5 and 3.3 V down. The limits are the monitor's own.

Where standard output is no terminal, or a dumb one, it writes the table every
second. --once waits until each cyclic message of the DBC has come, or
for --timeout, and prints one line of JSON; of a FILE the values at its end, in
the units of "units", null where not available.

exit codes: 0 ended by a key or signal, end of FILE, or --once with values; 1 no
frame came (--once), or something cannot be opened; 2 wrong usage
"""


def main(args: argparse.Namespace) -> int:
    if args.file is None and args.speed is not None:
        raise UserError("--speed: is for a FILE, not for the bus. Leave it out.")
    if args.file is not None and args.interface is not None:
        raise UserError(f"{args.file}: is played, so --interface means nothing. Leave it out.")
    if args.timeout is not None and not args.once:
        raise UserError("--timeout: is for --once. Leave it out.")
    stop = Event()
    with _source_of(args) as source, stopping_on_signals(stop.set):
        monitor = Monitor(source.bus)
        if not args.once:
            watch(source, monitor, stop.is_set)
            count = monitor.view.frames
            say(f"{count} frames of {monitor.file} seen on {source.name}, none sent")
            return 0
        document = once(source, monitor, args.timeout or _ONCE_S, stop.is_set)
        if stop.is_set():
            return 130
    is_utf8 = (sys.stdout.encoding or "").lower().replace("-", "") == "utf8"
    print(printable_json(document, ascii_only=not is_utf8))
    return 0


@contextmanager
def _source_of(args: argparse.Namespace) -> Iterator[Source]:
    if args.file is None:
        bus = bus_layout(args)
        with Bus(bus, can_config(bus, args.interface, args.channel)) as live:
            yield live
        return
    given = given_layout(args)
    with open_input(args.file, given) as opened:
        if given is not None and isinstance(opened, CaptureInput):
            raise UserError(
                f"{args.file}: is a capture, which holds its own DBC. Leave -c and --dbc out."
            )
        if args.channel is not None:
            opened.select_channel(args.channel)
        yield Recording(opened, args.speed or 1.0, at_once=args.once)
        for line in dict.fromkeys(
            filter(None, [*opened.damage, *opened.clock_notes, opened.left_out])
        ):
            say(f"warning: {line}")
