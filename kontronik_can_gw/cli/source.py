"""The SOURCE of ``monitor`` and ``web``: a CAN interface or a recording, and its options."""

import argparse
import contextlib
import socket
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from kontronik_can_gw.cli.arguments import LAYOUT, number_from, option
from kontronik_can_gw.cli.common import say
from kontronik_can_gw.cli.desk import bus_layout, given_layout
from kontronik_can_gw.desk.recordings.inputs import CaptureInput, open_input
from kontronik_can_gw.desk.sources import Bus, PlayedRecording, Source, can_config
from kontronik_can_gw.errors import UserError

SOURCE_OPTIONS = (
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
)


def recording_of(args: argparse.Namespace) -> Path | None:
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
    for suffix, text, parameter in (
        (".toml", "a configuration", "-c"),
        (".dbc", "a DBC", "--dbc"),
    ):
        if name.endswith(suffix):
            raise UserError(f"{name}: is {text}, not a recording. Give it with {parameter} {name}.")
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
def source_of(
    args: argparse.Namespace,
    recording: Path | None,
    *,
    at_once: bool = False,
    patient: bool = False,
) -> Iterator[Source]:
    """Open the bus or the recording of a command.

    ``at_once``: the recording is read as fast as possible. ``patient``: opening the bus is tried
    again if it fails.
    """
    if recording is None:
        bus = bus_layout(args)
        config = can_config(bus, args.interface, args.channel)
        with Bus(bus, config, patient) as live:
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
        with closing(PlayedRecording(opened, args.speed or 1.0, at_once=at_once)) as played:
            yield played
        lines = [*opened.damage, *opened.notes, opened.left_out]
        for line in dict.fromkeys(filter(None, lines)):
            say(f"warning: {line}")
