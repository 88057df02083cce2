"""``eds``: writes the EDS in use, or a DCF with the active values of one node."""

import argparse
from pathlib import Path

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.abort import SdoAbort
from kontronik_can_gw.canopen.dcf import dcf
from kontronik_can_gw.canopen.dictionary import Value
from kontronik_can_gw.canopen.node import Node
from kontronik_can_gw.canopen.nodes import CanopenSetup
from kontronik_can_gw.canopen.objects import BINDINGS
from kontronik_can_gw.canopen.storage import VERIFY
from kontronik_can_gw.cli.common import canopen_of, load_all, write_output
from kontronik_can_gw.config.nodes import shipped_canopen
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.node_state import UNCONFIGURED

_STATES_AND_COMMANDS = frozenset(
    {0x1001, 0x1002, 0x1003, 0x1010, 0x1011, VERIFY, at.INFO, at.RESET_STATISTICS, at.ERROR_CODE}
)
"""Objects with momentary state, or with an effect when they are written."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "-c",
        "--config",
        type=Path,
        metavar="FILE",
        help="the EDS and the nodes of this configuration (default: shipped)",
    )
    parser.add_argument(
        "--node-id",
        type=_node_id,
        metavar="N",
        help="write the DCF of the node with this node-ID: the EDS and its values",
    )
    parser.add_argument(
        "-o", "--output", metavar="FILE", default="-", help="where to (default: standard output)"
    )
    parser.epilog = (
        "Prints the EDS in use, byte by byte, or a DCF by CiA 306. "
        "Exit code: 0 done, 1 it cannot be written, 2 wrong usage, configuration or EDS."
    )


def main(args: argparse.Namespace) -> int:
    if args.config is None:
        setup = shipped_canopen([args.node_id or 1])
        escs = setup.esc_settings([EscSettings()])
    else:
        loaded = load_all(args.config)
        setup, escs = canopen_of(loaded), loaded.escs
    text = setup.eds.data.decode("latin-1")  # keeps all bytes
    if args.node_id is not None:
        text = _dcf(setup, escs, args.node_id, Path(args.output).name)
    write_output(args.output, text, "latin-1")
    return 0


def _dcf(setup: CanopenSetup, escs: list[EscSettings], node_id: int, file_name: str) -> str:
    nodes = setup.nodes(escs).nodes
    for node, esc in zip(nodes, escs, strict=True):
        if node.node_id == node_id:
            if (
                file_name == "-"
                or not file_name.isascii()
                or not file_name.isprintable()
                or ";" in file_name
            ):
                file_name = f"{Path(setup.eds.name).stem}_{node_id}.dcf"
            return dcf(
                setup.eds, node_id, node.settings.bitrate, active_values(node), esc.name, file_name
            )
    there = [str(node.node_id) for node in nodes if node.node_id != UNCONFIGURED]
    known = (
        f"There are {', '.join(there)}"
        if len(there) > 1
        else f"There is {there[0]}"
        if there
        else "All wait for LSS"
    )
    raise UserError(f"--node-id {node_id}: no node of the configuration has it. {known}.")


def active_values(node: Node) -> dict[tuple[int, int], Value]:
    """A node's configuration by index and sub-index: every readable value but telemetry, states and commands."""
    values: dict[tuple[int, int], Value] = {}
    for variable in node.dictionary.variables.values():
        key = variable.entry.index, variable.entry.sub
        if not variable.readable or key in BINDINGS or variable.entry.index in _STATES_AND_COMMANDS:
            continue
        try:
            values[key] = node.dictionary.value(variable, 0)
        except SdoAbort:
            continue  # nothing there yet
    return values


def _node_id(text: str) -> int:
    try:
        value = int(text, 0)
    except ValueError:
        value = 0
    if not 1 <= value <= 127:
        raise argparse.ArgumentTypeError(f"{text!r} is not a node-ID, 1 to 127")
    return value
