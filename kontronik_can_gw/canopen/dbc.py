"""The CANopen side as a DBC: transmit PDOs as they are mapped now, heartbeats and emergencies, so that a plain logger reads them.

Nodes in, a database for ``dbc/writer.py`` out.
"""

from collections.abc import Sequence

from kontronik_can_gw.canopen.dbc_messages import GATEWAY, LOGGER, NodeMessages
from kontronik_can_gw.canopen.dbc_names import Names
from kontronik_can_gw.canopen.nodes import Nodes
from kontronik_can_gw.dbc import builder
from kontronik_can_gw.dbc.builder import Database, Message
from kontronik_can_gw.dbc.names import esc_prefix
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.node_state import UNCONFIGURED

LAYOUT_VERSION = "1.0.0"
_NODES = {
    GATEWAY: "Gateway that is a CANopen node for each KONTRONIK ESC. It sends every message of this file.",
    LOGGER: "Any receiver: logger, display or controller.",
}


def database(nodes: Nodes, escs: Sequence[EscSettings]) -> Database:
    """What the nodes send by themselves, as they are configured now; ``escs`` in their order.

    With several ESCs each name begins with that of its ESC. Nodes that wait for LSS have no frames; the database's comment names
    them.
    """
    message_names, signal_names = Names(), Names()
    messages: list[Message] = []
    for node, esc in zip(nodes.nodes, escs, strict=True):
        if node.node_id == UNCONFIGURED:
            continue
        prefix = esc_prefix(esc.name) if len(escs) > 1 else ""
        messages += NodeMessages(node, prefix, message_names, signal_names).all()
    return builder.database(_NODES, _about(nodes, escs), LAYOUT_VERSION, messages)


def waiting_for_lss(nodes: Nodes, escs: Sequence[EscSettings]) -> list[str]:
    """Names of the ESCs whose nodes have no node-ID, and so no frames."""
    pairs = zip(nodes.nodes, escs, strict=True)
    return [esc.name for node, esc in pairs if node.node_id == UNCONFIGURED]


def _about(nodes: Nodes, escs: Sequence[EscSettings]) -> str:
    """The comment of the database."""
    who = [
        f"node {node.node_id} ({esc.name})"
        for node, esc in zip(nodes.nodes, escs, strict=True)
        if node.node_id != UNCONFIGURED
    ]
    parts = [f"KONTRONIK ESC telemetry as CANopen PDOs, layout version {LAYOUT_VERSION}."]
    if who:
        parts.append(f"Active transmit PDOs, heartbeat and emergencies of {', '.join(who)}.")
    if waiting := waiting_for_lss(nodes, escs):
        parts.append(f"Waiting for a node-ID by LSS, so without frames: {', '.join(waiting)}.")
    parts.append(
        "PDOs are sent while a node is Operational. All bits set (signed: only the sign bit set) means NotAvailable. "
        "A master that maps PDOs in another way makes another file necessary."
    )
    return " ".join(parts)
