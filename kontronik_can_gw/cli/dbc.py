"""``dbc``: writes a DBC.

It describes several ESCs by a one-ESC DBC, the messages of a configuration, or its CANopen nodes.
"""

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

from kontronik_can_gw.canopen.setup import shipped_canopen
from kontronik_can_gw.cli.arguments import OUTPUT, number_from, option
from kontronik_can_gw.cli.common import announced_config, canopen_of, load_all, say
from kontronik_can_gw.cli.output import configuration_files, write_output
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.dbc.expand import copies_of
from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.dbc.reader import load_database
from kontronik_can_gw.desk.dbc.canopen import pdo_text, waiting_for_lss
from kontronik_can_gw.desk.dbc.writer import copies_text
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings

_ESCS = number_from(
    1,
    127,
    "number of ESCs",
    kind=int,
)
OPTIONS = (
    option(
        "-c --config FILE", "write the DBC of the messages that this configuration sends", type=Path
    ),
    option(
        "--canopen",
        "write the DBC of the CANopen nodes: PDOs as mapped now, heartbeats, emergencies",
    ),
    option("--from DBC", "DBC for one ESC to start from (default: the shipped one)", type=Path),
    option("--esc N", "number of ESCs, which are named esc1, esc2 ... (default 1)", type=_ESCS),
    *OUTPUT,
)
EPILOG = (
    "Prints a DBC that every tool can read, and warnings on standard error. "
    "The VERSION in it ends with the fingerprint of "
    "the layout. check, status, captures and report show the same fingerprint, so you can "
    "recognise an outdated file. "
    "To choose names, ids and nodes, use the keys of a configuration. "
    "Exit codes: 0 done; 1 the file cannot be written; 2 wrong usage, configuration or DBC."
)


def main(args: argparse.Namespace) -> int:
    source = vars(args)["from"]
    if (source is not None or args.esc is not None) and args.config is not None:
        raise UserError("--esc, --from: cannot be combined with --config, which defines both")
    if source is not None and args.canopen:
        raise UserError("--from: cannot be combined with --canopen, which describes the nodes")
    if source is args.esc is args.config is None:
        args.config = announced_config(with_nodes=args.canopen)
    escs = [EscSettings(f"esc{number}") for number in range(1, (args.esc or 1) + 1)]
    if args.canopen:
        text = _canopen(args.config, escs)
    else:
        text = _messages(args.config, source or shipped("dbc/kontronik_esc.dbc"), escs)
    encoding = "cp1252"  # the encoding that tools assume; usually the text is ASCII
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        encoding = "utf-8"
        say(
            "warning: written in UTF-8, because some characters do not exist in Windows-1252, the "
            "usual encoding of a DBC"
        )
    inputs = configuration_files(args.config, source)
    write_output(
        args.output,
        text,
        inputs,
        force=args.force,
        encoding=encoding,
    )
    return 0


def _canopen(config: Path | None, escs: list[EscSettings]) -> str:
    if config is not None:
        loaded = load_all(config)
        setup = canopen_of(loaded)
        escs = loaded.escs
    else:
        setup = shipped_canopen(range(1, len(escs) + 1))
        escs = setup.esc_settings(escs)
    nodes = setup.nodes(escs)
    waiting = waiting_for_lss(nodes, escs)
    if waiting:
        say(f"warning: {', '.join(waiting)}: left out, because LSS has not assigned a node-ID yet")
    return pdo_text(nodes, escs)


def _messages(config: Path | None, file: Path, escs: Sequence[EscSettings]) -> str:
    """Return the DBC of a configuration, or of these ESCs by the one-ESC DBC in ``file``.

    Raises UserError for mistakes that the gateway refuses.
    """
    settings = DbcConfig()
    if config is not None:
        loaded = load_all(config)
        if loaded.database is None:
            raise UserError(
                f"{config}: dbc.enabled is false, so no messages of a DBC are sent. "
                "For the frames of the nodes give --canopen."
            )
        plain = loaded.database
        layout = loaded.layout
        escs = loaded.escs
        settings = loaded.config.dbc
    else:
        ignored: list[str] = []
        plain = load_database(file, ignored)
        layout = prepare(
            plain,
            str(file),
            escs,
            settings,
            is_fd_allowed=True,
        )
        for line in (*ignored, *layout.warnings):
            say(f"warning: {line}")
    version = re.sub(" ?layout [0-9A-F]{8}$", "", plain.version or "")
    copies = copies_of(
        plain,
        layout.file,
        escs,
        settings,
    )
    version = f"{version} layout {layout.fingerprint}".strip()
    return copies_text(
        plain,
        copies,
        version,
        layout.data_ids,
    )
