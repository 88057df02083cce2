"""``describe``: writes the tables of docs/reference for the DBC and EDS in use."""

import argparse
from pathlib import Path

from kontronik_can_gw import __version__
from kontronik_can_gw.canopen.setup import CanopenSetup, shipped_canopen
from kontronik_can_gw.cli.arguments import OUTPUT, option
from kontronik_can_gw.cli.common import announced_config, canopen_setup, load_all
from kontronik_can_gw.cli.desk import bus_layout
from kontronik_can_gw.cli.output import configuration_files, write_output
from kontronik_can_gw.desk.describe.canopen_tables import emergencies, objects
from kontronik_can_gw.desk.describe.markdown import MarkdownTable, markdown
from kontronik_can_gw.desk.describe.tables import dbc, values
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.printable import printable, printable_json

OPTIONS = (
    (
        option("-c --config FILE", "describe the gateway with this TOML configuration", type=Path),
        option("--dbc FILE", "describe this DBC instead of the shipped one", type=Path),
    ),
    option("--format", "default: md", choices=("md", "json"), default="md"),
    *OUTPUT,
)
EPILOG = """\
Describes the messages and signals of the DBC in use, the CANopen nodes with
their objects and emergencies, all values, and error bits and states with
meaning and remedy. With -c, or if there is a gateway.toml, it describes that
configuration. Otherwise, and with --dbc, it describes the given or the shipped
DBC, and the shipped EDS with node-IDs from 1.

md is for a repository or wiki, json for programs. The keys of json change only
together with "version".

exit codes: 0 done; 1 the output cannot be written; 2 wrong usage,
configuration, DBC or EDS
"""
_TITLE = "What the gateway sends and what it means"


def main(args: argparse.Namespace) -> int:
    """Write the description. Raises UserError for faulty input, RunError if writing fails."""
    tables = _tables(args)
    if args.format == "json":
        text = _json(tables)
    else:
        lead = [f"Made by kontronik-can-gw {__version__} describe."]
        text = markdown(_TITLE, lead, tables)
    text = printable(text, keep="\n\t")
    inputs = configuration_files(args.config, args.dbc)
    write_output(
        args.output,
        text,
        inputs,
        force=args.force,
    )
    return 0


def _json(tables: list[MarkdownTable]) -> str:
    document: dict[str, object] = {
        "format": "kontronik-can-gw description",
        "version": 2,
        "program": __version__,
    }
    for table in tables:
        key = table.title.lower().replace(" ", "_")
        document[key] = table.rows
    return printable_json(document, indent=2, allow_nan=False) + "\n"


def _tables(args: argparse.Namespace) -> list[MarkdownTable]:
    if args.config is None and args.dbc is None:
        args.config = announced_config()
    bus: BusLayout | None = None
    nodes: CanopenSetup | None = None
    if args.config is None:
        bus = bus_layout(args)
        escs = bus.escs
        nodes = shipped_canopen(range(1, len(escs) + 1))
    else:
        loaded = load_all(args.config)
        escs = loaded.escs
        nodes = canopen_setup(loaded)
        if loaded.database:
            bus = BusLayout(
                loaded.database,
                loaded.layout,
                escs,
                loaded.config,
            )
    found: list[MarkdownTable] = []
    if bus is not None:
        found += dbc(bus, escs)
    if nodes is not None:
        found += objects(nodes, escs)
    found += emergencies(None if nodes is None else nodes.eds, escs)
    found += values(escs)
    return found
