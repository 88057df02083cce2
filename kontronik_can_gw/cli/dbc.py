"""``dbc``: writes the DBC of several ESCs from a one-ESC DBC, or of exactly what a configuration or its CANopen nodes send."""

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING

from kontronik_can_gw.canopen.dbc import database as canopen_database
from kontronik_can_gw.canopen.dbc import waiting_for_lss
from kontronik_can_gw.cli.common import canopen_of, load_all, say, write_output
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.config.nodes import shipped_canopen
from kontronik_can_gw.config.parse import name_problem
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings

if TYPE_CHECKING:
    from cantools.database.can import Database

    from kontronik_can_gw.dbc.rows import Rows

_MAX_NODES = 127


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "-c",
        "--config",
        type=Path,
        metavar="FILE",
        help="write the DBC of what this configuration sends",
    )
    parser.add_argument(
        "--canopen",
        action="store_true",
        help="describe what the CANopen nodes send: PDOs as they are mapped now, heartbeats, emergencies",
    )
    parser.add_argument(
        "--from",
        type=Path,
        dest="source",
        metavar="DBC",
        help="one-ESC DBC to start from (default: the shipped one)",
    )
    parser.add_argument(
        "--esc", type=_count, metavar="N", help="number of ESCs (default 1, or the number of names)"
    )
    parser.add_argument(
        "--name",
        action="append",
        type=_name,
        metavar="NAME",
        help="name of an ESC, once for each, in order (default esc1, esc2 ...)",
    )
    parser.add_argument("--base-id", type=_id, metavar="X", help="lowest CAN id, as 0x680 or 1664")
    parser.add_argument(
        "--id-step",
        type=_id,
        metavar="X",
        help="distance of the ids from ESC to ESC (default: the smallest without a clash)",
    )
    parser.add_argument(
        "--node",
        metavar="NODE",
        help="transmitter node of our messages (default: the only one that sends)",
    )
    parser.add_argument(
        "-o", "--output", metavar="FILE", default="-", help="where to (default: standard output)"
    )
    parser.epilog = (
        "Prints a DBC that every tool reads; warnings go to standard error. "
        "Exit code: 0 done, 1 it cannot be written, 2 wrong usage, configuration or DBC."
    )


def main(args: argparse.Namespace) -> int:
    from kontronik_can_gw.dbc.writer import dbc_text

    text = dbc_text(_canopen(args) if args.canopen else _database(args))
    try:
        text.encode("cp1252")  # the encoding that tools assume; usually the text is ASCII
        encoding = "cp1252"
    except UnicodeEncodeError:
        encoding = "utf-8"
        say(
            "warning: written in UTF-8, because it has characters that Windows-1252, the usual encoding of a DBC, has not"
        )
    write_output(args.output, text, encoding)
    return 0


def _canopen(args: argparse.Namespace) -> "Rows":
    """The DBC of the configured nodes, or of nodes from the shipped EDS with node-IDs from 1."""
    _refuse(
        args,
        ("from", "base_id", "id_step", "node"),
        "--canopen, which describes the nodes as they are",
    )
    if args.config is not None:
        _refuse(args, ("esc", "name"), "--config, which says all that")
        loaded = load_all(args.config)
        setup, escs = canopen_of(loaded), loaded.escs
    else:
        escs = _escs(args)
        if len(escs) > _MAX_NODES:
            raise UserError(
                f"--esc: {len(escs)} are more than the {_MAX_NODES} nodes that a CANopen bus has"
            )
        setup = shipped_canopen(range(1, len(escs) + 1))
        escs = setup.esc_settings(escs)
    nodes = setup.nodes(escs)
    if waiting := waiting_for_lss(nodes, escs):
        say(
            f"warning: {', '.join(waiting)}: no node-ID yet (LSS gives one), so no frames to describe"
        )
    return canopen_database(nodes, escs)


def _database(args: argparse.Namespace) -> "Database":
    from kontronik_can_gw.dbc.expand import among_canopen, expand
    from kontronik_can_gw.dbc.prepare import prepare
    from kontronik_can_gw.dbc.reader import choose_node, load_database
    from kontronik_can_gw.dbc.settings import DbcSettings

    if args.config is not None:
        _refuse(
            args,
            ("esc", "name", "base_id", "id_step", "node", "from"),
            "--config, which says all that",
        )
        database = load_all(args.config).database
        if database is None:
            raise UserError(
                f"{args.config}: dbc.enabled is false: no messages of a DBC are sent. --canopen writes those of the nodes."
            )
        return database
    escs = _escs(args)
    file = args.source or shipped("dbc/kontronik_esc.dbc")
    ignored: list[str] = []
    database = load_database(file, ignored)
    for line in ignored:
        say(f"warning: {line}")
    node = choose_node(database, args.node, str(file))
    plain = database
    database, bind = expand(plain, node, escs, str(file), None, args.base_id, args.id_step)
    if args.base_id is None and (reason := among_canopen(plain, database, node)):
        raise UserError(f"{file}: for {len(escs)} ESCs, {reason}")
    prepare(
        database, str(file), escs, DbcSettings(bind, node), fd_allowed=True
    )  # raises for mistakes that the gateway refuses
    return database


def _refuse(args: argparse.Namespace, options: tuple[str, ...], beside: str) -> None:
    """UserError for options that cannot be combined with another one."""
    given = [
        f"--{name.replace('_', '-')}"
        for name in options
        if getattr(args, "source" if name == "from" else name) is not None
    ]
    if given:
        raise UserError(f"{' and '.join(given)} cannot be combined with {beside}")


def _escs(args: argparse.Namespace) -> list[EscSettings]:
    """The ESCs given by ``--esc`` and ``--name``."""
    names = args.name or []
    count = args.esc if args.esc is not None else max(1, len(names))
    if names and len(names) != count:
        raise UserError(f"--name is given {len(names)} times for {count} ESCs")
    names = names or [f"esc{number}" for number in range(1, count + 1)]
    if problem := name_problem(names):
        raise UserError(f"--name: {problem}")
    return [EscSettings(name) for name in names]


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 128:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of ESCs, 1 to 128")
    return int(text)


def _name(text: str) -> str:
    if not re.fullmatch("[A-Za-z][A-Za-z0-9_]{0,11}", text):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a name of 1 to 12 letters, digits and underscores that begins with a letter"
        )
    return text


def _id(text: str) -> int:
    try:
        value = int(text, 0)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a CAN id, as 0x680 or 1664") from None
    if not 0 <= value <= 0x1FFFFFFF:
        raise argparse.ArgumentTypeError(f"{text} is outside 0..0x1FFFFFFF")
    return value
