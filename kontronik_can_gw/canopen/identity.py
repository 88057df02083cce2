"""Node-ID and identity of one node: 1018h, 2101h, and what an LSS master does with them (CiA 305)."""

from collections.abc import Callable

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.abort import Abort, SdoAbort
from kontronik_can_gw.canopen.dictionary import Dictionary
from kontronik_can_gw.canopen.node_settings import NodeSettings
from kontronik_can_gw.canopen.parameters import Parameters
from kontronik_can_gw.node_state import UNCONFIGURED


class Identity:
    """The node as LSS sees it.

    ``taken``: whether another node of the gateway has a node-ID. ``boot``: called where an unconfigured node has got a node-ID.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        settings: NodeSettings,
        parameters: Parameters,
        taken: Callable[[int], bool],
        boot: Callable[[int], None],
    ) -> None:
        self.active_node_id = UNCONFIGURED
        self._dictionary = dictionary
        self._settings = settings
        self._parameters = parameters
        self._taken = taken
        self._boot = boot
        bind = dictionary.bind
        bind(at.NODE_ID, 1, read=lambda _now: self.active_node_id)
        check, read = self._check_node_id, lambda _now: self.pending_node_id
        bind(at.NODE_ID, 2, read=read, check=check, written=self._written)
        bind(at.NODE_ID, 3, read=lambda _now: settings.bitrate)
        bind(at.NODE_ID, 4, read=lambda _now: settings.bitrate)

    @property
    def pending_node_id(self) -> int:
        """The node-ID from the next reset communication on: as set over the bus, else as configured."""
        given = self._parameters.set_node_id
        return self._settings.node_id if given is None else given

    @property
    def identity(self) -> tuple[int, int, int, int]:
        """1018h:1..4."""
        number = self._dictionary.number
        serial = number(0x1018, 4, otherwise=self._settings.serial)
        return number(0x1018, 1), number(0x1018, 2), number(0x1018, 3), serial

    def activate(self) -> int:
        """Reset communication: the pending node-ID holds from now on."""
        self.active_node_id = self.pending_node_id
        return self.active_node_id

    def configure_node_id(self, node_id: int) -> bool:
        """A new node-ID for the next reset communication. False where writing is switched off or another node of ours has it."""
        if self._settings.read_only or (node_id != UNCONFIGURED and self._taken(node_id)):
            return False
        self._parameters.set_node_id = node_id
        return True

    def store_configuration(self) -> bool:
        """LSS: begin to save the pending node-ID. False: refused.

        After True exactly one call of ``LssSlave.stored`` follows, in the order of the requests, also when the node was reset between.
        """
        return not self._settings.read_only and self._parameters.store_node_id()

    def lss_left_configuration(self, now: int) -> None:
        """The slave was switched from configuration to waiting state."""
        if self.active_node_id == UNCONFIGURED and self.pending_node_id != UNCONFIGURED:
            self._boot(now)

    def _check_node_id(self, value: int) -> None:
        if not 1 <= value <= 127:
            raise SdoAbort(Abort.VALUE)
        if self._taken(value):
            raise SdoAbort(Abort.INCOMPATIBLE)

    def _written(self, _now: int) -> None:
        self._parameters.set_node_id = self._dictionary.number(at.NODE_ID, 2)
