"""``dbc``: writes the DBC of several ESCs from a one-ESC DBC, or of exactly what a configuration or its CANopen nodes send."""

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING

from kontronik_can_gw.canopen.dbc import database as canopen_database
from kontronik_can_gw.canopen.dbc import waiting_for_lss
from kontronik_can_gw.cli.arguments import OUTPUT, number_from, option
from kontronik_can_gw.cli.common import announced_config, canopen_of, load_all, say
from kontronik_can_gw.cli.output import write_output
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.config.nodes import shipped_canopen
from kontronik_can_gw.config.parse import name_problem
from kontronik_can_gw.dbc.expand import among_canopen, copies_of, expand
from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.dbc.reader import choose_node, load_database
from kontronik_can_gw.dbc.settings import DbcSettings
from kontronik_can_gw.dbc.writer import dbc_text
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings

if TYPE_CHECKING:
    from cantools.database.can import Database

_MAX_NODES = 127


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


# fmt: off
OPTIONS = (
    option("-c --config FILE", "write the DBC of what this configuration sends", type=Path),
    option("--canopen", "describe what the CANopen nodes send: PDOs as they are mapped now, heartbeats, emergencies"),
    option("--from DBC", "one-ESC DBC to start from (default: the shipped one)", type=Path),
    option("--esc N", "number of ESCs (default 1, or the number of names)", type=number_from(1, 128, "number of ESCs", kind=int)),
    option("--name NAME", "name of an ESC, once for each, in order (default esc1, esc2 ...)", type=_name, action="append"),
    option("--base-id X", "lowest CAN id, as 0x680 or 1664", type=_id),
    option("--id-step X", "distance of the ids from ESC to ESC (default: the smallest without a clash)", type=_id),
    option("--node NODE", "transmitter node of our messages (default: the only one that sends)"),
    OUTPUT,
)
# fmt: on
EPILOG = (
    "Prints a DBC that every tool reads; warnings go to standard error. With -c its VERSION ends with the layout's fingerprint, "
    "which check, status, captures and report show too: an old file is recognized by it. "
    "Exit code: 0 done, 1 it cannot be written, 2 wrong usage, configuration or DBC."
)


def main(args: argparse.Namespace) -> int:
    options = ("config", "from", "esc", "name", "base_id", "id_step", "node")
    if all(vars(args)[option] is None for option in options):
        args.config = announced_config(with_nodes=args.canopen)
    text = dbc_text(_canopen(args) if args.canopen else _database(args))
    encoding = "cp1252"  # what tools assume; usually the text is ASCII
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        encoding = "utf-8"
        say(
            "warning: written in UTF-8, because it has characters that Windows-1252, the usual encoding of a DBC, has not"
        )
    write_output(args.output, text, encoding)
    return 0


def _canopen(args: argparse.Namespace) -> "Database":
    """The DBC of the configured nodes, or of nodes from the shipped EDS with node-IDs from 1."""
    beside = "--canopen, which describes the nodes as they are"
    _refuse(args, ("from", "base_id", "id_step", "node"), beside)
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
    if args.config is not None:
        options = ("esc", "name", "base_id", "id_step", "node", "from")
        _refuse(args, options, "--config, which says all that")
        loaded = load_all(args.config)
        if loaded.database is None:
            raise UserError(
                f"{args.config}: dbc.enabled is false: no messages of a DBC are sent. --canopen writes those of the nodes."
            )
        settings, plain = loaded.config.dbc_settings, loaded.database
        database = expand(plain, copies_of(plain, loaded.layout.file, loaded.escs, settings))
        version = re.sub(" ?layout [0-9A-F]{8}$", "", database.version or "")
        database.version = f"{version} layout {loaded.layout.fingerprint}".strip()
        return database
    escs = _escs(args)
    file = vars(args)["from"] or shipped("dbc/kontronik_esc.dbc")
    ignored: list[str] = []
    plain = load_database(file, ignored)
    for line in ignored:
        say(f"warning: {line}")
    node = choose_node(plain, args.node, str(file))
    settings = DbcSettings(node=node, base_id=args.base_id, id_step=args.id_step)
    copies = copies_of(plain, str(file), escs, settings)
    if args.base_id is None and (reason := among_canopen(copies, node)):
        raise UserError(f"{file}: for {len(escs)} ESCs, {reason}")
    # raises for mistakes that the gateway refuses
    prepare(plain, str(file), escs, settings, fd_allowed=True)
    return expand(plain, copies)


def _refuse(args: argparse.Namespace, options: tuple[str, ...], beside: str) -> None:
    """UserError for options that cannot be combined with another one."""
    given = [f"--{name.replace('_', '-')}" for name in options if vars(args)[name] is not None]
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
