"""``decode``: writes a table of recorded UART bytes to standard output, as ``convert`` does."""

import argparse

from kontronik_can_gw.cli import convert, make_parser
from kontronik_can_gw.cli.arguments import OUTPUT, option
from kontronik_can_gw.desk.recordings.inputs import open_bytes

OPTIONS = (
    option("FILE", "file or pipe of UART bytes, or - for standard input"),
    option("--csv", "CSV with a header instead of JSON lines"),
    *OUTPUT,
)
EPILOG = """\
Decodes like kontronik-can-gw convert FILE - --to jsonl (or csv), but treats
FILE as the bytes of one ESC. There is a row for each live frame, with all
values. If no frame is found, a line describes the bytes. The bytes of a pipe
are decoded as they arrive.

examples:
  kontronik-can-gw decode esc.bin --csv
  cat esc.bin | kontronik-can-gw decode -

exit codes: 0 decoded, also if a part of FILE is damaged; 1 there is nothing to
decode, or the output cannot be written; 2 wrong usage, or FILE cannot be opened
or is not a recording; 130 stopped by a signal
"""


def main(args: argparse.Namespace) -> int:
    """Decode ``args.file``. Raises RunError if it has no frame, or the output cannot be written."""
    form = "csv" if args.csv else "jsonl"
    given = make_parser(["convert"]).parse_args(["convert", "--to", form, "--", args.file])
    given.output = args.output
    given.force = args.force
    given.command = args.command
    return convert.main(given, open_bytes)
