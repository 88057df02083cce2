"""``describe``: generates documentation from the DBC and EDS in use, errors and states."""

import argparse
from pathlib import Path

from kontronik_can_gw.cli.arguments import OUTPUT, option
from kontronik_can_gw.cli.bus_layout import bus_layout
from kontronik_can_gw.cli.common import announced_config, load_all
from kontronik_can_gw.cli.output import write_output
from kontronik_can_gw.config.nodes import shipped_canopen
from kontronik_can_gw.desk.describe.document import document
from kontronik_can_gw.desk.describe.facts import describe
from kontronik_can_gw.desk.describe.parts import Facts
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.printable import printable, printable_json

# fmt: off
OPTIONS = (
    (
        option("-c --config FILE", "what the gateway with this TOML configuration sends", type=Path),
        option("--dbc FILE", "another DBC than the shipped one", type=Path),
    ),
    option("--format", "default: md", choices=("md", "json"), default="md"),
    OUTPUT,
)
# fmt: on
EPILOG = """\
Signals and messages of the DBC in use, the CANopen nodes with their objects and emergencies, error bits and states with meaning and
remedy. With -c as that configuration sends them: its ESCs, DBC, EDS and node-IDs. Otherwise of the shipped DBC and EDS, node-IDs from 1.

md is for a repository or wiki, json for programs (its keys only change with "version").

exit codes: 0 done, 1 the output cannot be written, 2 wrong usage, configuration, DBC or EDS
"""


def main(args: argparse.Namespace) -> int:
    """Write the description. UserError for faulty input files, RunError where it cannot be written."""
    facts = _facts(args)
    text = document(facts)
    if args.format == "json":
        text = printable_json(facts, indent=2, allow_nan=False) + "\n"
    write_output(args.output, printable(text, keep="\n\t"))
    return 0


def _facts(args: argparse.Namespace) -> Facts:
    if args.config is None and args.dbc is None:
        args.config = announced_config()
    if args.config is None:
        bus = bus_layout(args)
        return describe(bus, shipped_canopen(range(1, len(bus.escs) + 1)), bus.escs)
    loaded = load_all(args.config)
    found = loaded.database
    sent = None if found is None else BusLayout(found, loaded.layout, loaded.escs, loaded.config)
    return describe(sent, loaded.canopen, loaded.escs)
