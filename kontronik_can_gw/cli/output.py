"""Where ``-o`` of a command goes: a file, or standard output."""

import io
import sys
from pathlib import Path

from kontronik_can_gw.cli.common import say
from kontronik_can_gw.desk.recordings.convert import Output
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.printable import printable


def write_output(where: str, text: str, encoding: str = "utf-8") -> None:
    """Write text to a file and say so, or to standard output for ``-``; line ends stay. RunError where it cannot be written."""
    if where == "-" and sys.stdout.isatty():
        text = printable(text, keep="\r\n\t")
    data = text.encode(encoding)
    if where != "-":
        _write_file(Path(where), data)
        say(f"{where} written")
    elif isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.buffer.write(data)
    else:
        sys.stdout.write(text)


def _write_file(path: Path, data: bytes) -> None:
    try:
        with Output(path, what="-o") as out:
            out.open().write(data)
            out.is_whole = True
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {error.strerror}. Give another -o.") from None
