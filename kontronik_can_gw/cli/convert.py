"""``kontronik-can-gw convert``: recordings to tables, CAN logs and plain bytes."""

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from kontronik_can_gw.cli.arguments import names, rate, seconds_ns
from kontronik_can_gw.desk.recordings.convert import (
    BYTES,
    FORMATS,
    LOGS,
    ON_SCREEN,
    STREAMS,
    SUFFIXES,
    TABLES,
)

if TYPE_CHECKING:
    from pathlib import Path

    from kontronik_can_gw.desk.recordings.inputs import Input
    from kontronik_can_gw.desk.recordings.layouts import BusLayout

EPILOG = """\
IN is a capture of this gateway (.kcap; a folder of captures for all parts of a run), a log of CAN frames (candump, Vector ASC or
BLF, PEAK TRC, MF4 bus logging), or plain UART bytes of one ESC. What it is is found out by its content.
IN may be a pipe, or - for standard input: it is first read to its end, into a temporary file (in TMPDIR, else /tmp).

OUT is a table of all values (csv, jsonl, parquet, mf4), a log of the CAN frames (candump, asc, blf, trc, mf4-log), or the plain UART
bytes of one ESC (bin). Its suffix tells which: .csv .jsonl .ndjson .parquet .mf4 .log .candump .asc .blf .trc .bin; --to where it
does not. - is standard output, for text, and through a pipe for bin. Parquet needs pyarrow, MF4 needs asammdf; they are named
where they are missing.

Tables have a row at each telemetry frame, or at each group of CAN frames that belong together. Values hold while they are fresh.
Columns are values by name (battery_voltage [V]; of several ESCs esc1.battery_voltage [V]): of captures and bytes all of them in full
resolution, of CAN logs those that the DBC has.
Time [s] counts from the recording's first row, with --frames from its first frame; Utc is there where the recording knows
the time of day. What is not available is empty in CSV, null in JSON lines and Parquet, NaN or NotAvailable in MF4.
Flags are 0 and 1.

Of a damaged recording everything that is intact is converted, and a summary says what is not.
OUT takes its name only when it is whole; until then it is called OUT.part.

exit codes: 0 converted, also where a part of IN is damaged; 1 there is nothing to convert, something cannot be read or written, or a
library is missing; 2 wrong usage, or IN is no recording
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare IN, OUT and what is wanted of it."""
    from kontronik_can_gw.cli.bus_layout import add_layout_arguments

    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    source = "capture, CAN log or UART bytes; - for standard input"
    parser.add_argument("input", metavar="IN", help=source)
    parser.add_argument("output", metavar="OUT", help="file to write, or - for standard output")
    parser.add_argument("--to", metavar="FORMAT", choices=FORMATS, help=", ".join(FORMATS))
    parser.add_argument("--force", action="store_true", help="write over OUT if it is there")
    parser.add_argument("-q", "--quiet", action="store_true", help="no summary")
    add_layout_arguments(parser)
    part = parser.add_argument_group("a part of it")
    for option, dest, word in (("--from", "start", "from"), ("--until", "end", "up to")):
        text = f"{word} this time after the start, in seconds"
        part.add_argument(option, dest=dest, metavar="S", type=seconds_ns, help=text)
    part.add_argument("--esc", metavar="NAME", help="only the signals (or bytes) of this ESC")
    table = parser.add_argument_group("tables")
    signals = "only these signals, in this order; * and ? stand for others"
    table.add_argument("--signals", metavar="A,B*", type=names, default=[], help=signals)
    text = "rows a second at most, the newest of each period"
    table.add_argument("--rate", metavar="HZ", type=rate, help=text)
    frames = "a row for each CAN frame, with its own signals only"
    table.add_argument("--frames", action="store_true", help=frames)
    units = "jsonl: a first line with the units"
    table.add_argument("--units-line", action="store_true", help=units)
    live_rate = "live frames a second of plain UART bytes, which have no time (default 100)"
    parser.add_argument("--live-rate", metavar="HZ", type=rate, help=live_rate)


def main(args: argparse.Namespace) -> int:
    """Convert args.input. UserError for wrong usage, RunError where something cannot be read or written."""
    form = _format(args)
    _check(args, form)
    try:
        with _ended_by_signals():
            _convert(args, form)
    except KeyboardInterrupt as end:
        _say("stopped: nothing is written" if args.output != "-" else "stopped")
        return 143 if isinstance(end, _Ended) else 130
    return 0


