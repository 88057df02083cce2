"""Writes output files. All commands follow these rules:

1. A file that exists is replaced only with ``--force``.
2. A file that the command reads is never overwritten, also not through a link or with ``--force``.
3. A file has the name OUT.part until it is complete, and is locked. An OUT.part of another command
   is not touched; ``--force`` replaces it if it is not being written.
4. If writing fails or a signal ends it, the incomplete file is removed.
5. A symbolic link is replaced, not followed.
6. A pipe or a device is written to directly. ``-`` is standard output.
"""

import argparse
import sys
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from kontronik_can_gw.cli import discard_output, say
from kontronik_can_gw.cli.arguments import default_config
from kontronik_can_gw.cli.common import stopping_on_signals
from kontronik_can_gw.config.parse import load
from kontronik_can_gw.desk.recordings.convert import OutputFile, check_part, part_beside
from kontronik_can_gw.desk.recordings.stream import is_standard_input
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.printable import printable

STOPPED = 130
"""Exit code after a signal."""


def check_output(output: str, inputs: Iterable[Path], *, force: bool) -> None:
    """Raise UserError if a file must not be written.

    ``inputs`` are the files that the command reads.
    """
    if not output.strip():
        raise UserError("-o: is empty. Give a file, or - for standard output.")
    if output == "-":
        return
    target = Path(output)
    part = part_beside(target)
    for path in inputs:
        for written in (target, part):
            with suppress(OSError):
                if written.samefile(path):
                    raise UserError(
                        f"{output}: would overwrite the input {path}. Give another name."
                    )
    try:
        is_folder = target.is_dir()
        is_file = target.is_file() or (target.is_symlink() and not target.exists())
    except OSError as error:  # for example: the name is too long
        raise RunError(f"{output}: cannot be written: {error.strerror}.") from None
    if is_folder:
        raise UserError(f"{output}: is a folder. Give a file.")
    if is_file and not force:
        raise UserError(f"{output}: exists. Give another name, or --force to replace it.")
    check_part(part, force=force)


def configuration_files(config: Path | None, dbc: Path | None = None) -> list[Path]:
    """Return the files that are read for ``-c`` and ``--dbc``.

    These are the configuration, its DBC and its EDS. Without ``-c``, commands read the default
    configuration, even if they then use no part of it.
    """
    found = [] if dbc is None else [dbc]
    if config is None:
        default = default_config()
        found += [] if default is None else [default]
    else:
        loaded = load(config)
        found += [config, loaded.dbc_path, loaded.eds_path]
    return found


def recording_files(path: Path) -> list[Path]:
    """Return the files of a recording.

    ``path`` is a file, a folder, or the beginning of the names of several files.
    """
    if is_standard_input(path):
        return [Path("/dev/stdin")]
    with suppress(OSError):  # opening it reports the reason
        if path.is_file():
            return [path]
        if path.is_dir():
            return list(path.iterdir())
        return [each for each in path.parent.iterdir() if each.name.startswith(path.name)]
    return []


def output_of(args: argparse.Namespace, name: str, default: str | None = None) -> str:
    """Return the output that is given with ``-o`` or as the argument ``name``.

    Raises UserError if both are given, and if there is neither an output nor a default.
    """
    outputs = (args.output, getattr(args, name.lower()))
    given = [output for output in outputs if output is not None]
    if len(given) > 1:
        raise UserError(f"{name} and -o: both are outputs. Give only one.")
    if not given and default is None:
        raise UserError(f"no output. Give {name}, or -o {name}.")
    return str(given[0]) if given else str(default)


@contextmanager
def writing(
    output: str,
    *,
    force: bool,
    is_part_kept: bool = False,
    is_handling_signals: bool = True,
) -> Iterator[OutputFile]:
    """Open an output for writing. Raises RunError if it cannot be written.

    ``force``: an existing file is replaced. ``is_part_kept``: if writing fails, OUT.part stays.
    ``is_handling_signals``: SIGTERM, SIGINT and SIGHUP raise KeyboardInterrupt, which is reported.
    Without it the caller handles them.
    """
    out = OutputFile(None if output == "-" else Path(output), force=force)
    out.is_part_kept = is_part_kept
    try:
        with ExitStack() as stack:
            if is_handling_signals:
                stack.enter_context(stopping_on_signals(interrupt))
            stack.enter_context(out)
            yield out
    except KeyboardInterrupt:
        if is_handling_signals:
            say(stopped(output))
        raise
    except BrokenPipeError:
        raise
    except OSError as error:
        where = output
        if output == "-":
            where = "standard output"
            discard_output()  # otherwise Python tries to write the buffer again when it exits
        kept = f" The data so far are in {out.kept_part}." if out.kept_part else ""
        raise RunError(f"{where}: cannot be written: {error.strerror}.{kept}") from None


def write_output(
    output: str,
    text: str,
    inputs: Iterable[Path] = (),
    *,
    force: bool,
    encoding: str = "utf-8",
) -> None:
    """Write text to a file and report that, or to standard output for ``-``.

    Line ends are not changed.
    """
    check_output(output, inputs, force=force)
    if output == "-":
        shown = printable(text, keep="\r\n\t") if sys.stdout.isatty() else text
        sys.stdout.buffer.write(shown.encode(encoding))
        return
    with writing(output, force=force) as out:
        out.open().write(text.encode(encoding))
        out.is_whole = True
    say(f"{output} written")


def interrupt() -> None:
    """Raise KeyboardInterrupt, as a handler of signals."""
    raise KeyboardInterrupt


def stopped(output: str) -> str:
    """Return the message after a signal has ended the writing of an output."""
    return "stopped" if output == "-" else f"stopped: {output} was not written"
