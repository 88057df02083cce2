"""The DBC that ``-c`` or ``--dbc`` names, of commands that read the gateway's frames."""

import argparse

from kontronik_can_gw.cli.common import announced_config, load_all
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc
from kontronik_can_gw.errors import UserError


def given_layout(args: argparse.Namespace) -> BusLayout | None:
    """The layout that an option names; None where none is given. UserError with every mistake."""
    return bus_layout(args) if args.config or args.dbc else None


def bus_layout(args: argparse.Namespace) -> BusLayout:
    """The layout that an option names, else of the configuration of this folder or machine, else the shipped one.

    UserError with every mistake.
    """
    if args.config is None and args.dbc is None:
        args.config = announced_config()
    if args.config is None:
        return layout_of_dbc(args.dbc or shipped("dbc/kontronik_esc.dbc"))
    loaded = load_all(args.config)
    if loaded.database is None:
        raise UserError(
            f"{args.config}: dbc.enabled is false: no messages of a DBC are sent. Give --dbc instead."
        )
    return BusLayout(loaded.database, loaded.layout, loaded.escs, loaded.config)
