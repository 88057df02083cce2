"""``export``: writes the core in C with the tables of the DBC in use, for a firmware."""

import argparse
from pathlib import Path

from kontronik_can_gw.cli.arguments import LAYOUT, option
from kontronik_can_gw.cli.common import say
from kontronik_can_gw.cli.desk import bus_layout
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.native.export_c import EXAMPLE, MARK, exported
from kontronik_can_gw.native.rows import NotInCore

# fmt: off
OPTIONS = (
    LAYOUT,
    option("LANGUAGE", "c: C99", choices=("c",)),
    option("DIR", "folder to write to; it is made", type=Path),
)
# fmt: on
EPILOG = """\
Writes the gateway's core and, as constants, the tables of the DBC in use: deframer, state of the ESCs, packers, schedule; no CANopen
node. With -c as that configuration sends, otherwise the shipped DBC for one ESC. README.md in the folder says how to build it in.

Files of an earlier export are replaced, but example_main.c, which may be yours by then.

exit codes: 0 done, 1 it cannot be written, 2 wrong usage, configuration or DBC, or what the core in C cannot express
"""


def main(args: argparse.Namespace) -> int:
    """Write the folder. UserError for faulty input files, RunError where it cannot be written."""
    bus = bus_layout(args)
    silent = bus.config is not None and bus.config.dbc.silent_on_loss
    licence = shipped("LICENSE").read_text(encoding="utf-8")
    try:
        files = exported(bus.layout, bus.escs, silent, licence)
    except NotInCore as error:
        raise UserError(f"{bus.layout.file}: not in the core in C: {error}") from None
    if bus.config is not None and bus.config.canopen.enabled:
        say("warning: CANopen nodes are not exported: only the messages of the DBC")
    folder: Path = args.dir
    try:
        _write(folder, files)
    except OSError as error:
        raise RunError(f"{error.filename or folder}: cannot be written: {error.strerror}") from None
    say(f"{folder} written. {folder / 'README.md'} says how to build it in.")
    return 0


def _write(folder: Path, files: dict[str, str]) -> None:
    """Write all files or, where one is not of an earlier export, none. UserError names those."""
    folder.mkdir(parents=True, exist_ok=True)
    there = [folder / name for name in files if (folder / name).exists()]
    own = folder / EXAMPLE
    foreign = [path for path in there if path != own and not _is_exported(path)]
    if foreign:
        raise UserError(*(f"{path}: exists. Give another folder." for path in foreign))
    for name, text in files.items():
        if folder / name == own and own in there:
            say(f"{own} exists and stays as it is")
        else:
            (folder / name).write_text(text, encoding="utf-8")


def _is_exported(path: Path) -> bool:
    with path.open(encoding="utf-8", errors="replace") as file:
        return MARK in file.readline()
