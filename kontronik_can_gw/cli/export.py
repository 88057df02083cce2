"""``export``: writes the core in C with the tables of the DBC in use, for a firmware."""

import argparse
import os
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

from kontronik_can_gw.cli.arguments import option
from kontronik_can_gw.cli.common import say, stopping_on_signals
from kontronik_can_gw.cli.desk import bus_layout
from kontronik_can_gw.cli.output import (
    check_output,
    configuration_files,
    interrupt,
    output_of,
    stopped,
    writing,
)
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.desk.export_c import EXAMPLE, exported
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.native.rows import NotInCore

OPTIONS = (
    (
        option("-c --config FILE", "export the messages of this TOML configuration", type=Path),
        option("--dbc FILE", "export this DBC instead of the shipped one", type=Path),
    ),
    option("LANGUAGE", "c: C99", choices=("c",)),
    option("DIR", "folder to write to, which is created", nargs="?"),
    option("-o --output DIR", "another way to give DIR"),
    option("--force", "replace files that exist, for example of an earlier export"),
)
EPILOG = """\
Writes the gateway's core in C (deframer, state of the ESCs, packers, schedule),
and the tables of the DBC in use as constants. CANopen nodes are not included.
With -c, or if there is a gateway.toml, it exports the messages of that
configuration. Otherwise, and with --dbc, it exports the given or the shipped
DBC for one ESC. README.md in the folder explains how to use the files.

Files that exist, for example of an earlier export, are replaced only with
--force. example_main.c is never replaced, because you may have changed it.

exit codes: 0 done; 1 a file cannot be written; 2 wrong usage, configuration or
DBC, or the core in C cannot express a message
"""


def main(args: argparse.Namespace) -> int:
    """Write the folder. Raises UserError for faulty input files, RunError if writing fails."""
    folder = Path(output_of(args, "DIR"))
    bus = bus_layout(args)
    settings = CoreSettings(bus.escs, bus.layout)
    if bus.config is not None:
        settings = bus.config.core_settings(bus.escs, bus.layout)
    licence = shipped("LICENSE").read_text(encoding="utf-8")
    try:
        files = exported(settings, licence)
    except NotInCore as error:
        raise UserError(f"{bus.layout.file}: cannot be exported: {error}") from None
    if bus.config is not None and bus.config.canopen.enabled:
        say("warning: CANopen nodes are not exported, only the messages of the DBC")
    try:
        inputs = configuration_files(args.config, args.dbc)
        _write(
            folder,
            files,
            inputs,
            force=args.force,
        )
    except OSError as error:
        raise RunError(
            f"{error.filename or folder}: cannot be written: {error.strerror}. Give another folder."
        ) from None
    say(f"{folder} written. To build it into a firmware, see {folder / 'README.md'}.")
    return 0


def _write(folder: Path, files: dict[str, str], inputs: Sequence[Path], *, force: bool) -> None:
    """Write all files, or no file if one of them must not be written. The user's example stays."""
    own = folder / EXAMPLE
    is_kept = own.exists()
    if is_kept:
        say(f"{own} exists and is kept")
        del files[EXAMPLE]
    problems: list[str] = []
    for name in files:
        try:
            check_output(str(folder / name), inputs, force=force)
        except UserError as error:
            problems += error.problems
    if problems:
        raise UserError(*problems)
    _write_all(folder, files, force=force)


def _write_all(folder: Path, files: dict[str, str], *, force: bool) -> None:
    """Write all files, or leave the folder as it was if one of them cannot be written."""
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            stack.enter_context(stopping_on_signals(interrupt))
            outputs = []
            for name, text in files.items():
                path = str(folder / name)
                out = stack.enter_context(writing(path, force=force, is_handling_signals=False))
                outputs.append(out)
                file = out.open()
                file.write(text.encode())
                file.flush()
                os.fsync(file.fileno())  # a full disk is noticed before any file gets its name
            for out in outputs:
                out.is_whole = True
    except BaseException as error:
        with suppress(OSError):
            for created in made:
                created.rmdir()
        if isinstance(error, KeyboardInterrupt):
            say(stopped(str(folder)))
        raise
