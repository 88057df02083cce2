"""``kontronik-can-gw decode``: recorded UART bytes to JSON lines or CSV."""

import argparse
from contextlib import contextmanager
from typing import TYPE_CHECKING

from kontronik_can_gw.errors import RunError, UserError

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Iterator
    from contextlib import ExitStack
    from typing import TextIO

EPILOG = """\
FILE holds the bytes as they came over the UART, nothing else; - is standard input, decoded as it comes.
Frames go to standard output in file order, as JSON objects or CSV rows; a summary goes to standard error.
Values are physical (V, A, mAh, 1/min, us, %, deg C). BEC current is null once the device is known to be a JIVEPro, which
does not supply it. "suspect" marks a legacy live frame whose unprotected bytes are impossible.

exit codes: 0 the input was read to its end, even if no frame was found in it (then a line says what may be wrong);
1 something cannot be opened, read or written; 2 wrong usage
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare FILE, --csv, --stats."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    parser.add_argument("file", metavar="FILE", help="file of UART bytes, or - for standard input")
    parser.add_argument(
        "--csv", action="store_true", help="CSV with a header instead of JSON lines"
    )
    parser.add_argument(
        "--stats", metavar="FILE", help="write the counters to FILE as JSON when done"
    )


def main(args: argparse.Namespace) -> int:
    """Decode args.file. RunError where something cannot be opened, read or written."""
    import json
    import stat
    import sys
    from contextlib import ExitStack

    from kontronik_can_gw.cli.progress import Progress
    from kontronik_can_gw.desk.recordings import decode

    name = "standard input" if args.file == "-" else args.file
    code = 0
    failure = None
    with ExitStack() as stack:
        fd, status = _input(args.file, name, stack)
        is_file = stat.S_ISREG(status.st_mode)
        stats = _stats(args.stats, status if is_file else None, stack)
        write = _writer(flush=not is_file)
        decoder = decode.Decoder()
        try:
            with Progress(name, status.st_size if is_file else None) as progress:
                if args.csv:
                    write(decode.csv_header())
                lines = decode.csv_lines if args.csv else decode.json_lines
                decode.decode_stream(decoder, fd, write, lines=lines, advance=progress.advance)
        except BrokenPipeError:
            raise
        except OSError as error:
            failure = RunError(f"{name}: cannot be read: {_reason(error)}.")
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


def _input(file: str, name: str, stack: "ExitStack") -> "tuple[int, os.stat_result]":
    """Descriptor and status of the input. RunError where it cannot be opened."""
    import os
    import stat

    fd = 0
    try:
        if file != "-":
            fd = os.open(file, os.O_RDONLY | os.O_CLOEXEC | os.O_NOCTTY)
            stack.callback(os.close, fd)
        status = os.fstat(fd)
    except (OSError, ValueError) as error:
        raise RunError(
            f"{name}: cannot be opened: {_reason(error)}. Give a file of recorded UART bytes."
        ) from None
    if stat.S_ISDIR(status.st_mode):
        raise RunError(f"{name}: is a directory. Give a file of recorded UART bytes.")
    return fd, status


def _stats(
    path: str | None, of_input: "os.stat_result | None", stack: "ExitStack"
) -> "TextIO | None":
    """The file of --stats, opened. UserError where it is the input, a file of this status."""
    import os
    from pathlib import Path

    if path is None:
        return None
    with _writing(f"--stats {path}"):
        target = Path(path)
        if of_input is not None and target.exists() and os.path.samestat(target.stat(), of_input):
            raise UserError(f"--stats {path}: is the input. Give another file.")
        return stack.enter_context(target.open("w", encoding="utf-8"))


def _writer(flush: bool) -> "Callable[[str], None]":
    """A function that writes to standard output; ``flush``: at once, as it does for an empty text."""
    import sys

    from kontronik_can_gw.cli import discard_output

    out = sys.stdout

    def write(text: str) -> None:
        try:
            with _writing("standard output"):
                out.write(text)
                if flush or not text:
                    out.flush()
        except RunError:
            discard_output()  # what is buffered has nowhere to go
            raise

    return write


@contextmanager
def _writing(what: str) -> "Iterator[None]":
    """RunError where something cannot be written; the reader of a pipe may end."""
    try:
        yield
    except BrokenPipeError:
        raise
    except (OSError, ValueError) as error:
        raise RunError(f"{what}: cannot be written: {_reason(error)}.") from None


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
