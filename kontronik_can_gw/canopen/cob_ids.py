"""COB-IDs: predefined and restricted ones (CiA 301, 7.3.3 and 7.3.5), and the use by a node.

Also routes received frames to the services of a node.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

from kontronik_can_gw.canopen import nmt
from kontronik_can_gw.canopen.dictionary import Abort, Dictionary, SdoAbort
from kontronik_can_gw.canopen.emergency_codes import GatewayError
from kontronik_can_gw.canopen.nmt import Command
from kontronik_can_gw.status import UNCONFIGURED

if TYPE_CHECKING:
    from kontronik_can_gw.canopen.node import Node

FrameTaker = Callable[[bytes, int, int], None]
"""Called with a frame's data, the present time, and the frame's time of arrival."""
Taken = Callable[[int, object], bool]
"""Returns True if another user than the given one has a COB-ID, see ``Use``."""

NMT = 0x000
LSS_ANSWER = 0x7E4
LSS_REQUEST = 0x7E5
# The node-ID is added to these.
EMERGENCY = 0x080
SDO_ANSWER = 0x580
SDO_REQUEST = 0x600
HEARTBEAT = 0x700
OF_NODE_ID = (EMERGENCY, SDO_ANSWER, SDO_REQUEST, HEARTBEAT)
INVALID_BIT = 1 << 31
SYNC = "SYNC"


def restricted(cob_id: int) -> bool:
    """Return True for COB-IDs that no PDO, SYNC or EMCY may use.

    See the table of restricted CAN-IDs in CiA 301.
    """
    return (
        cob_id <= 0x07F
        or 0x101 <= cob_id <= 0x180
        or 0x581 <= cob_id <= 0x5FF
        or 0x601 <= cob_id <= 0x67F
        or 0x6E0 <= cob_id <= 0x6FF
        or cob_id >= 0x701
    )


def check_free(cob_id: int, user: object, taken: Taken) -> None:
    """Check if a service may use a COB-ID.

    Raises SdoAbort 06090030h for a restricted COB-ID, and 06040043h for one in use.
    """
    if restricted(cob_id):
        raise SdoAbort(Abort.VALUE)
    if taken(cob_id, user):
        raise SdoAbort(Abort.INCOMPATIBLE)


def default_ids(dictionary: Dictionary, node_id: int) -> Iterator[tuple[int, int, int]]:
    """Yield the valid default COB-IDs of emergencies and PDOs: index, sub-index, COB-ID."""
    if dictionary.get(0x1014) is None:
        yield 0x1014, 0, EMERGENCY + node_id
    for number, variable in dictionary.variables.items():
        index = number >> 8
        sub = number & 0xFF
        if index == 0x1014 or (0x1800 <= index < 0x1A00 and sub == 1):
            cob_id = int(variable.default(node_id))
            if not cob_id & INVALID_BIT:
                yield index, sub, cob_id & 0x7FF


class Use(NamedTuple):
    """A COB-ID that a node uses."""

    cob_id: int
    what: str
    user: object = None
    """The service for which a master can choose the COB-ID. None: it cannot be chosen.

    All nodes share the service SYNC.
    """
    own: bool = False
    """True if no other device on the bus may send with the COB-ID."""


def uses(node: "Node") -> Iterator[Use]:
    """Yield all COB-IDs with which a node sends, or which it receives for itself."""
    yield Use(NMT, "NMT")
    yield Use(LSS_REQUEST, "LSS")
    yield Use(LSS_ANSWER, "LSS")
    if node.node_id == UNCONFIGURED:
        return
    name = f"CANopen node {node.node_id}"
    yield Use(node.sync.cob_id, "SYNC", SYNC)
    yield Use(SDO_REQUEST + node.node_id, f"SDO requests to {name}")
    yield Use(HEARTBEAT + node.node_id, f"the heartbeat of {name}", own=True)
    yield Use(SDO_ANSWER + node.node_id, f"SDO answers of {name}", own=True)
    emergencies = node.emergencies
    if not emergencies.cob_id & INVALID_BIT:
        yield Use(emergencies.cob_id & 0x7FF, f"emergencies of {name}", emergencies, own=True)
    for tpdo in node.tpdos:
        if tpdo.valid:
            yield Use(tpdo.cob_id, f"TPDO {tpdo.number + 1} of {name}", tpdo, own=True)


def routes(node: "Node") -> Iterator[tuple[int, FrameTaker]]:
    """Yield the COB-IDs that a node receives, with the functions that process their frames.

    They include the monitored heartbeats of other nodes.
    """
    yield LSS_REQUEST, lambda data, now, _at: node.lss.receive(data, now)
    if node.node_id != UNCONFIGURED:
        yield NMT, partial(_on_nmt, node)
        yield node.sync.cob_id, partial(_on_sync, node)
        yield SDO_REQUEST + node.node_id, partial(_on_sdo, node)
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
    node.emergencies.set(GatewayError.SYNC_LENGTH, counter is None, now, at=at)
    if counter is not None:
        node.tpdos.on_sync(counter, now, at)
