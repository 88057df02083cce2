"""``report``: writes a recorded flight as one page for a browser."""

import argparse
from pathlib import Path

from kontronik_can_gw.cli.arguments import LAYOUT, LOG_CHANNEL, number_from, option
from kontronik_can_gw.cli.common import say
from kontronik_can_gw.cli.desk import given_layout, watched, write_output
from kontronik_can_gw.desk.recordings.inputs import Input, open_input
from kontronik_can_gw.desk.report.flight import Flight, needed_columns
from kontronik_can_gw.desk.report.page import render
from kontronik_can_gw.errors import RunError, UserError

_SECONDS = number_from(0, 1e9)
# fmt: off
OPTIONS = (
    option("IN", "capture, CAN log or UART bytes", dest="input"),
    option("-o --output FILE", "page to write, or - for standard output", required=True),
    option("--force", "replace FILE if it exists"),
    LAYOUT,
    LOG_CHANNEL,
    option("--from S", "begin at this time in seconds after the start", type=_SECONDS, dest="start"),
    option("--until S", "end at this time in seconds after the start", type=_SECONDS, dest="end"),
)
# fmt: on
EPILOG = """\
IN is a capture (.kcap; a folder or a common prefix of file names stands for all parts of one run), a file of plain UART
bytes, or a CAN log (candump, ASC, BLF, TRC, MF4). For a CAN log give the DBC of its frames with -c or --dbc.

The page is one file that needs no network: plots with zoom, the operating states, errors with meaning and remedy, and the
numbers (energy, charge, extremes with their time, cell voltage sag, quality of the data). Several ESCs share the plots.
Numbers and events are from every row. Lines are reduced to 20 000 points in a way that keeps every peak and every gap.
The same recording gives the same page, byte for byte (where the same core plays it). A file that exists is only replaced with --force.

examples:
  kontronik-can-gw report flight.kcap -o flight.html
  kontronik-can-gw report bus.log -c gateway.toml -o bus.html
  kontronik-can-gw report flight.kcap -o part.html --from 60 --until 90

exit codes: 0 done, 1 something cannot be read or written, or has no values; 2 wrong usage, or a file that is no recording
"""


def main(args: argparse.Namespace) -> int:
    """Report on args.input. UserError for wrong usage, RunError where a file cannot be read or written."""
    if args.start is not None and args.end is not None and args.end <= args.start:
        raise UserError(f"--until {args.end:g}: must be greater than --from {args.start:g}")
    source = Path(args.input)
    _check_target(source, args.output, force=args.force)
    with open_input(source, given_layout(args)) as recording:
        if args.channel is not None:
            recording.select_channel(args.channel)
        flight = _analysed(recording, args)
        if flight is None:
            say("stopped: nothing is written")
            return 130
        damage = [f"{args.input}: damaged: {line}" for line in recording.damage]
        if not flight.rows:
            where = "in this part of it"
            if not args.start and not args.end:
                where = "by this DBC. Is -c or --dbc the right one?"
            raise RunError(*damage, f"{args.input}: no values {where}")
        recording.begin_ns = flight.origin_ns
        clock = {"Clock": "; ".join(recording.clock_notes)}
        page = render(
            flight,
            source=source.name,
            provenance=recording.provenance | clock,
            wall_ns=recording.wall_ns(flight.origin_ns),
            damage=recording.damage,
        )
        write_output(args.output, page)
    if recording.left_out:
        damage.append(f"{args.input}: {recording.left_out}")
    damage += [f"{args.input}: {note}" for note in recording.clock_notes]
    for line in damage:
        say(line, "report")
    return 0


def _check_target(source: Path, output: str, *, force: bool) -> None:
    """UserError where the page cannot be written, or exists."""
    if output == "":
        raise UserError("-o: is empty. Give a file, or - for standard output.")
    target = Path(output)
    if output == "-" or not target.exists():
        return
    if source.exists() and target.samefile(source):
        raise UserError(f"-o {output}: is the input. Give another file.")
    if target.is_dir():
        raise UserError(f"-o {output}: is a folder. Give a file.")
    if target.is_file() and not force:
        raise UserError(f"{output}: exists. Give another -o, or --force.")


def _analysed(recording: Input, args: argparse.Namespace) -> Flight | None:
    """The flight of all rows; None if the user stopped it. UserError where nothing could be shown."""
    chosen = needed_columns(recording.fields)
    fields = [recording.fields[index] for index in chosen]
    flight = Flight(recording.bus.escs, fields, window=(args.start, args.end))
    if not flight.has_anything:
        raise UserError(
            f"{recording.bus.layout.file}: has no signal that a report could show. Give another --dbc."
        )
    try:
        blocks = filter(len, recording.blocks(chosen))
        for block in watched(blocks, f"{recording.name}: rows", args.output == "-"):
            if not flight.take(block):
                break
    except KeyboardInterrupt:
        return None
    return flight.finish()
