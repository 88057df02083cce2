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
"""Is given a frame's data, the time, and when the frame came."""


class Reception:
    """The frames of one node."""

    def __init__(self, node: "Node") -> None:
        self._node = node

    def routes(self) -> Iterator[tuple[int, FrameTaker]]:
        """COB-IDs the node listens to, and what takes their frames."""
        node = self._node
        yield LSS_REQUEST, self._on_lss
        if node.node_id == UNCONFIGURED:
            return
        yield NMT, self._on_nmt
        yield SDO_REQUEST + node.node_id, self._on_sdo
        yield node.sync.cob_id, self._on_sync
        for node_id in node.consumer.node_ids:
            yield HEARTBEAT + node_id, partial(self._on_heartbeat, node_id)

    def _on_nmt(self, data: bytes, now: int, _at: int) -> None:
        node = self._node
        command = nmt.command(data, node.node_id)
        if command is None:
            return
        if command is Command.RESET_NODE:
            node.reset_node(now)
        elif command is Command.RESET_COMMUNICATION:
            node.reset_communication(now)
        else:
            node.nmt.enter(nmt.STATE_AFTER[command], now)
        node.set_due()

    def _on_sdo(self, data: bytes, now: int, _at: int) -> None:
        if self._node.nmt.communicates:
            self._node.sdo.receive(data, now)
            self._node.set_due()

    def _on_lss(self, data: bytes, now: int, _at: int) -> None:
        self._node.lss.receive(data, now)
        self._node.set_due()

    def _on_sync(self, data: bytes, now: int, at: int) -> None:
        node = self._node
        if not node.nmt.communicates:
            return
        counter = node.sync.counter(data)
        node.emergencies.set(GatewayError.SYNC_LENGTH, counter is None, now)
        if counter is not None:
            node.tpdos.on_sync(counter, now, at)
        node.set_due()

    def _on_heartbeat(self, node_id: int, data: bytes, now: int, at: int) -> None:
        self._node.consumer.receive(node_id, data, now, at)
        self._node.set_due()