class _Ended(KeyboardInterrupt):
    """SIGTERM, or the terminal was closed: it ends as by Ctrl-C."""


@contextmanager
def _ended_by_signals() -> Iterator[None]:
    """SIGTERM and SIGHUP leave no half file either; what is ignored (nohup) stays ignored."""
    import signal
    import threading

    def end(_number: int, _frame: object) -> None:
        raise _Ended

    numbers = (
        (signal.SIGTERM, signal.SIGHUP)
        if threading.current_thread() is threading.main_thread()
        else ()
    )
    changed = [number for number in numbers if signal.getsignal(number) is signal.SIG_DFL]
    for number in changed:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in changed:
            signal.signal(number, signal.SIG_DFL)


def _convert(args: argparse.Namespace, form: str) -> None:
    import time
    from pathlib import Path

    from kontronik_can_gw.cli.bus_layout import bus_layout
    from kontronik_can_gw.cli.progress import Progress
    from kontronik_can_gw.desk.recordings.convert import Output, reason
    from kontronik_can_gw.errors import RunError, UserError

    source = Path(args.input)
    target = None if args.output == "-" else Path(args.output)
    layout = bus_layout(args.config, args.dbc) if args.config or args.dbc else None
    begun = time.monotonic()
    with _opened(args, source, layout) as recording:
        if args.live_rate is not None and not recording.times_assumed:
            raise UserError(
                f"--live-rate is for plain UART bytes: {recording.name} has times of its own. Leave it out."
            )
        conversion = _conversion(args, form, recording)
        name, size = source.name or recording.name, recording.size or None
        try:
            with Progress(name, size, target is None) as progress, Output(target, form) as out:
                summary = conversion(recording, out, progress.reach)
        except BrokenPipeError:
            raise
        except OSError as error:
            where = target or "standard output"
            raise RunError(f"{where}: cannot be written: {reason(error)}.") from None
        _report(args, form, recording, summary, time.monotonic() - begun)


def _report(
    args: argparse.Namespace, form: str, recording: "Input", summary: str | None, seconds: float
) -> None:
    """Say what was written, and what of the recording was not intact. RunError where there was nothing."""
    from kontronik_can_gw.desk.recordings.inputs import LIVE_RATE, CanLogInput
    from kontronik_can_gw.errors import RunError

    damage = [line for line in recording.damage if line not in recording.notes]
    if summary is None:
        raise RunError(*_nothing(args, recording, damage))
    notes = recording.notes if form in TABLES else []
    if not args.quiet:
        others = recording.others if isinstance(recording, CanLogInput) else 0
        if form in TABLES and not notes and others:
            summary += f", {others} other frames left out"
        where = "standard output" if args.output == "-" else args.output
        _say(f"{where}: {summary}, in {seconds:.1f} s")
        if recording.times_assumed and form != BYTES:
            live_rate = args.live_rate or LIVE_RATE
            _say(f"times are assumed: {live_rate:g} live frames a second (--live-rate)")
    for line in notes:
        _say(f"{args.input}: {line}")
    for line in damage:
        _say(f"{args.input}: damaged: {line}")


def _opened(args: argparse.Namespace, source: "Path", layout: "BusLayout | None") -> "Input":
    """The recording; of a pipe with a bar while it is read into a file."""
    from kontronik_can_gw.cli.progress import Progress
    from kontronik_can_gw.desk.recordings.inputs import LIVE_RATE, open_input
    from kontronik_can_gw.desk.recordings.spool import is_stream

    rate = args.live_rate or LIVE_RATE
    if not is_stream(source):
        return open_input(source, layout, rate)
    with Progress(f"reading {source}", None, args.output == "-") as progress:
        return open_input(source, layout, rate, progress.reach)


def _conversion(
    args: argparse.Namespace, form: str, recording: "Input"
) -> "Callable[..., str | None]":
    """What is to be done with recording, output and progress. UserError for what the recording has not."""
    from functools import partial

    from kontronik_can_gw.desk.recordings.convert import to_bytes, to_log, to_table
    from kontronik_can_gw.desk.recordings.tables.rows import Choice, fields_of_frames

    if form == BYTES:
        return partial(to_bytes, esc=_esc(args, recording, needed=True) or 0)
    if form in LOGS:
        return partial(to_log, form=LOGS[form], start_ns=args.start, end_ns=args.end)
    times = {"start_ns": args.start, "end_ns": args.end, "rate": args.rate}
    fields = fields_of_frames(recording) if args.frames else recording.fields
    choice = Choice.of(fields, args.signals, _esc(args, recording), **times)
    more = {"by_frame": args.frames, "units_line": args.units_line}
    return partial(to_table, form=form, choice=choice, **more)


