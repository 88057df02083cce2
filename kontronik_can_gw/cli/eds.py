"""``eds``: writes the EDS in use, or a DCF with the active values of one node."""

import argparse
from pathlib import Path

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.dictionary import SdoAbort, Value
from kontronik_can_gw.canopen.node import Node
from kontronik_can_gw.canopen.objects import BINDINGS
from kontronik_can_gw.canopen.setup import CanopenSetup, shipped_canopen
from kontronik_can_gw.canopen.storage import VERIFY
from kontronik_can_gw.cli.arguments import OUTPUT, number_from, option
from kontronik_can_gw.cli.common import announced_config, canopen_of, load_all
from kontronik_can_gw.cli.output import configuration_files, write_output
from kontronik_can_gw.desk.dcf import dcf
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.status import UNCONFIGURED

_NODE_ID = number_from(
    1,
    127,
    "node-ID",
    kind=lambda text: int(text, 0),
)
OPTIONS = (
    option(
        "-c --config FILE",
        "use the EDS and nodes of this configuration (default: gateway.toml, or the shipped EDS)",
        type=Path,
    ),
    option(
        "--node-id N",
        "write the DCF of the node with this node-ID: the EDS with the values of the node",
        type=_NODE_ID,
    ),
    *OUTPUT,
)
EPILOG = (
    "Prints a copy of the EDS in use, or a DCF as defined in CiA 306. The EDS is unchanged, unless "
    "canopen.vendor_id or canopen.cia402_mirrors changes it. "
    "Exit codes: 0 done; 1 the file cannot be written; 2 wrong usage, configuration or EDS."
)
_STATES_AND_COMMANDS = frozenset(
    {
        0x1001,
        0x1002,
        0x1003,
        0x1010,
        0x1011,
        VERIFY,
        at.INFO,
        at.RESET_STATISTICS,
        at.ERROR_CODE,
    }
)
"""Objects that show a state, or have an effect when they are written."""


def main(args: argparse.Namespace) -> int:
    path = announced_config(with_nodes=True) if args.config is None else args.config
    if path is None:
        setup = shipped_canopen([args.node_id or 1])
        escs = setup.esc_settings([EscSettings()])
    else:
        loaded = load_all(path)
        setup = canopen_of(loaded)
        escs = loaded.escs
    text = setup.eds.data.decode("latin-1")  # keeps all bytes
    if args.node_id is not None:
        text = _dcf(
            setup,
            escs,
            args.node_id,
            Path(args.output).name,
        )
    inputs = configuration_files(path)
    write_output(
        args.output,
        text,
        inputs,
        force=args.force,
        encoding="latin-1",
    )
    return 0


def _dcf(setup: CanopenSetup, escs: list[EscSettings], node_id: int, name: str) -> str:
    nodes = setup.nodes(escs).nodes
    for node, esc in zip(nodes, escs, strict=True):
        if node.node_id == node_id:
            is_valid = name.isascii() and name.isprintable() and ";" not in name
            if name == "-" or not is_valid:
                name = f"{Path(setup.eds.name).stem}_{node_id}.dcf"
            bitrate = node.settings.bitrate
            values = _active_values(node)
            return dcf(
                setup.eds,
                node_id,
                bitrate,
                values,
                esc.name,
                name,
            )
    there = [str(node.node_id) for node in nodes if node.node_id != UNCONFIGURED]
    known = f"Available: {', '.join(there)}" if there else "All nodes wait for LSS"
    raise UserError(f"--node-id {node_id}: not in the configuration. {known}.")


def _active_values(node: Node) -> dict[tuple[int, int], Value]:
    """Return the configuration of a node by index and sub-index.

    It consists of all readable values except telemetry, states and commands.
    """
    values: dict[tuple[int, int], Value] = {}
    for variable in node.dictionary.variables.values():
        entry = variable.entry
        key = (entry.index, entry.sub)
        is_configuration = key not in BINDINGS and entry.index not in _STATES_AND_COMMANDS
        if not variable.is_readable or not is_configuration:
            continue
        try:
            values[key] = node.dictionary.value(variable, 0)
        except SdoAbort:
            continue  # the object has no value yet
    return values
