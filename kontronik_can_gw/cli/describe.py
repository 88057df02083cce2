"""``describe``: generates documentation from the DBC and EDS in use, errors and states."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from kontronik_can_gw.printable import printable, printable_json

if TYPE_CHECKING:
    from kontronik_can_gw.desk.describe.parts import Facts

EPILOG = """\
Signals and messages of the DBC in use, the CANopen nodes with their objects and emergencies, error bits and states with meaning and
remedy. With -c as that configuration sends them: its ESCs, DBC, EDS and node-IDs. Otherwise of the shipped DBC and EDS, node-IDs from 1.

md is for a repository or wiki, json for programs (its keys only change with "version").

exit codes: 0 done, 1 the output cannot be written, 2 wrong usage, configuration, DBC or EDS
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare -c, --dbc, --format, -o."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    group = parser.add_mutually_exclusive_group()
    group.add_argument(
        "-c",
        "--config",
        type=Path,
        metavar="FILE",
        help="what the gateway with this TOML configuration sends",
    )
    group.add_argument("--dbc", type=Path, metavar="FILE", help="another DBC than the shipped one")
    parser.add_argument("--format", choices=("md", "json"), default="md", help="default: md")
    parser.add_argument(
        "-o", "--output", metavar="FILE", default="-", help="where to (default: standard output)"
    )


def main(args: argparse.Namespace) -> int:
    """Write the description. UserError for faulty input files, RunError where it cannot be written."""
    from kontronik_can_gw.cli.common import write_output

    write_output(args.output, printable(_text(args), keep="\n\t"), "utf-8")
    return 0


def _text(args: argparse.Namespace) -> str:
    facts = _facts(args)
    if args.format == "json":
        return printable_json(facts, indent=2, allow_nan=False) + "\n"
    from kontronik_can_gw.desk.describe.document import document

    return document(facts)


def _facts(args: argparse.Namespace) -> "Facts":
    from kontronik_can_gw.cli.common import load_all
    from kontronik_can_gw.config.keys import shipped
    from kontronik_can_gw.config.nodes import shipped_canopen
    from kontronik_can_gw.desk.describe.facts import describe
    from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc

    if args.config is not None:
        loaded = load_all(args.config)
        found = loaded.database
        bus = None if found is None else BusLayout(found, loaded.layout, loaded.escs, loaded.config)
        return describe(bus, loaded.canopen, loaded.escs)
    bus = layout_of_dbc(args.dbc or shipped("dbc/kontronik_esc.dbc"))
    setup = shipped_canopen(range(1, len(bus.escs) + 1))
    return describe(bus, setup, bus.escs)
