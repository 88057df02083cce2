"""``convert``: recordings to tables, CAN logs and plain bytes."""

import argparse
import time
from collections.abc import Callable
from decimal import Decimal, InvalidOperation
from functools import partial
from pathlib import Path

from kontronik_can_gw.cli.arguments import FORCE, LAYOUT, LOG_CHANNEL, REMOVED_OPTIONS, option
from kontronik_can_gw.cli.common import say
from kontronik_can_gw.cli.desk import OpenInput, given_layout, reading, was_ended, watched
from kontronik_can_gw.cli.output import (
    STOPPED,
    check_output,
    configuration_files,
    output_of,
    recording_files,
    writing,
)
from kontronik_can_gw.desk.recordings.convert import (
    BYTES,
    FORMATS,
    LOGS,
    ON_SCREEN,
    SUFFIXES,
    TABLES,
    to_bytes,
    to_log,
    to_table,
)
from kontronik_can_gw.desk.recordings.fields import Choice
from kontronik_can_gw.desk.recordings.inputs import Input, open_input
from kontronik_can_gw.desk.recordings.stream import name_of
from kontronik_can_gw.errors import RunError, UserError


def _seconds_ns(text: str) -> int:
    """Return seconds as ns. A type for argparse."""
    try:
        number = Decimal(text)
        if number.is_finite() and 0 <= number < 10**9:
            return int(number * 10**9)
    except InvalidOperation:
        pass
    raise argparse.ArgumentTypeError(f"{text!r} is not a number of seconds from 0 to 999999999")


def _names(text: str) -> list[str]:
    """Return the names in a text, separated by commas. A type for argparse."""
    found = [name.strip() for name in text.split(",") if name.strip()]
    if not found:
        raise argparse.ArgumentTypeError("give names of signals, separated by commas")
    return found


OPTIONS = (
    option("IN", "capture, CAN log or UART bytes, or - for standard input", dest="input"),
    option("OUT", "file to write, or - for standard output", nargs="?"),
    option("-o --output OUT", "another way to give OUT"),
    option(
        "--to FORMAT",
        ", ".join(FORMATS),
        choices=FORMATS,
        type=lambda text: SUFFIXES.get(f".{text}", text),  # also by its suffix
    ),
    FORCE,
    option("-q --quiet", "print no summary"),
    LAYOUT,
    LOG_CHANNEL,
    "part of the recording",
    option(
        "--from S", "from this time after the start, in seconds", type=_seconds_ns, dest="start"
    ),
    option(
        "--until S", "up to this time after the start, in seconds", type=_seconds_ns, dest="end"
    ),
    "tables",
    option(
        "--signals A,B*",
        "only these values, in this order; * stands for any characters, ? for one",
        type=_names,
        default=[],
    ),
    "bin",
    option("--esc NAME", "the ESC whose bytes to write, if there are several"),
)
EPILOG = """\
IN is a capture of this gateway (.kcap; a folder stands for all parts of a
run), a log of CAN frames (candump, Vector ASC or BLF, PEAK TRC, MF4 bus
logging), or the plain UART bytes of one ESC. The format is detected from the
content. IN may be a pipe. UART bytes and candump text are then converted as
they arrive, and Ctrl-C ends the input and keeps the rows so far.

OUT is a table of all values (csv, jsonl, parquet), a log of the CAN frames
(candump, asc, blf, trc, mf4-log), or the plain UART bytes of one ESC (bin).
Its suffix selects the format: .csv .jsonl .ndjson .parquet .log .candump .asc
.blf .trc .bin. For any other suffix use --to. OUT may be - for standard output
if the format is text. Parquet needs pyarrow, mf4-log needs asammdf.

A table has a row for each telemetry frame, or for each group of CAN frames
that were sent together. Each column is named after its value and unit, for
example battery_voltage [V], or esc1.battery_voltage [V] with several ESCs. A
value that is not available is empty in CSV and null in other formats. If
several channels of a CAN log have messages of the DBC, a table needs --channel.
CAN logs as output keep all channels; formats that number their channels count
can0 as 1. If a recording is damaged, all intact parts are converted, and the
summary lists the damage. OUT has the name OUT.part until it is complete.

examples:
  kontronik-can-gw convert flight.kcap flight.csv
  candump -L vcan0 | kontronik-can-gw convert - flight.csv

exit codes: 0 converted, also if a part of IN is damaged; 1 there is nothing to
convert, OUT cannot be written, or a library is missing; 2 wrong usage, or IN
cannot be opened or is not a recording; 130 stopped by a signal
"""


def main(args: argparse.Namespace, opened_by: OpenInput = open_input) -> int:
    """Convert ``args.input``, which is opened with ``opened_by``. Returns the exit code.

    Raises UserError for wrong usage, and RunError if a file cannot be read or written.
    """
    args.output = output_of(args, "OUT")
    inputs = [*recording_files(Path(args.input)), *configuration_files(args.config, args.dbc)]
    check_output(args.output, inputs, force=args.force)
    form = _format(args)
    _check(args, form)
    try:
        return _convert(args, form, opened_by)
    except KeyboardInterrupt:
        say("stopped: nothing was written" if args.output != "-" else "stopped", args.command)
        return STOPPED


