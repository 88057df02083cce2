"""``monitor``: shows a live screen of the ESCs, from the CAN bus or from a recording.

It never sends anything.
"""

import argparse
import sys
from threading import Event
from typing import Any

from kontronik_can_gw.cli.arguments import number_from, option
from kontronik_can_gw.cli.common import say, stopping_on_signals
from kontronik_can_gw.cli.source import SOURCE_OPTIONS, recording_of, source_of
from kontronik_can_gw.desk.monitor.model import Monitor
from kontronik_can_gw.desk.monitor.watch import once, stream, watch
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.printable import counted, printable_json

_ONCE_S = 3.0
OPTIONS = (
    *SOURCE_OPTIONS,
    (
        option("--once", "print one line of JSON with all values, then end"),
        option("--stream", "print one line of JSON each second until the end"),
    ),
    option(
        "--timeout S",
        f"with --once: longest time to wait, in seconds (default {_ONCE_S:g})",
        type=number_from(0.1, 3600),
    ),
)
EPILOG = """\
The monitor listens on a CAN interface anywhere on the bus. It needs only the
DBC (-c, --dbc) and never sends a frame. SOURCE is the name of an interface,
such as vcan0. Without SOURCE the interface is the one in the configuration, or
can0.

SOURCE can also be a recording, which is played in real time: a capture (.kcap),
a file of UART bytes, or a CAN log (candump .log, .asc, .blf, .trc, .mf4). Write
./NAME for a file that has the name of an interface. A recording may be a pipe:
ssh BOARD candump -L can0 | kontronik-can-gw monitor -

keys: q      quit                         n, p   next, previous ESC
      1 to 9 one ESC with all its values  0      all ESCs
      r      reset minimum and maximum    space  pause (recording)

The monitor marks values beyond its own limits with ! and !!: temperatures of
power stage and BEC from 80 and 100 degC, cell voltages of 3.5 and 3.3 V and
below.

If standard output is not a capable terminal, the table is written every second.
--once waits until each cyclic message of the DBC was received, at most for
--timeout, and prints one line of JSON. From a recording it prints the values at
the end. --stream prints such a line each second of the bus or the recording,
also while no frames are received. "problem" then has the reason, if it is
known. Values are in the units of "units", and null if they are not available.

exit codes: 0 ended by a key, a signal or the end of a recording, or --once has
values, or a gateway of this machine is quiet; 1 no frame was received (--once),
or the bus cannot be opened; 2 wrong usage, or the recording cannot be opened
"""


def main(args: argparse.Namespace) -> int:
    recording = recording_of(args)
    if args.timeout is not None and not args.once:
        raise UserError("--timeout: is for --once. Leave it out.")
    stop = Event()
    opened = source_of(args, recording, at_once=args.once)
    with opened as source, stopping_on_signals(stop.set):
        monitor = Monitor(source.bus)
        if args.stream:
            stream(
                source,
                monitor,
                _print_document,
                stop.is_set,
            )
            return 0
        if not args.once:
            watch(source, monitor, stop.is_set)
            count = monitor.view.frames
            seen = f"{counted(count, 'frame')} of {monitor.file}"
            if recording is None:
                say(f"{seen} received on {source.name}. The monitor sends nothing.")
            else:
                say(f"{seen} read from {source.name}")
            return 0
        document = once(
            source,
            monitor,
            args.timeout or _ONCE_S,
            stop.is_set,
        )
        if stop.is_set():
            return 130
    _print_document(document)
    return 0


def _print_document(document: dict[str, Any]) -> None:
    is_utf8 = (sys.stdout.encoding or "").lower().replace("-", "") == "utf8"
    print(printable_json(document, ascii_only=not is_utf8), flush=True)
