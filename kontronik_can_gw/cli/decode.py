"""``decode``: recorded UART bytes to JSON lines or CSV."""

import argparse
import json
import os
import stat
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TextIO

from kontronik_can_gw.cli import discard_output
from kontronik_can_gw.cli.arguments import option
from kontronik_can_gw.cli.progress import Progress
from kontronik_can_gw.desk.recordings import decode
from kontronik_can_gw.errors import RunError, UserError

OPTIONS = (
    option("FILE", "file of UART bytes, or - for standard input"),
    option("--csv", "CSV with a header instead of JSON lines"),
    option("--stats FILE", "write the counters to FILE as JSON when done"),
)
EPILOG = """\
FILE holds the bytes as they came over the UART, nothing else; - is standard input, decoded as it comes.
Frames go to standard output in file order, as JSON objects or CSV rows; a summary goes to standard error.
Values are physical (V, A, mAh, 1/min, us, %, deg C). BEC current is null once the device is known to be a JIVEPro, which
does not supply it. "suspect" marks a legacy live frame whose unprotected bytes are impossible.

exit codes: 0 the input was read to its end, even if no frame was found in it (then a line says what may be wrong);
1 something cannot be opened, read or written; 2 wrong usage
"""


def main(args: argparse.Namespace) -> int:
    """Decode args.file. RunError where something cannot be opened, read or written."""
    name = "standard input" if args.file == "-" else args.file
    failure, code = None, 0
    with ExitStack() as stack:
        fd, status = _opened(args.file, name, stack)
        size = status.st_size if stat.S_ISREG(status.st_mode) else None
        stats = _stats_file(args.stats, status, stack) if args.stats is not None else None
        decoder = decode.Decoder()

        def write(text: str) -> None:
            with _writing("standard output"):
                sys.stdout.write(text)
                if size is None or not text:
                    sys.stdout.flush()

        try:
            with Progress(name, size) as progress:
                if args.csv:
                    write(decode.csv_header())
                lines = decode.csv_lines if args.csv else decode.json_lines
                decode.decode_stream(decoder, fd, write, lines=lines, advance=progress.advance)
        except BrokenPipeError:
            raise
        except OSError as error:
            failure = RunError(f"{name}: cannot be read: {error.strerror}.")
        except KeyboardInterrupt:
            code = 130
        write("")
        print(decode.summary(decoder.counters), file=sys.stderr)
        if stats is not None:
            with _writing(f"--stats {args.stats}"):
                stats.write(json.dumps(decoder.counters.as_dict(), indent=2) + "\n")
                stats.flush()
        if failure is not None:
            raise failure
    return code


def _opened(file: str, name: str, stack: ExitStack) -> tuple[int, os.stat_result]:
    """The input's descriptor, and what it is."""
    try:
        fd = 0
        if file != "-":
            fd = os.open(file, os.O_RDONLY | os.O_CLOEXEC | os.O_NOCTTY)
            stack.callback(os.close, fd)
        status = os.fstat(fd)
    except OSError as error:
        raise RunError(
            f"{name}: cannot be opened: {error.strerror}. Give a file of recorded UART bytes."
        ) from None
    if stat.S_ISDIR(status.st_mode):
        raise RunError(f"{name}: is a directory. Give a file of recorded UART bytes.")
    return fd, status


def _stats_file(file: str, source: os.stat_result, stack: ExitStack) -> TextIO:
    """The file for the counters; UserError where it is the input."""
    with _writing(f"--stats {file}"):
        target = Path(file)
        is_input = target.exists() and os.path.samestat(target.stat(), source)
        if is_input and stat.S_ISREG(source.st_mode):
            raise UserError(f"--stats {file}: is the input. Give another file.")
        return stack.enter_context(target.open("w", encoding="utf-8"))


@contextmanager
def _writing(what: str) -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        if what == "standard output":
            discard_output()  # what is buffered has nowhere to go
        raise RunError(f"{what}: cannot be written: {error.strerror}.") from None
