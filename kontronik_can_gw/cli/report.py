"""``report``: writes a page about a recorded flight for a browser."""

import argparse
from functools import partial
from pathlib import Path

from kontronik_can_gw.cli.arguments import FORCE, LAYOUT, LOG_CHANNEL, number_from, option
from kontronik_can_gw.cli.common import say
from kontronik_can_gw.cli.desk import given_layout, reading, was_ended, watched
from kontronik_can_gw.cli.output import (
    STOPPED,
    check_output,
    configuration_files,
    recording_files,
    write_output,
)
from kontronik_can_gw.desk.recordings.inputs import Input
from kontronik_can_gw.desk.recordings.stream import name_of
from kontronik_can_gw.desk.report.flight import flight_of
from kontronik_can_gw.desk.report.page import render
from kontronik_can_gw.errors import RunError, UserError

_SECONDS = number_from(0, 1e9)
OPTIONS = (
    option("IN", "capture, CAN log or UART bytes, or - for standard input", dest="input"),
    option("-o --output FILE", "page to write, or - for standard output", required=True),
    FORCE,
    LAYOUT,
    LOG_CHANNEL,
    option("--from S", "from this time after the start, in seconds", type=_SECONDS, dest="start"),
    option("--until S", "up to this time after the start, in seconds", type=_SECONDS, dest="end"),
)
EPILOG = """\
IN is a capture (.kcap; a folder or a common prefix of file names stands for
all parts of one run), a file of plain UART bytes, or a CAN log (candump, ASC,
BLF, TRC, MF4). For a CAN log give the DBC of its frames with -c or --dbc. IN
may be a pipe: Ctrl-C then ends the input, and the page shows the data so far.

The page is one file that needs no network. It has plots with zoom, operating
states, errors with meaning and remedy, and numbers: energy, charge, extremes
with their times, cell voltage sag, quality of the data. Several ESCs share the
plots. Numbers and events are computed from every row. Lines are reduced to
20 000 points in a way that keeps every peak and every gap. With the same core,
the same recording gives the same page, byte for byte.

examples:
  kontronik-can-gw report flight.kcap -o flight.html
  kontronik-can-gw report bus.log -c gateway.toml -o bus.html
  kontronik-can-gw report flight.kcap -o part.html --from 60 --until 90

exit codes: 0 done; 1 IN has no values, or FILE cannot be written; 2 wrong
usage, or IN cannot be opened or is not a recording; 130 stopped by a signal
"""


def main(args: argparse.Namespace) -> int:
    """Write the report of ``args.input``.

    Raises UserError for wrong usage, and RunError if a file cannot be read or written.
    """
    if args.start is not None and args.end is not None and args.end <= args.start:
        raise UserError(f"--until {args.end:g}: must be greater than --from {args.start:g}")
    source = Path(args.input)
    inputs = [*recording_files(source), *configuration_files(args.config, args.dbc)]
    check_output(args.output, inputs, force=args.force)
    try:
        with reading(source, given_layout(args)) as recording:
            if args.channel is not None:
                recording.select_channel(args.channel)
            _write_page(args, recording, inputs)
            return STOPPED if was_ended(recording) else 0
    except KeyboardInterrupt:
        say("stopped: nothing was written")
        return STOPPED


def _write_page(args: argparse.Namespace, recording: Input, inputs: list[Path]) -> None:
    """Write the page. Report damaged and omitted data.

    Raises RunError if there is nothing to show.
    """
    source = name_of(Path(args.input))
    watch = partial(watched, name=f"{recording.name}: rows", data_on_screen=args.output == "-")
    flight = flight_of(recording, (args.start, args.end), watch)
    damage = [f"{source}: damaged: {line}" for line in recording.damage]
    if not flight.rows:
        if was_ended(recording):
            raise KeyboardInterrupt
        where = "between --from and --until"
        if not args.start and not args.end:
            where = "according to this DBC. Is -c or --dbc the right one?"
        raise RunError(*damage, f"{source}: no values {where}")
    recording.begin_ns = flight.origin_ns
    details = {"Frames": recording.left_out, "Clock": "; ".join(recording.clock_notes)}
    if details["Clock"]:  # it says the same as the state at the start, and more
        recording.provenance.pop("clock at the start", None)
    page = render(
        flight,
        source=Path(source).name,
        provenance=recording.provenance | details,
        wall_ns=recording.wall_ns(flight.origin_ns),
        damage=recording.damage,
    )
    write_output(
        args.output,
        page,
        inputs,
        force=args.force,
    )
    if recording.left_out:
        damage.append(f"{source}: {recording.left_out}")
    damage += [f"{source}: {note}" for note in recording.notes]
    for line in damage:
        say(line, "report")
