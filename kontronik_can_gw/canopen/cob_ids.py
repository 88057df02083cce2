"""COB-IDs: the predefined connection set and the restricted ones (CiA 301, 7.3.3 and 7.3.5), and which of them a node uses."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from kontronik_can_gw.canopen.dictionary import Dictionary
from kontronik_can_gw.node_state import UNCONFIGURED

if TYPE_CHECKING:
    from kontronik_can_gw.canopen.node import Node

NMT, EMERGENCY, SDO_ANSWER, SDO_REQUEST, HEARTBEAT = 0x000, 0x080, 0x580, 0x600, 0x700
"""Those of EMERGENCY and after are first ids: the node-ID is added."""
LSS_ANSWER, LSS_REQUEST = 0x7E4, 0x7E5
OF_NODE_ID = (EMERGENCY, SDO_ANSWER, SDO_REQUEST, HEARTBEAT)
INVALID_BIT = 1 << 31
SYNC_USER = "SYNC"
"""The one user of 1005h in ``chosen_ids``: all nodes may have the same."""


def restricted(cob_id: int) -> bool:
    """True for COB-IDs that no PDO, SYNC or EMCY may use (CiA 301, table of restricted CAN-IDs)."""
    return (
        cob_id <= 0x07F
        or 0x101 <= cob_id <= 0x180
        or 0x581 <= cob_id <= 0x5FF
        or 0x601 <= cob_id <= 0x67F
        or 0x6E0 <= cob_id <= 0x6FF
        or cob_id >= 0x701
    )


def default_ids(dictionary: Dictionary, node_id: int) -> Iterator[tuple[int, int, int]]:
    """Valid COB-IDs of emergencies and PDOs by their defaults: index, sub-index, id."""
    if dictionary.get(0x1014) is None:
        yield 0x1014, 0, EMERGENCY + node_id
    for number, variable in dictionary.variables.items():
        index, sub = number >> 8, number & 0xFF
        if index == 0x1014 or (0x1800 <= index < 0x1A00 and sub == 1):
            cob_id = int(variable.default(node_id))
            if not cob_id & INVALID_BIT:
                yield index, sub, cob_id & 0x7FF


def all_ids(node: "Node") -> Iterator[tuple[int, str]]:
    """COB-IDs a node sends with or listens to as its own, and what they are."""
    yield NMT, "NMT"
    yield LSS_REQUEST, "LSS"
    yield LSS_ANSWER, "LSS"
    if node.node_id == UNCONFIGURED:
        return
    yield node.sync.cob_id, "SYNC"
    yield SDO_REQUEST + node.node_id, f"SDO requests to CANopen node {node.node_id}"
    yield from transmit_ids(node)


def transmit_ids(node: "Node") -> Iterator[tuple[int, str]]:
    """COB-IDs that no other device on the bus may send with, and what they are."""
    if node.node_id == UNCONFIGURED:
        return
    name = f"CANopen node {node.node_id}"
    yield HEARTBEAT + node.node_id, f"the heartbeat of {name}"
    yield SDO_ANSWER + node.node_id, f"SDO answers of {name}"
    if not node.emergencies.cob_id & INVALID_BIT:
        yield node.emergencies.cob_id & 0x7FF, f"emergencies of {name}"
    for tpdo in node.tpdos:
        if tpdo.valid:
            yield tpdo.cob_id, f"TPDO {tpdo.number + 1} of {name}"


def chosen_ids(node: "Node") -> Iterator[tuple[object, int]]:
    """COB-IDs that a master can choose: (the service that uses it, id)."""
    if node.node_id == UNCONFIGURED:
        return
    yield SYNC_USER, node.sync.cob_id
    if not node.emergencies.cob_id & INVALID_BIT:
        yield node.emergencies, node.emergencies.cob_id & 0x7FF
    for tpdo in node.tpdos:
        if tpdo.valid:
            yield tpdo, tpdo.cob_id
