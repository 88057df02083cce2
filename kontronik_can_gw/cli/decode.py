"""``decode``: a table of recorded UART bytes on standard output, as ``convert`` makes it."""

import argparse

from kontronik_can_gw.cli import convert, make_parser
from kontronik_can_gw.cli.arguments import option
from kontronik_can_gw.desk.recordings.inputs import open_bytes

OPTIONS = (
    option("FILE", "file of UART bytes"),
    option("--csv", "CSV with a header instead of JSON lines"),
)
EPILOG = """\
The same as kontronik-can-gw convert FILE - --to jsonl (or csv), and FILE is taken for the bytes of one ESC, whatever is in it: a row
for each live frame, with all values. Where no frame is found a line says what the bytes look like.

exit codes: 0 decoded, also where a part of FILE is damaged; 1 no frame is found, or something cannot be read or written; 2 wrong usage
"""


def main(args: argparse.Namespace) -> int:
    """Decode args.file. RunError where something cannot be opened, read or written."""
    form = "csv" if args.csv else "jsonl"
    given = make_parser(["convert"]).parse_args(["convert", "--to", form, "--", args.file, "-"])
    given.command = args.command
    return convert.main(given, open_bytes)
