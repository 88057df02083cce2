"""``-c`` and ``--dbc`` of the commands that read the gateway's frames."""

import argparse
from pathlib import Path

from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc
from kontronik_can_gw.errors import UserError


def add_layout_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare -c and --dbc."""
    group = parser.add_mutually_exclusive_group()
    group.add_argument(
        "-c",
        "--config",
        type=Path,
        metavar="FILE",
        help="TOML configuration of the gateway whose frames they are",
    )
    group.add_argument(
        "--dbc",
        type=Path,
        metavar="FILE",
        help="DBC of the frames (default: the shipped one, for one ESC)",
    )


def bus_layout(config: Path | None, dbc: Path | None) -> BusLayout:
    """The layout given by ``-c`` or ``--dbc``, by default the shipped one. UserError with every mistake."""
    if config is not None:
        from kontronik_can_gw.cli.common import load_all

        loaded = load_all(config)
        if loaded.database is None:
            raise UserError(
                f"{config}: dbc.enabled is false: no messages of a DBC are sent. Give --dbc instead."
            )
        return BusLayout(loaded.database, loaded.layout, loaded.escs, loaded.config)
    return layout_of_dbc(dbc or shipped("dbc/kontronik_esc.dbc"))
