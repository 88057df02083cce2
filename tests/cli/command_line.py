"""A command within this process: its exit code and what it writes. For whatever a process of its own is not needed."""

import io
import sys
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

from kontronik_can_gw.cli import main


class Done(NamedTuple):
    code: object
    data: bytes
    """What went to standard output."""
    err: str

    @property
    def out(self) -> str:
        return self.data.decode()


def output() -> io.TextIOWrapper:
    """A stream as standard output is."""
    return io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True)


def written_to(stream: io.TextIOWrapper) -> bytes:
    """What an ``output`` holds."""
    assert isinstance(stream.buffer, io.BytesIO)
    return stream.buffer.getvalue()


def run(*words: object, given: bytes | None = None, out: io.TextIOWrapper | None = None) -> Done:
    """An exception fails the test. ``given``: standard input."""
    out, err = out or output(), output()
    stdin = sys.stdin if given is None else io.TextIOWrapper(io.BytesIO(given))
    code: object
    with patch.multiple(sys, stdin=stdin, stdout=out, stderr=err):
        try:
            code = main([str(word) for word in words])
        except SystemExit as end:
            code = end.code
    return Done(code, written_to(out), written_to(err).decode())


def refused(code: int, *words: object, given: bytes | None = None) -> str:
    """The one line, without the program's name, of a command that fails with this exit code and writes nothing else."""
    done = run(*words, given=given)
    lines = done.err.splitlines()
    assert (done.code, done.out, "Traceback" in done.err) == (code, "", False), done
    usage = [line for line in lines if line.startswith(("usage:", " "))]
    assert len(lines) - len(usage) == 1, done.err
    return lines[-1].partition(": ")[2]


def written(path: Path, text: str | bytes) -> Path:
    """A file with this content."""
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path
