"""``monitor``: shows a live screen of the ESCs, from the CAN bus or from a recording.

It never sends anything.
"""

import argparse
import contextlib
import socket
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from threading import Event
from typing import Any

from kontronik_can_gw.cli.arguments import LAYOUT, number_from, option
from kontronik_can_gw.cli.common import say, stopping_on_signals
from kontronik_can_gw.cli.desk import bus_layout, given_layout
from kontronik_can_gw.desk.monitor.model import Monitor
from kontronik_can_gw.desk.monitor.watch import once, stream, watch
from kontronik_can_gw.desk.recordings.inputs import CaptureInput, open_input
from kontronik_can_gw.desk.sources import Bus, Recording, Source, can_config
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.printable import printable_json

_ONCE_S = 3.0
OPTIONS = (
    option("SOURCE", "a CAN interface, a recording, or - for standard input", nargs="?"),
    LAYOUT,
    option("--interface NAME", "python-can interface (default socketcan)"),
    option(
        "--channel NAME",
        "channel of the interface (default can0), or the channel of a CAN log to play, for "
        "example can0 or 1",
    ),
    option(
        "--speed FACTOR",
        "factor that speeds up a recording, 0.01 to 1000 (default 1)",
        type=number_from(0.01, 1000, "factor"),
    ),
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
values; 1 no frame was received (--once), or the bus cannot be opened; 2 wrong
usage, or the recording cannot be opened
"""


def main(args: argparse.Namespace) -> int:
    recording = _recording_of(args)
    if args.timeout is not None and not args.once:
        raise UserError("--timeout: is for --once. Leave it out.")
    stop = Event()
    with _source_of(args, recording) as source, stopping_on_signals(stop.set):
        monitor = Monitor(source.bus)
        if args.stream:
            stream(source, monitor, _print_document, stop.is_set)
            return 0
        if not args.once:
            watch(source, monitor, stop.is_set)
            count = monitor.view.frames
            say(f"{count} frames of {monitor.file} seen on {source.name}, none sent")
            return 0
        document = once(source, monitor, args.timeout or _ONCE_S, stop.is_set)
        if stop.is_set():
            return 130
    _print_document(document)
    return 0


def _print_document(document: dict[str, Any]) -> None:
    is_utf8 = (sys.stdout.encoding or "").lower().replace("-", "") == "utf8"
    print(printable_json(document, ascii_only=not is_utf8), flush=True)


def _recording_of(args: argparse.Namespace) -> Path | None:
    """Return the recording of SOURCE. If SOURCE is an interface, store it as the channel.

    Raises UserError for options that contradict SOURCE.
    """
    name = args.source
    if name is None or _is_interface(name, args.interface):
        if args.speed is not None:
            raise UserError("--speed: is for a recording, not for the bus. Leave it out.")
        if name is not None and args.channel is not None:
            raise UserError(f"--channel {args.channel}: {name} names the interface. Leave one out.")
        args.channel = name or args.channel
        return None
    if args.interface is not None:
        raise UserError(f"{name}: is a recording, so --interface has no effect. Leave it out.")
    return Path(name)


def _is_interface(name: str, kind: str | None) -> bool:
    """Return True for the name of a CAN interface, False for a recording.

    ``kind`` is python-can's interface, if it is given. The name of a missing interface or file
    counts as an interface, unless it looks like a file name. The later error describes how to
    create the interface.
    """
    if kind not in (None, "socketcan"):
        return not Path(name).is_file()
    if "/" in name or name == "-":
        return False
    with contextlib.suppress(OSError):
        socket.if_nametoindex(name)
        return True
    return "." not in name and not Path(name).exists()


@contextmanager
def _source_of(args: argparse.Namespace, recording: Path | None) -> Iterator[Source]:
    if recording is None:
        bus = bus_layout(args)
        with Bus(bus, can_config(bus, args.interface, args.channel)) as live:
            yield live
        return
    given = given_layout(args)
    with open_input(recording, given) as opened:
        if given is not None and isinstance(opened, CaptureInput):
            raise UserError(
                f"{recording}: is a capture, which contains its own DBC. Leave -c and --dbc out."
            )
        if args.channel is not None:
            opened.select_channel(args.channel)
        with closing(Recording(opened, args.speed or 1.0, at_once=args.once)) as played:
            yield played
        lines = [*opened.damage, *opened.clock_notes, opened.left_out]
        for line in dict.fromkeys(filter(None, lines)):
            say(f"warning: {line}")
