"""Which frames from the bus a node takes, and which service is given them."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING

from kontronik_can_gw.canopen import nmt
from kontronik_can_gw.canopen.cob_ids import HEARTBEAT, LSS_REQUEST, NMT, SDO_REQUEST
from kontronik_can_gw.canopen.emergency_codes import GatewayError
from kontronik_can_gw.canopen.nmt import Command
from kontronik_can_gw.node_state import UNCONFIGURED

if TYPE_CHECKING:
    from kontronik_can_gw.canopen.node import Node

FrameTaker = Callable[[bytes, int, int], None]
"""Is given a frame's data, the time, and when the frame came. ``Node.set_due`` follows."""


def routes(node: "Node") -> Iterator[tuple[int, FrameTaker]]:
    """COB-IDs the node listens to, and what takes their frames."""
    yield LSS_REQUEST, lambda data, now, _at: node.lss.receive(data, now)
    if node.node_id == UNCONFIGURED:
        return
    yield NMT, partial(_on_nmt, node)
    yield SDO_REQUEST + node.node_id, partial(_on_sdo, node)
    yield node.sync.cob_id, partial(_on_sync, node)
    for node_id in node.consumer.node_ids:
        yield HEARTBEAT + node_id, partial(node.consumer.receive, node_id)


def _on_nmt(node: "Node", data: bytes, now: int, _at: int) -> None:
    match nmt.command(data, node.node_id):
        case None:
            pass
        case Command.RESET_NODE:
            node.reset_node(now)
        case Command.RESET_COMMUNICATION:
            node.reset_communication(now)
        case command:
            node.nmt.enter(nmt.STATE_AFTER[command], now)


def _on_sdo(node: "Node", data: bytes, now: int, _at: int) -> None:
    if node.nmt.communicates:
        node.sdo.receive(data, now)


def _on_sync(node: "Node", data: bytes, now: int, at: int) -> None:
    if not node.nmt.communicates:
        return
    counter = node.sync.counter(data)
    node.emergencies.set(GatewayError.SYNC_LENGTH, counter is None, now)
    if counter is not None:
        node.tpdos.on_sync(counter, now, at)
