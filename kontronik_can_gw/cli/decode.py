"""``kontronik-can-gw decode``: recorded UART bytes to JSON lines or CSV."""

import argparse

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
    import os
    import stat
    import sys
    from contextlib import ExitStack
    from pathlib import Path

    from kontronik_can_gw.cli.progress import Progress
    from kontronik_can_gw.desk.recordings import decode
    from kontronik_can_gw.errors import RunError, UserError

    name = "standard input" if args.file == "-" else args.file
    with ExitStack() as stack:
        try:
            if args.file == "-":
                fd = 0
            else:
                fd = os.open(args.file, os.O_RDONLY | os.O_CLOEXEC | os.O_NOCTTY)
                stack.callback(os.close, fd)
            status = os.fstat(fd)
        except (OSError, ValueError) as error:
            raise RunError(
                f"{name}: cannot be opened: {_reason(error)}. Give a file of recorded UART bytes."
            ) from None
        if stat.S_ISDIR(status.st_mode):
            raise RunError(f"{name}: is a directory. Give a file of recorded UART bytes.")
        is_file = stat.S_ISREG(status.st_mode)

        stats = None
        if args.stats is not None:
            try:
                target = Path(args.stats)
                if is_file and target.exists() and os.path.samestat(target.stat(), status):
                    raise UserError(f"--stats {args.stats}: is the input. Give another file.")
                stats = stack.enter_context(target.open("w", encoding="utf-8"))
            except (OSError, ValueError) as error:
                raise RunError(
                    f"--stats {args.stats}: cannot be written: {_reason(error)}."
                ) from None

        out = sys.stdout

        def write(text: str) -> None:
            try:
                out.write(text)
                if not is_file or not text:
                    out.flush()
            except BrokenPipeError:
                raise
            except OSError as error:
                # what is buffered has nowhere to go
                os.dup2(os.open(os.devnull, os.O_WRONLY), out.fileno())
                raise RunError(f"standard output: cannot be written: {_reason(error)}.") from None

        decoder = decode.Decoder()
        code = 0
        failure = None
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
            import json

            try:
                stats.write(json.dumps(decoder.counters.as_dict(), indent=2) + "\n")
                stats.flush()
            except OSError as error:
                raise RunError(
                    f"--stats {args.stats}: cannot be written: {_reason(error)}."
                ) from None
        if failure is not None:
            raise failure
    return code


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
