"""``dbc``: write the DBC of several ESCs from a one-ESC DBC, or of exactly what a configuration sends."""

import argparse
import io
import re
import sys
import tempfile
from pathlib import Path

from kontronik_can_gw.cli.common import load_all, say
from kontronik_can_gw.config import name_problem, shipped
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.telemetry import EscSettings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "-c", "--config", type=Path, metavar="FILE", help="write the DBC of what this configuration sends"
    )
    parser.add_argument(
        "--from", type=Path, dest="source", metavar="DBC", help="one-ESC DBC to start from (default: the shipped one)"
    )
    parser.add_argument("--esc", type=_count, metavar="N", help="number of ESCs (default 1, or the number of names)")
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
        "--node", metavar="NODE", help="transmitter node of our messages (default: the only one that sends)"
    )
    parser.add_argument("-o", "--output", metavar="FILE", default="-", help="where to (default: standard output)")


def main(args: argparse.Namespace) -> int:
    from kontronik_can_gw.dbc_output.expand import dbc_text

    text = dbc_text(_database(args))
    try:
        data = text.encode("cp1252")  # what tools take a DBC for; ASCII as a rule
    except UnicodeEncodeError:
        data = text.encode("utf-8")
        say(
            "warning: written in UTF-8, because it has characters that Windows-1252, the usual encoding of a DBC, has not"
        )
    if args.output == "-":
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.buffer.write(data)
        else:
            sys.stdout.write(text)
        return 0
    _write(Path(args.output), data)
    say(f"{args.output} written")
    return 0


def _database(args: argparse.Namespace):  # type: ignore[no-untyped-def]  # cantools' type, imported only when needed
    from kontronik_can_gw.dbc_output.expand import expand
    from kontronik_can_gw.dbc_output.layout import DbcSettings, choose_node, load_database
    from kontronik_can_gw.dbc_output.prepare import prepare

    if args.config is not None:
        given = [
            f"--{n.replace('_', '-')}"
            for n in ("esc", "name", "base_id", "id_step", "node")
            if getattr(args, n) is not None
        ]
        given += ["--from"] if args.source is not None else []
        if given:
            raise UserError(f"{' and '.join(given)} cannot be combined with --config, which says all that")
        database = load_all(args.config).database
        if database is None:
            raise UserError(
                f"{args.config}: dbc.enabled is false: no messages of a DBC are sent. --canopen writes those of the nodes."
            )
        return database
    names = args.name or []
    count = args.esc if args.esc is not None else max(1, len(names))
    if names and len(names) != count:
        raise UserError(f"--name is given {len(names)} times for {count} ESCs")
    names = names or [f"esc{number}" for number in range(1, count + 1)]
    if problem := name_problem(names):
        raise UserError(f"--name: {problem}")
    escs = [EscSettings(name) for name in names]
    file = args.source or shipped("dbc/kontronik_esc.dbc")
    database = load_database(file)
    node = choose_node(database, args.node, str(file))
    database, bind = expand(database, node, escs, str(file), None, args.base_id, args.id_step)
    prepare(
        database, str(file), escs, DbcSettings(bind, node), fd_allowed=True
    )  # refuses what the gateway would refuse
    return database


def _write(path: Path, data: bytes) -> None:
    """All or nothing: a reader never sees half a file. What is no plain file (a pipe, /dev/stdout) is written to, not replaced."""
    beside: Path | None = None
    try:
        target = path.resolve()
        if target.exists() and not target.is_file():
            target.write_bytes(data)
            return
        with tempfile.NamedTemporaryFile(dir=target.parent, prefix=f".{path.name}.", delete=False) as file:
            beside = Path(file.name)
            file.write(data)
        beside.chmod(0o644)
        beside.replace(target)
        beside = None
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {error.strerror}. Give another -o.") from None
    finally:
        if beside is not None:
            beside.unlink(missing_ok=True)


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 128:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of ESCs, 1 to 128")
    return int(text)


def _name(text: str) -> str:
    if not re.fullmatch("[A-Za-z][A-Za-z0-9_]{0,11}", text):
        raise argparse.ArgumentTypeError(f"{text!r} is not a name of 1 to 12 letters, digits and underscores")
    return text


def _id(text: str) -> int:
    try:
        value = int(text, 0)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a CAN id, as 0x680 or 1664") from None
    if not 0 <= value <= 0x1FFFFFFF:
        raise argparse.ArgumentTypeError(f"{text} is outside 0..0x1FFFFFFF")
    return value