def _format(args: argparse.Namespace) -> str:
    from pathlib import Path

    from kontronik_can_gw.errors import UserError

    if args.to:
        return str(args.to)
    if args.output == "-":
        raise UserError(
            f"to standard output goes text: give --to: {', '.join(ON_SCREEN)}; bin through a pipe"
        )
    if Path(args.output).is_dir():
        raise UserError(f"{args.output}: is a directory. Give a file.")
    suffix = Path(args.output).suffix.lower()
    if suffix not in SUFFIXES:
        raise UserError(
            f"{args.output}: its suffix tells no format. Give --to, or one of these suffixes: {' '.join(SUFFIXES)}"
        )
    return SUFFIXES[suffix]


def _check(args: argparse.Namespace, form: str) -> None:
    """Wrong usage that is known before anything is opened. UserError."""
    import sys
    from pathlib import Path

    from kontronik_can_gw.errors import UserError

    if args.output == "-" and form not in STREAMS:
        raise UserError(
            f"{form} cannot go to standard output. Give a file, or one of these: {', '.join(STREAMS)}"
        )
    if args.output == "-" and form == BYTES and sys.stdout.isatty():
        raise UserError("bin cannot go to a terminal. Give a file, or a pipe behind it.")
    given = {"--signals": args.signals, "--rate": args.rate, "--frames": args.frames}
    if form not in TABLES:
        for option, value in given.items():
            if value:
                raise UserError(f"{option} is for tables ({', '.join(TABLES)}), not for {form}")
    if args.units_line and form != "jsonl":
        raise UserError(f"--units-line is for jsonl, not for {form}")
    if args.esc is not None and form in LOGS:
        raise UserError(f"--esc is for tables and bin: {form} holds the frames as they are")
    if form == BYTES and (args.start is not None or args.end is not None):
        raise UserError("--from and --until are not for bin, which has no times")
    if form == BYTES and args.live_rate is not None:
        raise UserError("--live-rate is not for bin, which has no times")
    if args.start is not None and args.end is not None and args.end < args.start:
        raise UserError("--until is before --from")
    if args.output == "-":
        return
    target = Path(args.output)
    try:
        if target.is_dir():
            raise UserError(f"{target}: is a directory. Give a file.")
        if not target.exists():
            return
        source = Path(args.input)
        if source.exists() and source.samefile(target):
            raise UserError(f"{target}: is IN. Give another OUT.")
        if target.is_file():
            if not args.force:
                raise UserError(f"{target}: is there already. Give --force to write over it.")
        elif form not in (*ON_SCREEN, BYTES):
            raise UserError(f"{target}: is no plain file, into which {form} cannot be written")
    except (OSError, ValueError) as error:
        raise UserError(
            f"{target}: cannot be written: {getattr(error, 'strerror', None) or error}."
        ) from None


def _esc(args: argparse.Namespace, recording: "Input", needed: bool = False) -> int | None:
    """Index of the ESC that --esc names; None where none is named and none is needed. UserError."""
    from kontronik_can_gw.errors import UserError

    names = [esc.name for esc in recording.bus.escs]
    if args.esc is None:
        if not needed:
            return None
        if len(names) > 1:
            raise UserError(f"bin holds the bytes of one ESC. Give --esc: {', '.join(names)}")
        return 0
    if args.esc not in names:
        raise UserError(f"--esc {args.esc}: there is no such ESC. There are: {', '.join(names)}")
    return names.index(args.esc)


def _nothing(args: argparse.Namespace, recording: "Input", damage: list[str]) -> list[str]:
    """Why there is nothing to convert."""
    from kontronik_can_gw.desk.recordings.inputs import CanLogInput

    lines = [f"{args.input}: damaged: {line}" for line in damage]
    if args.start is not None or args.end is not None:
        return [*lines, f"{args.input}: nothing in it is between --from and --until"]
    file = recording.bus.layout.file
    if isinstance(recording, CanLogInput) and not recording.others:
        return [*lines, f"{args.input}: nothing in it can be converted: it has no CAN frame."]
    return [
        *lines,
        f"{args.input}: nothing in it can be converted: no frame of {file}. Give the right DBC by --dbc or -c.",
    ]


def _say(text: str) -> None:
    from kontronik_can_gw.cli import say

    say(text, "convert")
