"""COB-IDs: the predefined and the restricted ones (CiA 301, 7.3.3 and 7.3.5)."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

from kontronik_can_gw.canopen.dictionary import Abort, Dictionary, SdoAbort

FrameTaker = Callable[[bytes, int, int], None]
"""Takes the data of a frame, the current time and the time of arrival."""
Taken = Callable[[int, object], bool]
"""Returns True if a COB-ID has another user than the given one, see ``Use``."""

NMT = 0x000
EMERGENCY = 0x080
"""To this and the three following COB-IDs the node-ID is added."""
SDO_ANSWER = 0x580
SDO_REQUEST = 0x600
HEARTBEAT = 0x700
LSS_ANSWER = 0x7E4
LSS_REQUEST = 0x7E5
OF_NODE_ID = (EMERGENCY, SDO_ANSWER, SDO_REQUEST, HEARTBEAT)
INVALID_BIT = 1 << 31
SYNC = "SYNC"


_RESTRICTED = (
    range(0x080),
    range(0x101, 0x181),
    range(0x581, 0x600),
    range(0x601, 0x67F + 1),
    range(0x6E0, 0x700),
    range(0x701, 0x800),
)
"""COB-IDs that no PDO, SYNC or EMCY may use (CiA 301, restricted CAN-IDs)."""


def check_free(cob_id: int, user: object, taken: Taken) -> None:
    """Check that a service may have a COB-ID.

    Raises SdoAbort 06090030h for a restricted COB-ID, and 06040043h for one in use.
    """
    if any(cob_id in ids for ids in _RESTRICTED):
        raise SdoAbort(Abort.VALUE)
    if taken(cob_id, user):
        raise SdoAbort(Abort.INCOMPATIBLE)


def default_ids(dictionary: Dictionary, node_id: int) -> Iterator[tuple[int, int, int]]:
    """Yield index, sub-index and COB-ID of each valid default of emergencies and PDOs."""
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
    """The service for which a master can choose the COB-ID. None if it cannot be chosen.

    ``SYNC`` stands for the SYNC services of all nodes, which share one COB-ID.
    """
    is_own: bool = False
    """True if no other device on the bus may send with it."""
