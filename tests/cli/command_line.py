"""Run a command line in this process, if the test does not need a separate process."""

import io
import sys
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

from kontronik_can_gw.cli import main


class Done(NamedTuple):
    """The exit code and the output of a command."""

    code: object
    data: bytes
    """Standard output."""
    err: str
    """Standard error."""

    @property
    def out(self) -> str:
        return self.data.decode()


def output() -> io.TextIOWrapper:
    """Return a stream that is like standard output."""
    return io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True)


def written_to(stream: io.TextIOWrapper) -> bytes:
    """Return the bytes written to an ``output``."""
    assert isinstance(stream.buffer, io.BytesIO)
    return stream.buffer.getvalue()


def run(*words: object, given: bytes | None = None, out: io.TextIOWrapper | None = None) -> Done:
    """Run a command line. ``given`` is its standard input. An exception fails the test."""
    out = out or output()
    err = output()
    stdin = sys.stdin if given is None else io.TextIOWrapper(io.BytesIO(given))
    code: object
    with patch.multiple(sys, stdin=stdin, stdout=out, stderr=err):
        try:
            code = main([str(word) for word in words])
        except SystemExit as end:
            code = end.code
    return Done(code, written_to(out), written_to(err).decode())


def refused(code: int, *words: object, given: bytes | None = None) -> str:
    """Run a command that must fail with this exit code and a single line of error.

    Returns the line without the name of the program.
    """
    done = run(*words, given=given)
    lines = done.err.splitlines()
    assert done.code == code, done
    assert done.out == "", done
    assert "Traceback" not in done.err, done
    (line,) = lines
    return line.partition(": ")[2]


def written(path: Path, text: str | bytes) -> Path:
    """Write a file with this content and return its path."""
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path
