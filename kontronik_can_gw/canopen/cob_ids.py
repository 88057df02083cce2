"""COB-IDs: the predefined connection set and the restricted ones (CiA 301, 7.3.3 and 7.3.5)."""

from collections.abc import Callable, Iterator

from kontronik_can_gw.canopen.abort import Abort, SdoAbort
from kontronik_can_gw.canopen.dictionary import Dictionary

Taken = Callable[[int, object], bool]
"""Whether another user than this has a COB-ID, see ``uses.Use``."""

NMT, EMERGENCY, SDO_ANSWER, SDO_REQUEST, HEARTBEAT = 0x000, 0x080, 0x580, 0x600, 0x700
"""Those of EMERGENCY and after are first ids: the node-ID is added."""
LSS_ANSWER, LSS_REQUEST = 0x7E4, 0x7E5
OF_NODE_ID = (EMERGENCY, SDO_ANSWER, SDO_REQUEST, HEARTBEAT)
INVALID_BIT = 1 << 31
SYNC = "SYNC"


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


def check_free(cob_id: int, user: object, taken: Taken) -> None:
    """Whether a service may have a COB-ID. SdoAbort 06090030h for a restricted one, 06040043h for one in use."""
    if restricted(cob_id):
        raise SdoAbort(Abort.VALUE)
    if taken(cob_id, user):
        raise SdoAbort(Abort.INCOMPATIBLE)


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