def _convert(args: argparse.Namespace, form: str, opened_by: OpenInput) -> int:
    begun = time.monotonic()
    with reading(Path(args.input), given_layout(args), opened_by) as recording:
        if args.channel is not None:
            recording.select_channel(args.channel)
        conversion = _conversion(args, form, recording)
        # the rows of a pipe cannot be read again, but only text can be used without its end
        is_part_kept = recording.stream is not None and form in ON_SCREEN
        with writing(
            args.output, force=args.force, is_part_kept=is_part_kept, is_handling_signals=False
        ) as out:
            name = f"{Path(args.input).name or recording.name} to {form}:"
            out.watch = partial(watched, name=name, data_on_screen=args.output == "-")
            summary = conversion(recording, out)
        if summary is None and was_ended(recording):
            raise KeyboardInterrupt
        _report(
            args,
            form,
            recording,
            summary,
            time.monotonic() - begun,
        )
        return STOPPED if was_ended(recording) else 0


def _report(
    args: argparse.Namespace,
    form: str,
    recording: Input,
    summary: str | None,
    seconds: float,
) -> None:
    """Report the result and the damage.

    Raises RunError or UserError if there was nothing to convert.
    """
    source = name_of(Path(args.input))
    damage = [f"{source}: damaged: {line}" for line in recording.damage]
    if summary is None:
        if recording.refusal is not None:
            raise recording.refusal
        raise RunError(*damage, f"{source}: {_nothing(args, form, recording)}")
    if form in TABLES and recording.left_out:
        damage.append(f"{source}: {recording.left_out}")
    if not args.quiet:
        where = "standard output" if args.output == "-" else args.output
        say(f"{where}: {summary}, in {seconds:.1f} s", args.command)
        if "times" in recording.provenance and form != BYTES:
            say(f"times are {recording.provenance['times']}", args.command)
    for line in damage:
        say(line, args.command)
    notes = recording.notes
    if form == BYTES:  # they have no times
        notes = [note for note in notes if note not in recording.clock_notes]
    for note in notes:
        say(f"{source}: {note}", args.command)


def _nothing(args: argparse.Namespace, form: str, recording: Input) -> str:
    """Return the reason why there is nothing to convert."""
    if args.start is not None or args.end is not None:
        return "has no data between --from and --until"
    if recording.others:
        return (
            f"has no frame of {recording.bus.layout.file}, so there is nothing to convert. "
            "Give its DBC with --dbc or -c."
        )
    missing = "values" if form in TABLES else "frames"
    return f"has no {missing}, so there is nothing to convert"


def _conversion(args: argparse.Namespace, form: str, recording: Input) -> Callable[..., str | None]:
    """Return the function that converts a recording to an output.

    Raises UserError if the recording does not have the requested signal or ESC.
    """
    if form == BYTES:
        return partial(to_bytes, esc=_esc(args, recording))
    times = {"start_ns": args.start, "end_ns": args.end}
    if form in LOGS:
        return partial(to_log, form=LOGS[form], **times)
    choice = Choice.of(recording.fields, args.signals, **times)
    return partial(to_table, form=form, choice=choice)


def _format(args: argparse.Namespace) -> str:
    if args.to:
        return str(args.to)
    if args.output == "-":
        raise UserError(
            f"standard output: only for text formats. Give --to {' or '.join(ON_SCREEN)}."
        )
    suffix = Path(args.output).suffix.lower()
    if suffix == ".mf4":
        raise UserError(
            f"{args.output}: .mf4 may be a table or a log. {REMOVED_OPTIONS['convert', '--to mf4']}"
        )
    if suffix not in SUFFIXES:
        raise UserError(
            f"{args.output}: unknown suffix. Give --to, or one of these suffixes: "
            f"{' '.join(SUFFIXES)}"
        )
    return SUFFIXES[suffix]


def _check(args: argparse.Namespace, form: str) -> None:
    """Raise UserError for wrong usage that is known before anything is opened."""
    times = [time_ns for time_ns in (args.start, args.end) if time_ns is not None]
    target = Path(args.output)
    is_text = form in ON_SCREEN
    rules = (
        (
            is_text or args.output != "-",
            (
                f"{form}: cannot be written to standard output. "
                f"Give a file, or one of these formats: {', '.join(ON_SCREEN)}"
            ),
        ),
        (
            form in TABLES or not args.signals,
            f"--signals: is for tables ({', '.join(TABLES)}), not for {form}",
        ),
        (
            form == BYTES or args.esc is None,
            (
                f"--esc: is for bin, not for {form}. Leave it out, or choose one of several ESCs "
                "with --signals 'NAME.*'."
            ),
        ),
        (
            form != BYTES or not times,
            "--from, --until: cannot be used with bin, which has no times. Leave them out.",
        ),
        (times == sorted(times), "--until: is before --from"),
        (
            is_text or not target.exists() or target.is_file(),
            f"{target}: is not a regular file, which {form} needs. Give another name.",
        ),
    )
    for is_kept, problem in rules:
        if not is_kept:
            raise UserError(problem)


def _esc(args: argparse.Namespace, recording: Input) -> int:
    """Return the index of the ESC of --esc, or of the only one. Raises UserError if unclear."""
    names = [esc.name for esc in recording.bus.escs]
    if args.esc is None and len(names) > 1:
        raise UserError(f"bin: contains the bytes of only one ESC. Give --esc: {', '.join(names)}")
    if args.esc not in (None, *names):
        raise UserError(f"--esc {args.esc}: no such ESC. Available: {', '.join(names)}")
    return names.index(args.esc) if args.esc else 0
