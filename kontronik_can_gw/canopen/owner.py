"""What a node asks of the gateway that it is part of."""

from typing import TYPE_CHECKING, Protocol

from kontronik_can_gw.canopen.storage import Stored
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.frames import CanFrame

if TYPE_CHECKING:
    from kontronik_can_gw.canopen.node import Node


class Owner(Protocol):
    """All nodes of one bus; implemented by ``nodes.Nodes``."""

    def send(self, frame: CanFrame) -> None:
        """Put a frame out."""

    def save(self, node: "Node", stored: Stored) -> None:
        """Begin to store; ``node.saved`` is called with the result."""

    def settings_changed(self, node: "Node", settings: EscSettings) -> None:
        """2100h was written or reset."""

    def routes_changed(self) -> None:
        """The node listens to other COB-IDs now."""

    def rejected(self, node: "Node", keys: list[int]) -> None:
        """Stored values that did not hold at a reset: they do not fit the EDS, or clash."""

    def state_changed(self) -> None:
        """The node's NMT state or node-ID is another one."""

    def cob_id_taken(self, cob_id: int, user: object) -> bool:
        """Whether something else of the gateway uses this id; ``user`` as in ``cob_ids.chosen_ids``."""

    def node_id_taken(self, node_id: int, node: "Node") -> bool:
        """Whether another node of the gateway has this node-ID, now or from its next reset on, or another message a COB-ID of it."""
